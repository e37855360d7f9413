"""REINFORCE leave-one-out on the meta-metric of single rollouts."""

from jaxtyping import Float
from torch import Tensor

from rlftsim.realism import AgentScores, RealismResult
from rlftsim.rewards.base import leave_one_out, register_agent_rewards, register_reward
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch


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
