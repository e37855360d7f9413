"""Meta-metric leave-one-out (MLOO): the loss of realism of the group without a rollout."""

from jaxtyping import Float
from torch import Tensor

from rlftsim.realism import AgentScores, RealismResult
from rlftsim.rewards.base import register_agent_rewards, register_reward, require_two
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch


def compute_mloo(leave_one_out_rmm: Float[Tensor, "B N"]) -> Float[Tensor, "B N"]:
    """Reward of each rollout: the group's loss of meta-metric without it, minus the mean loss (RLFTSim, equation 2).

    Sums to zero over the rollouts of a scenario.

    Args:
        leave_one_out_rmm: RMM of the other N - 1 rollouts, in [0, 1].

    Returns:
        Mean over the scenario's rollouts of `leave_one_out_rmm`, minus the rollout's own.

    Raises:
        ConfigError: fewer than two rollouts, so none can be left out.
    """
    require_two(leave_one_out_rmm)
    # The group without a good rollout scores low, so its own value is subtracted from the mean.
    return leave_one_out_rmm.mean(-1, keepdim=True) - leave_one_out_rmm


@register_reward("mloo")
def mloo(realism: RealismResult, rollouts: Rollouts, batch: ScenarioBatch) -> Float[Tensor, "B N"]:
    """The paper's reward, see `compute_mloo`.

    Args:
        realism: of the rollouts.
        rollouts: not used.
        batch: not used.
    """
    return compute_mloo(realism.leave_one_out_meta_metric)


@register_agent_rewards("mloo")
def mloo_by_agent(agents: AgentScores, rollouts: Rollouts, batch: ScenarioBatch) -> Float[Tensor, "B N A"]:
    """Split of `mloo` by the logarithmic mean (`realism.credit`).

    Args:
        agents: the rollouts' scores by agent.
        rollouts: not used.
        batch: not used.
    """
    return agents.leave_one_out
