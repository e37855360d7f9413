"""How near a rollout keeps to the record: the imitation reward the paper compares with."""

from jaxtyping import Float
from torch import Tensor

from rlftsim.realism import AgentScores, RealismResult
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.training.rewards.base import leave_one_out, register_reward, register_shares


@register_reward("minade_rloo")
def minade_rloo(scores: RealismResult, rollouts: Rollouts, batch: ScenarioBatch) -> Float[Tensor, "B N"]:
    """Minus the rollout's ADE, m, against the mean of the others' (RLFTSim, section 5.3).

    The ADE is the evaluator's, a mean over evaluated agents and all valid steps of the record, the history (without error) included.
    """
    return leave_one_out(-scores.rollout_displacement_error)


@register_shares("minade_rloo")
def minade_rloo_shares(scores: AgentScores, rollouts: Rollouts, batch: ScenarioBatch) -> Float[Tensor, "B N A"]:
    """Each agent's own error."""
    return leave_one_out(-scores.displacement_error)
