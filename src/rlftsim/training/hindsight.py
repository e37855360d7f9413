"""Hindsight within an update of fine-tuning with goals.

Reaching a goal may be too rare to learn from. But every rollout gets somewhere: the rollouts of a scenario are looked at again as if the
goals had been where the most realistic of them ended. They were sampled under other goals, so what each agent's decisions earn is
weighted by how much likelier they are under the new ones (hindsight policy gradient, Rauber et al., 2019; RLFTSim, section 4.2).
`training.augment` uses the same idea before training.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from jaxtyping import Float
from torch import Tensor

from rlftsim.goals.types import Goals
from rlftsim.realism import RealismResult
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.training.augment import ends_of, most_realistic
from rlftsim.training.experience import Experience, slices
from rlftsim.training.rewards import Term
from rlftsim.training.rewards.goal import goal_advantage

LARGEST_RATIO = 10.0
"""Ratios of probabilities are clipped to it."""


@dataclass(frozen=True, eq=False)
class Relabelled:
    """Rollouts under other goals than they were sampled under."""

    batch: ScenarioBatch
    rollouts: Rollouts
    earned: Float[Tensor, "B N A"]
    """By each agent for the goals."""

    def slices(self, size: int) -> Iterator[tuple[Rollouts, Float[Tensor, "B n A"]]]:
        """So many of the rollouts of every scenario at once, and what each agent in them earned."""
        return slices(self.rollouts, self.earned, size)


def look_back(experiences: Sequence[Experience], terms: Sequence[Term]) -> list[Relabelled]:
    """The rollouts as if they had been sampled under the goals that the most realistic one has met, and what that earns.

    Realism was rewarded before and does not depend on goals, so only goals count here; each agent earns its own share, because
    each agent's decisions have a ratio of their own.

    Args:
        experiences: of this process.
        terms: of the run's reward.
    """
    return [_relabel(experience, terms) for experience in experiences]


def _relabel(experience: Experience, terms: Sequence[Term]) -> Relabelled:
    batch, rollouts = experience.batch, experience.rollouts
    seen = replace(rollouts, goals=met_goals(rollouts, experience.scores))
    earned = rollouts.heading.new_zeros(rollouts.heading.shape[:3])
    for term in goal_terms(terms):
        earned = earned + term.weight * goal_advantage(seen, batch, **dict(term.options))  # type: ignore[arg-type]
    return Relabelled(batch, seen, earned)


def goal_terms(terms: Sequence[Term]) -> list[Term]:
    """The terms of a reward that goals matter to."""
    return [term for term in terms if term.name == "goal"]


def met_goals(rollouts: Rollouts, scores: RealismResult) -> Goals:
    """For the agents that have goals: where the most realistic rollout of their scenario took them."""
    assert rollouts.goals is not None
    ends = Goals.of_scenarios(ends_of(rollouts, most_realistic(scores)), rollouts.goals.goal_mask[:, 0])
    return ends.repeat(rollouts.num_rollouts)


def clipped_ratio(new: Float[Tensor, "B N A"], old: Float[Tensor, "B N A"]) -> Float[Tensor, "B N A"]:
    """How much likelier each agent's decisions are under other goals: the ratio of their probabilities, clipped, without gradient.

    Args:
        new: log-probability of all of an agent's decisions under the other goals.
        old: under those that were asked.
    """
    return (new - old).detach().clamp(max=math.log(LARGEST_RATIO)).exp()
