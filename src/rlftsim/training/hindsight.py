"""Hindsight within an update of fine-tuning with goals.

Reaching a goal may be too rare to learn from. But every rollout gets somewhere: the rollouts of a scenario are looked at again as if other
goals had been asked, ones that are known to be met. They were sampled under the first goals, so what each agent's decisions earn is
weighted by how much likelier they are under the others (hindsight policy gradient, Rauber et al., 2019; RLFTSim, section 4.2).
`training.augment` uses the same idea before training.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from rlftsim.goals.types import Goals
from rlftsim.realism import RealismResult
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.training.augment import ends_of, most_realistic
from rlftsim.training.experience import Experience
from rlftsim.training.goals import HindsightGoals
from rlftsim.training.rewards import Rewards

LARGEST_RATIO = 10.0
"""Ratios of probabilities are clipped to it."""
Measure = Callable[[ScenarioBatch, Rollouts], tuple[RealismResult, Rewards]]
"""Scores of rollouts, and what they earn."""


def look_back(experiences: Sequence[Experience], measure: Measure, goals: HindsightGoals) -> list[Experience]:
    """The rollouts as if they had been sampled under goals that are met, rewarded for these.

    Args:
        experiences: of this process.
        measure: scores and rewards of rollouts.
        goals: whose ends they are, see `GoalConfig.hindsight_goals`.
    """
    seen = [replace(e.rollouts, goals=met_goals(e.rollouts, e.scores, goals)) for e in experiences]
    return [Experience(e.batch, rollouts, *measure(e.batch, rollouts)) for e, rollouts in zip(experiences, seen)]


def met_goals(rollouts: Rollouts, scores: RealismResult, goals: HindsightGoals) -> Goals:
    """For the agents that have goals: where their own rollout took them, or the most realistic one of their scenario."""
    assert rollouts.goals is not None
    if goals == "own":
        return Goals(rollouts.position[..., -1, :], rollouts.goals.goal_mask)
    ends = Goals.of_scenarios(ends_of(rollouts, most_realistic(scores)), rollouts.goals.goal_mask[:, 0])
    return ends.repeat(rollouts.num_rollouts)


def clipped_ratio(new: Float[Tensor, "B N A"], old: Float[Tensor, "B N A"]) -> Float[Tensor, "B N A"]:
    """How much likelier each agent's decisions are under other goals: the ratio of their probabilities, clipped, without gradient.

    Args:
        new: log-probability of all of an agent's decisions under the other goals.
        old: under those that were asked.
    """
    return (new - old).detach().clamp(max=math.log(LARGEST_RATIO)).exp()
