"""Meta-metric leave-one-out (MLOO): the group's loss of realism without a rollout."""

from jaxtyping import Float
from torch import Tensor

from rlftsim.realism import AgentScores, RealismResult
from rlftsim.rewards.base import check_num_rollouts, register_agent_rewards, register_reward
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch


def compute_mloo(leave_one_out_rmm: Float[Tensor, "B N"]) -> Float[Tensor, "B N"]:
    """Reward of each rollout: the group's loss of meta-metric without it, minus the mean loss (RLFTSim, equation 2).

    Sums to zero over the rollouts of a scenario.

    Args:
        leave_one_out_rmm: RMM of the other N - 1 rollouts of the scenario, in [0, 1].

    Returns:
        Mean over the scenario's rollouts of `leave_one_out_rmm`, minus the rollout's own.

    Raises:
        ConfigError: Fewer than two rollouts, so none can be left out.
    """
    check_num_rollouts(leave_one_out_rmm)
    # The group without a good rollout scores low, so the rollout's value is subtracted from the mean.
    return leave_one_out_rmm.mean(-1, keepdim=True) - leave_one_out_rmm


@register_reward("mloo")
def mloo(realism: RealismResult, rollouts: Rollouts, batch: ScenarioBatch) -> Float[Tensor, "B N"]:
    """The paper's reward, by `compute_mloo`.

    Args:
        realism: Scores of the same rollouts, a row per scenario.
        rollouts: Rollouts behind the scores; not read here.
        batch: Scenarios of the rollouts; not read here.
    """
    return compute_mloo(realism.leave_one_out_meta_metric)


@register_agent_rewards("mloo")
def mloo_by_agent(agents: AgentScores, rollouts: Rollouts, batch: ScenarioBatch) -> Float[Tensor, "B N A"]:
    """Split of `mloo` by the logarithmic mean (`realism.credit`).

    Args:
        agents: Shares of each agent in the leave-one-out scores of the rollouts.
        rollouts: Rollouts behind the scores; not read here.
        batch: Scenarios of the rollouts; not read here.
    """
    return agents.leave_one_out
