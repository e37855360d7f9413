"""The heuristic rewards that the paper compares with: no collisions, on the road, and near the log if weighted so."""

from jaxtyping import Float
from torch import Tensor

from rlftsim.realism import AgentScores, RealismResult
from rlftsim.rewards.base import leave_one_out, register_agent_rewards, register_reward
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch


@register_reward("collision_offroad")
def collision_offroad(realism: RealismResult, rollouts: Rollouts, batch: ScenarioBatch) -> Float[Tensor, "B N"]:
    """Minus the fractions of evaluated agents that ever collide and that ever leave the road, leave-one-out.

    Args:
        realism: Scores of the same rollouts, a row per scenario.
        rollouts: Rollouts behind the scores; not read here.
        batch: Scenarios of the rollouts; not read here.
    """
    return leave_one_out(-(realism.rollout_collision_rate + realism.rollout_offroad_rate))


@register_agent_rewards("collision_offroad")
def collision_offroad_by_agent(agents: AgentScores, rollouts: Rollouts, batch: ScenarioBatch) -> Float[Tensor, "B N A"]:
    """Collisions and off-road driving of each agent. A collision of two evaluated agents counts for both.

    Args:
        agents: Shares of each agent in the collision and off-road rates of the rollouts.
        rollouts: Rollouts behind the scores; not read here.
        batch: Scenarios of the rollouts; not read here.
    """
    return leave_one_out(-(agents.collision + agents.offroad))


@register_reward("collision_offroad_ade")
def collision_offroad_ade(
    realism: RealismResult, rollouts: Rollouts, batch: ScenarioBatch, *, ade_weight: float = 0.1
) -> Float[Tensor, "B N"]:
    """Reward `collision_offroad` with the displacement error added.

    Args:
        realism: Scores of the same rollouts, a row per scenario.
        rollouts: Rollouts behind the scores; not read here.
        batch: Scenarios of the rollouts; not read here.
        ade_weight: Reward per meter of ADE, subtracted; the paper gives no number.
    """
    ade = realism.rollout_displacement_error
    return leave_one_out(-(realism.rollout_collision_rate + realism.rollout_offroad_rate + ade_weight * ade))


@register_agent_rewards("collision_offroad_ade")
def collision_offroad_ade_by_agent(
    agents: AgentScores, rollouts: Rollouts, batch: ScenarioBatch, *, ade_weight: float = 0.1
) -> Float[Tensor, "B N A"]:
    """Incidents and displacement error of each agent.

    Args:
        agents: Shares of each agent in the rates and the displacement error of the rollouts.
        rollouts: Rollouts behind the scores; not read here.
        batch: Scenarios of the rollouts; not read here.
        ade_weight: Reward per meter of displacement error, subtracted, the same as in the reward itself.
    """
    return leave_one_out(-(agents.collision + agents.offroad + ade_weight * agents.displacement_error))
