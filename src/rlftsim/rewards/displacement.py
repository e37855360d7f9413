"""The imitation reward that the paper compares with: minus the distance from the log."""

from jaxtyping import Float
from torch import Tensor

from rlftsim.realism import AgentScores, RealismResult
from rlftsim.rewards.base import leave_one_out, register_agent_rewards, register_reward
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch


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
