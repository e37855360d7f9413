"""Meta-metric leave-one-out: how much the realism of the group suffers without a rollout."""

from jaxtyping import Float
from torch import Tensor

from rlftsim.realism import AgentScores, RealismResult
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.training.rewards.base import register_reward, register_shares, require_two


def compute_mloo(leave_one_out_rmm: Float[Tensor, "B N"]) -> Float[Tensor, "B N"]:
    """Reward of each rollout: how much more the meta-metric misses it than another.

    RLFTSim, equation 2. Sums to zero over the rollouts of a scenario.

    Args:
        leave_one_out_rmm: RMM of the other N - 1 rollouts, in [0, 1].

    Returns:
        Mean over the scenario's rollouts of `leave_one_out_rmm`, minus the rollout's own.

    Raises:
        ConfigError: fewer than two rollouts, so nothing can be left out.
    """
    require_two(leave_one_out_rmm)
    return leave_one_out_rmm.mean(-1, keepdim=True) - leave_one_out_rmm


@register_reward("mloo")
def mloo(scores: RealismResult, rollouts: Rollouts, batch: ScenarioBatch) -> Float[Tensor, "B N"]:
    """The paper's reward."""
    return compute_mloo(scores.leave_one_out_meta_metric)


@register_shares("mloo")
def mloo_shares(scores: AgentScores, rollouts: Rollouts, batch: ScenarioBatch) -> Float[Tensor, "B N A"]:
    """By the logarithmic mean (`realism.credit`)."""
    return scores.leave_one_out
