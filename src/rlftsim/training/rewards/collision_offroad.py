"""The heuristic rewards the paper compares with: do not collide, stay on the road, and perhaps keep near the record."""

from jaxtyping import Float
from torch import Tensor

from rlftsim.realism import AgentScores, RealismResult
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.training.rewards.base import leave_one_out, register_reward, register_shares


@register_reward("collision_offroad")
def collision_offroad(scores: RealismResult, rollouts: Rollouts, batch: ScenarioBatch) -> Float[Tensor, "B N"]:
    """Minus the share of evaluated agents that ever collide, minus that of those that ever leave the road; against the others."""
    return leave_one_out(-(scores.rollout_collision_rate + scores.rollout_offroad_rate))


@register_shares("collision_offroad")
def collision_offroad_shares(scores: AgentScores, rollouts: Rollouts, batch: ScenarioBatch) -> Float[Tensor, "B N A"]:
    """Each agent's own collision and off-road driving. A collision of two evaluated agents is owed to both."""
    return leave_one_out(-(scores.collision + scores.offroad))


@register_reward("collision_offroad_ade")
def collision_offroad_ade(
    scores: RealismResult, rollouts: Rollouts, batch: ScenarioBatch, *, ade_weight: float = 0.1
) -> Float[Tensor, "B N"]:
    """`collision_offroad` with minus `ade_weight` per metre of ADE. The paper does not give the weight."""
    ade = scores.rollout_displacement_error
    return leave_one_out(-(scores.rollout_collision_rate + scores.rollout_offroad_rate + ade_weight * ade))


@register_shares("collision_offroad_ade")
def collision_offroad_ade_shares(
    scores: AgentScores, rollouts: Rollouts, batch: ScenarioBatch, *, ade_weight: float = 0.1
) -> Float[Tensor, "B N A"]:
    """Each agent's own."""
    return leave_one_out(-(scores.collision + scores.offroad + ade_weight * scores.displacement_error))
