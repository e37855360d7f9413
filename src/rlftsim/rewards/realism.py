"""Rewards from realism scores: the paper's MLOO, and those that the paper compares with, leave-one-out each."""

from jaxtyping import Float
from torch import Tensor

from rlftsim.realism import AgentScores, RealismResult
from rlftsim.rewards.base import check_num_rollouts, leave_one_out, register_agent_rewards, register_reward
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


@register_reward("rloo")
def rloo(realism: RealismResult, rollouts: Rollouts, batch: ScenarioBatch) -> Float[Tensor, "B N"]:
    """RMM of the rollout alone minus the mean over the other rollouts (RLFTSim, section 4.1).

    Args:
        realism: Scores of the same rollouts, a row per scenario.
        rollouts: Rollouts behind the scores; not read here.
        batch: Scenarios of the rollouts; not read here.
    """
    return leave_one_out(realism.single_meta_metric)


@register_agent_rewards("rloo")
def rloo_by_agent(agents: AgentScores, rollouts: Rollouts, batch: ScenarioBatch) -> Float[Tensor, "B N A"]:
    """Split of `rloo` by the logarithmic mean (`realism.credit`).

    Args:
        agents: Shares of each agent in the scores of single rollouts.
        rollouts: Rollouts behind the scores; not read here.
        batch: Scenarios of the rollouts; not read here.
    """
    return agents.single


@register_reward("minade_rloo")
def minade_rloo(realism: RealismResult, rollouts: Rollouts, batch: ScenarioBatch) -> Float[Tensor, "B N"]:
    """Minus the rollout's ADE, m, leave-one-out (RLFTSim, section 5.3).

    The ADE is the evaluator's, a mean over evaluated agents and all valid steps of the log, the history (without error)
    included.

    Args:
        realism: Scores of the same rollouts, a row per scenario.
        rollouts: Rollouts behind the scores; not read here.
        batch: Scenarios of the rollouts; not read here.
    """
    return leave_one_out(-realism.rollout_displacement_error)


@register_agent_rewards("minade_rloo")
def minade_rloo_by_agent(agents: AgentScores, rollouts: Rollouts, batch: ScenarioBatch) -> Float[Tensor, "B N A"]:
    """Displacement error of each agent.

    Args:
        agents: Shares of each agent in the displacement error of the rollouts.
        rollouts: Rollouts behind the scores; not read here.
        batch: Scenarios of the rollouts; not read here.
    """
    return leave_one_out(-agents.displacement_error)


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
