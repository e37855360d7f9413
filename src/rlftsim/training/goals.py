"""The goals of agents while a policy is fine-tuned."""

from pathlib import Path

from rlftsim.errors import ConfigError, DataError
from rlftsim.goals.types import Goals, StoredGoals, logged_goals
from rlftsim.jobs.progress import log
from rlftsim.rollout.noise import draw_noise
from rlftsim.rollout.policy import ConditionablePolicy, Policy, is_goal_conditioned
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import Scenarios, list_scenario_ids
from rlftsim.training.config import GoalConfig


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


def open_augmented(config: GoalConfig, scenarios: Scenarios) -> StoredGoals | None:
    """Open the augmented goals; None where there are none. Logs if some of the scenarios have none.

    Args:
        config: Settings of goals, with the folder of augmented goals if any.
        scenarios: Training scenarios.

    Raises:
        DataError: The folder holds no goals, or none of these scenarios.
    """
    if config.augmented is None:
        return None
    # The folder may hold goals of a larger data set, so only these scenarios are counted.
    stored = StoredGoals(Path(config.augmented))
    count = stored.count_among(list_scenario_ids(scenarios))
    if not count:
        raise DataError(
            f"{config.augmented}: its goals are of other scenarios: "
            "write them by `rlftsim augment` with the same data and split."
        )
    if count < len(scenarios):
        log.info(
            f"{config.augmented}: goals for {count} of {len(scenarios)} scenarios; "
            "the others use their logged endpoints alone"
        )
    return stored
