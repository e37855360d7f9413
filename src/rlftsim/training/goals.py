"""The goals of agents while a policy is fine-tuned."""

from dataclasses import dataclass, replace
from pathlib import Path

from rlftsim.errors import ConfigError, DataError, check_finiteness, check_not_negative, check_positive, check_types
from rlftsim.goals.stored import StoredGoals
from rlftsim.goals.types import Goals, logged_goals
from rlftsim.jobs.progress import log
from rlftsim.rollout.noise import draw_noise
from rlftsim.rollout.policy import ConditionablePolicy, Policy, is_goal_conditioned
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import Scenarios, list_scenario_ids


@dataclass(frozen=True)
class GoalConfig:
    """Goals of the agents in training. By default there are none."""

    probability: float = 0.0
    """Probability of an agent to have a goal in an update. 1 = all agents with a logged future; between 0 and 1 (mixed
    mode) agents with and without goals meet in the same scene."""
    augmented: str | None = None
    """Folder that `rlftsim augment` wrote: goals beside the logged endpoints."""
    augmented_probability: float = 0.5
    """Probability of a scenario that has augmented goals to use them instead of the logged endpoints."""
    hindsight: float = 0.0
    """Weight of the same rollouts relabelled with goals that one of them has met; 0 = they are not used again."""
    learning_rate_scale: float = 1.0
    """Learning rate of the goal encoder, whose weights begin at zero, over that of all other weights."""

    def __post_init__(self) -> None:
        check_types(self)
        for name in ("probability", "augmented_probability"):
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigError(f"goals.{name} is a probability in [0, 1], got {getattr(self, name)}.")
        check_finiteness(self, ("hindsight", "learning_rate_scale"))
        check_not_negative(self, ("hindsight",))
        check_positive(self, ("learning_rate_scale",))
        if not self.probability and (self.augmented or self.hindsight):
            raise ConfigError(
                "goals.augmented and goals.hindsight need goals: set goals.probability above 0, such as 1."
            )

    def open_augmented(self, scenarios: Scenarios) -> StoredGoals | None:
        """Open the augmented goals; None where there are none. Logs if some of the scenarios have none.

        Raises:
            DataError: the folder holds no goals, or none of these scenarios.
        """
        if self.augmented is None:
            return None
        # The folder may hold goals of a larger data set, so only these scenarios are counted.
        stored = StoredGoals(Path(self.augmented))
        count = stored.count_among(list_scenario_ids(scenarios))
        if not count:
            raise DataError(
                f"{self.augmented}: its goals are of other scenarios: "
                "write them by `rlftsim augment` with the same data and split."
            )
        if count < len(scenarios):
            log.info(
                f"{self.augmented}: goals for {count} of {len(scenarios)} scenarios; "
                "the others use their logged endpoints alone"
            )
        return stored


def with_goals(config: GoalConfig) -> GoalConfig:
    """The same settings, with goals for all agents and hindsight, each where off so far."""
    return replace(config, probability=config.probability or 1.0, hindsight=config.hindsight or 1.0)


def check_goals(policy: Policy, probability: float) -> None:
    """Refuse to train a policy with goals unless goal-conditioned.

    Args:
        policy: Policy that a run is going to train.
        probability: Probability of an agent to have a goal; 0 = goal-free training, which any policy can do.

    Raises:
        ConfigError: the policy is not goal-conditioned.
    """
    if probability and not is_goal_conditioned(policy):
        raise ConfigError(f"goals with probability {probability:g}, but {not_conditioned(policy)}")


def not_conditioned(policy: object) -> str:
    """The reason why a policy has no goals, and the way out, for a message."""
    if isinstance(policy, ConditionablePolicy):
        return "this model is not goal-conditioned: add --goal concat or --goal indication."
    return f"a {type(policy).__name__} cannot be given goals: take a model that can, such as demo-goals."


def choose_goals(batch: ScenarioBatch, config: GoalConfig, augmented: StoredGoals | None, *, seed: int) -> Goals | None:
    """Goals of a batch in one update, with N = 1: all rollouts of a scenario have the same goals.

    Args:
        batch: Scenarios with logged futures.
        config: Probabilities of goals and of augmented goals.
        augmented: Stored goals beside the logged endpoints; None = endpoints alone.
        seed: Seed of the update; the goals of a scenario do not depend on the rest of the batch.

    Returns:
        None where the fine-tuning is goal-free.
    """
    if not config.probability:
        return None
    u = draw_noise(batch, range(1), seed=seed, purpose="goals", per_agent=2)  # [B, 1, A, 2], uniform
    goals = logged_goals(batch)
    if augmented is not None:
        augmented_goals = augmented.of_batch(batch)
        # One draw for a whole scenario, that of its first agent: endpoints of the log and of a rollout do not mix.
        is_augmented = augmented_goals.goal_mask.any(-1, keepdim=True) & (u[:, :, :1, 1] < config.augmented_probability)
        goals = augmented_goals.where(is_augmented.expand_as(goals.goal_mask), goals)
    # Noise in [0, 1): with probability 1 every agent that has a logged endpoint gets it as its goal.
    return goals.only(u[..., 0] < config.probability)
