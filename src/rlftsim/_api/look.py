"""Looking at rollouts and policies: score, check_policy."""

from rlftsim._api.sources import batch_of, policy_of
from rlftsim.errors import ConfigError
from rlftsim.evaluation.rollout_checks import warn_of_doubts
from rlftsim.realism import RealismResult, metric_by_name, score_batch
from rlftsim.realism import score as score_scenario
from rlftsim.realism.from_rollouts import states_of_rollouts
from rlftsim.rollout.check import CheckReport
from rlftsim.rollout.check import check_policy as check_contract
from rlftsim.rollout.policy import Policy
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.any_form import AnyScenarios, Name, to_scenarios
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import Scenario
from rlftsim.viewer.notebook import check_rollouts


def score(scenarios: AnyScenarios, rollouts: Rollouts, metric: str | int = "2025") -> RealismResult:
    """Score rollouts with the realism meta-metric of the Waymo Open Sim Agents Challenge.

    Rollouts that cannot be, such as those of another frame, are scored with a warning that names scenario and agent.

    Args:
        scenarios: the scenarios of the rollouts with their logged futures, in the same order; a name of a data set
            stands for its split validation.
        rollouts: of `simulate`.
        metric: year of the challenge.

    Returns:
        Scores; without a leading axis for a `Scenario`, else with one of B scenarios.

    Raises:
        ConfigError: rollouts of other scenarios, or no such metric.
        DataError: a scenario that cannot be scored, e.g. one without its future, a pose that is not finite, or a
            scenario with other agents than the simulated one.
    """
    check_rollouts("score", scenarios, rollouts)
    batch = batch_of(scenarios, rollouts.position.device)
    # 1. Refuse rollouts of other scenarios: by the ids of scenarios and agents where they know them, else by numbers.
    about = rollouts.provenance
    if about is not None:
        ids = tuple(scenario.scenario_id for scenario in batch.scenarios)
        if about.scenario_ids != ids:
            theirs = ", ".join(about.scenario_ids[:3])
            raise ConfigError(
                f"rollouts of {theirs} do not belong to {', '.join(ids[:3])}: hand over the same scenarios."
            )
        for row, scenario in enumerate(batch.scenarios):
            about.check_same_agents(row, scenario)
        if batch.frame != about.frame:
            batch = collate(batch.scenarios, frame=about.frame).to(batch.device)
    num_scenarios, _, num_agents = rollouts.position.shape[:3]
    if num_scenarios != batch.num_scenarios or num_agents < batch.agent_mask.shape[1]:
        raise ConfigError(
            f"rollouts of {num_scenarios} scenarios with up to {num_agents} agents do not belong to "
            f"{batch.num_scenarios} with up to {batch.agent_mask.shape[1]}: hand over the same scenarios."
        )
    # 2. Score, in the world frame and without padding.
    states, config = states_of_rollouts(batch, rollouts), metric_by_name(str(metric))
    for scenario, simulated in zip(batch.scenarios, states):
        simulated.check_finite(scenario.scenario_id)
        warn_of_doubts(scenario, simulated)
    if isinstance(scenarios, Scenario):
        return score_scenario(scenarios, states[0], config)
    return score_batch(batch.scenarios, states, config)


def check_policy(
    policy: Policy | Name, scenarios: AnyScenarios, *, reference: Policy | Name | None = None
) -> CheckReport:
    """Try every rule of the policy contract that applies.

    Nothing is changed in the policy: a module is copied and put into evaluation mode. Takes seconds for a small policy.

    Args:
        policy: a policy, or a name for `load_policy`.
        scenarios: at least one, on which everything is tried; best of different sizes and with all kinds of agents. A
            name of a data set stands for its split validation.
        reference: another policy of the same kind for KL divergences; None = a copy with perturbed weights.

    Returns:
        One result per rule. A rule whose check raised an error counts as failed, the error is its detail.

    Raises:
        ConfigError: no policy, or no scenario.
    """
    found = to_scenarios(scenarios)
    tried = [found[position] for position in range(len(found))]
    return check_contract(policy_of(policy), tried, reference=None if reference is None else policy_of(reference))
