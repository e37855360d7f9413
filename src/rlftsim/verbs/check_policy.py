"""`rs.check_policy`: every rule of the policy contract, tried on a policy."""

from rlftsim.rollout.check import CheckReport
from rlftsim.rollout.check import check_policy as check_contract
from rlftsim.scenario.open import to_scenarios
from rlftsim.verbs.arguments import Data, Model
from rlftsim.verbs.inputs import to_policy, with_checked_arguments


@with_checked_arguments
def check_policy(policy: Model, scenarios: Data, *, reference: Model | None = None) -> CheckReport:
    """Try every rule of the policy contract that applies.

    Nothing is changed in the policy: a module is copied and put into evaluation mode. Takes seconds for a small policy.

    Args:
        policy: Policy, or a name for `load_policy`.
        scenarios: Scenarios, one or more, on which everything is tried; best of different sizes and with all kinds of
            agents. A name of a data set stands for its split validation.
        reference: Another policy of the same kind for KL divergences; None = a copy with perturbed weights.

    Returns:
        One result per rule. A rule whose check raised an error counts as failed, the error is its detail.

    Raises:
        ConfigError: No policy, or no scenario.
    """
    loaded = to_scenarios(scenarios)
    scenarios = [loaded[position] for position in range(len(loaded))]
    return check_contract(to_policy(policy), scenarios, reference=None if reference is None else to_policy(reference))
