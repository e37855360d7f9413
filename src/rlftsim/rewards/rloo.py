"""REINFORCE leave-one-out on the meta-metric of single rollouts."""

from jaxtyping import Float
from torch import Tensor

from rlftsim.realism import AgentScores, RealismResult
from rlftsim.rewards.base import leave_one_out, register_agent_rewards, register_reward
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch


@register_reward("rloo")
def rloo(realism: RealismResult, rollouts: Rollouts, batch: ScenarioBatch) -> Float[Tensor, "B N"]:
    """RMM of the rollout alone minus the mean of the others' (RLFTSim, section 4.1).

    Args:
        realism: of the rollouts.
        rollouts: not used.
        batch: not used.
    """
    return leave_one_out(realism.single_meta_metric)


@register_agent_rewards("rloo")
def rloo_by_agent(agents: AgentScores, rollouts: Rollouts, batch: ScenarioBatch) -> Float[Tensor, "B N A"]:
    """Split of `rloo` by the logarithmic mean (`realism.credit`).

    Args:
        agents: the rollouts' scores by agent.
        rollouts: not used.
        batch: not used.
    """
    return agents.single
