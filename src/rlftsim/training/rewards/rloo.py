"""REINFORCE leave-one-out on the meta-metric of single rollouts."""

from jaxtyping import Float
from torch import Tensor

from rlftsim.realism import AgentScores, RealismResult
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.training.rewards.base import leave_one_out, register_reward, register_shares


@register_reward("rloo")
def rloo(scores: RealismResult, rollouts: Rollouts, batch: ScenarioBatch) -> Float[Tensor, "B N"]:
    """RMM of the rollout alone minus the mean of the others' (RLFTSim, section 4.1)."""
    return leave_one_out(scores.single_meta_metric)


@register_shares("rloo")
def rloo_shares(scores: AgentScores, rollouts: Rollouts, batch: ScenarioBatch) -> Float[Tensor, "B N A"]:
    """By the logarithmic mean (`realism.credit`)."""
    return scores.single
