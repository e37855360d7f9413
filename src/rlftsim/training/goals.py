"""What agents are asked while a policy is fine-tuned."""

from dataclasses import dataclass, replace
from pathlib import Path

from rlftsim.errors import ConfigError, DataError, require_finite, require_not_negative, require_positive
from rlftsim.goals.recorded import recorded_goals
from rlftsim.goals.stored import StoredGoals
from rlftsim.goals.types import Goals
from rlftsim.progress import say
from rlftsim.rollout.noise import draw_noise
from rlftsim.rollout.policy import Policy, sees_goals
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import Scenarios, scenario_ids_of


@dataclass(frozen=True)
class GoalConfig:
    """Who gets which goals. By default nobody gets any."""

    share: float = 0.0
    """Chance of an agent to get a goal in an update. 1 = everybody that has a recorded future; between 0 and 1 (mixed mode) some have
    goals and some have none, in the same scene."""
    augmented: str | None = None
    """Folder that `rlftsim augment` wrote: goals beside the recorded ones."""
    augmented_share: float = 0.5
    """Chance of a scenario that has such goals to use them instead of where the record ended."""
    hindsight: float = 0.0
    """Weight of the same rollouts under goals that one of them has met (`training.hindsight`); 0 = they are not used so."""
    learning_rate_scale: float = 1.0
    """Of the weights that see goals, which begin at zero, against that of all others."""

    def __post_init__(self) -> None:
        for name in ("share", "augmented_share"):
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigError(f"goals.{name} is a share in [0, 1], got {getattr(self, name)}.")
        require_finite(self, ("hindsight", "learning_rate_scale"))
        require_not_negative(self, ("hindsight",))
        require_positive(self, ("learning_rate_scale",))
        if not self.share and (self.augmented or self.hindsight):
            raise ConfigError("goals.augmented and goals.hindsight need goals: set goals.share above 0, such as 1.")

    def open_augmented(self, scenarios: Scenarios) -> StoredGoals | None:
        """The augmented goals; None = there are none. Says so if some of the scenarios have none.

        Raises:
            DataError: the folder holds no goals, or none of these scenarios.
        """
        if self.augmented is None:
            return None
        stored = StoredGoals(Path(self.augmented))
        count = stored.count_among(scenario_ids_of(scenarios))
        if not count:
            raise DataError(
                f"{self.augmented}: its goals are of other scenarios: write them by `rlftsim augment` with the same data and split."
            )
        if count < len(scenarios):
            say(
                f"{self.augmented}: goals for {count} of {len(scenarios)} scenarios; the others go by their records alone"
            )
        return stored


def with_goals_asked(config: GoalConfig) -> GoalConfig:
    """The same, where it is silent as in the paper: everybody is asked, with hindsight."""
    return replace(config, share=config.share or 1.0, hindsight=config.hindsight or 1.0)


def refuse_goals(policy: Policy, share: float) -> None:
    """Refuse to train a policy with goals that it does not see.

    Raises:
        ConfigError: it does not.
    """
    if share and not sees_goals(policy):
        raise ConfigError(
            f"goals for a share of {share:g}, but this model does not see goals: add --goal concat or --goal indication."
        )


def choose_goals(batch: ScenarioBatch, config: GoalConfig, augmented: StoredGoals | None, *, seed: int) -> Goals | None:
    """The goals of a batch in one update, for a single rollout: all rollouts of a scenario are asked the same.

    Args:
        batch: with futures.
        config: see its fields.
        augmented: goals beside the recorded ones.
        seed: of the update; what a scenario gets depends on it and on the scenario alone.

    Returns:
        None where the fine-tuning is goal-free.
    """
    if not config.share:
        return None
    luck = draw_noise(batch, range(1), seed=seed, purpose="goals", per_agent=2)  # [B, 1, A, 2]
    goals = recorded_goals(batch)
    if augmented is not None:
        others = augmented.of_batch(batch)
        swapped = others.goal_mask.any(-1, keepdim=True) & (luck[:, :, :1, 1] < config.augmented_share)
        goals = others.where(swapped.expand_as(goals.goal_mask), goals)
    return goals.only(luck[..., 0] < config.share)
