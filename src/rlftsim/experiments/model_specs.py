"""Models that experiments compare: baselines, pre-trained models, and fine-tuned models. Descriptions only,
no training runs here."""

from dataclasses import dataclass, replace
from typing import Literal

from rlftsim.errors import ConfigError
from rlftsim.recipes.base import Recipe
from rlftsim.training.config import CreditTo, FinetuneConfig, GoalConfig, with_goals
from rlftsim.training.method import TrainingSettings

WEAK_EPOCHS = 1.0
"""Pre-training of the paper's weaker base model."""


@dataclass(frozen=True)
class Baseline:
    """A policy without weights: the log, or constant velocity."""

    name: Literal["oracle", "constant_velocity"]


@dataclass(frozen=True)
class Base:
    """A pre-trained model."""

    epochs: float | None = None
    """Of pre-training. None = as the recipe has it, or the base model that the suite was given."""

    @property
    def name(self) -> str:
        """Name of the model's files."""
        return "base" if self.epochs is None else f"base-{self.epochs:g}-epochs"


GoalRewardType = Literal["soft", "hard"]


@dataclass(frozen=True)
class GoalTraining:
    """Goal conditioning that a fine-tuning adds to a model, and the goal reward of the training."""

    encoding: str
    """Encoding of goals, an argument of the policy's `with_goal_conditioning`: SMART has "concat" and "indication"."""
    reward_type: GoalRewardType | None = None
    """Reward for passing the goal (soft) or for ending there (hard). None = no reward: rollouts relabelled
    with their own endpoints are imitated."""
    weight: float = 0.1
    """Of the goal in the reward (lambda)."""

    @property
    def name(self) -> str:
        """Part of the name of the model's files, without the weight."""
        return self.encoding if self.reward_type is None else f"{self.encoding}-{self.reward_type}"


@dataclass(frozen=True)
class FineTuned:
    """A base model after fine-tuning. All further settings are the recipe's, so the budget is equal."""

    method: str = "mloo"
    """Name of a reward, or "catk", "road" or "gcsl"."""
    credit: CreditTo = "rollout"
    """Credit assignment: one reward per rollout, or one per agent."""
    seed: int = 0
    epochs_fraction: float = 1.0
    """Of the recipe's fine-tuning epochs."""
    base: "Base | FineTuned" = Base()
    """Model that the fine-tuning starts from."""
    goals: GoalTraining | None = None
    """None = goal-free."""

    @property
    def name(self) -> str:
        """Name of the model's files, without the epochs."""
        # default values add nothing to a name, which becomes a file's
        credit = "" if self.credit == "rollout" else f"-{self.credit}"
        base = "" if self.base == Base() else f"-from-{self.base.name}"
        goals = "" if self.goals is None else f"-{self.goals.name}"
        return f"{self.method}{goals}{credit}{base}-seed{self.seed}"

    def training_config(self, recipe: Recipe) -> TrainingSettings:
        """Settings of the training, of the type that the method has.

        Raises:
            ConfigError: Unknown reward, or the recipe has no section for the method.
        """
        closed_loop = {CATK: recipe.catk, ROAD: recipe.road}.get(self.method)
        if closed_loop is not None:
            # As many updates of as many scenarios as a fine-tuning with a reward makes.
            epochs, batch_size = recipe.finetune.epochs * self.epochs_fraction, recipe.finetune.batch_size
            return replace(closed_loop, seed=self.seed, epochs=epochs, batch_size=batch_size)
        if self.method == GCSL and recipe.gcsl is not None:
            return replace(recipe.gcsl, seed=self.seed, epochs=recipe.gcsl.epochs * self.epochs_fraction)
        if self.method in (CATK, ROAD, GCSL):
            raise ConfigError(f"the recipe has no section {self.method}: its policies cannot be trained so.")
        return finetune_config(self, recipe.finetune)


@dataclass(frozen=True)
class Guided:
    """A goal-conditioned model with guidance: the goal logit bias is scaled, without training. See
    `SmartPolicy.with_guidance`."""

    of: FineTuned
    scale: float

    @property
    def name(self) -> str:
        """Name of the model's files."""
        return f"{self.of.name}-guided-{self.scale:g}"


ModelSpec = Baseline | Base | FineTuned | Guided
ORACLE, CONSTANT_VELOCITY, BASE = Baseline("oracle"), Baseline("constant_velocity"), Base()
CATK, ROAD, GCFT, GCSL = "catk", "road", "gcft", "gcsl"
VARIED = (
    *("finetune.reward", "finetune.credit", "finetune.seed"),
    *("catk.seed", "catk.epochs", "catk.batch_size", "road.seed", "road.epochs", "road.batch_size", "gcsl.seed"),
)
"""Fields of a recipe that specs set for themselves."""


@dataclass(frozen=True)
class Budget:
    """Budget of every fine-tuned model of a suite."""

    updates: int
    scenarios_an_update: int
    rollouts_a_scenario: int

    def __str__(self) -> str:
        simulated = f"{self.scenarios_an_update} scenarios with {self.rollouts_a_scenario} rollouts each"
        return f"{self.updates} updates of {simulated}"

    @property
    def note(self) -> str:
        """Note for tables with fine-tuned rows."""
        return (
            f"Every fine-tuned row had the same budget: {self}. One base model; the seeds are those of fine-tuning, "
            "evaluations share theirs."
        )


def over_seeds(spec: FineTuned, num_seeds: int) -> tuple[FineTuned, ...]:
    """The same fine-tuning with several seeds: a row of a table.

    Args:
        spec: Fine-tuning of any seed, which is replaced.
        num_seeds: Number of seeds, which are 0, 1, ..., num_seeds - 1.
    """
    return tuple(replace(spec, seed=seed) for seed in range(num_seeds))


def finetune_config(spec: FineTuned, recipe: FinetuneConfig) -> FinetuneConfig:
    """Settings of a fine-tuning with a reward.

    Args:
        spec: Fine-tuning with the name of the reward as method.
        recipe: Settings that the spec leaves open. Without a goal training in the spec, goals are switched off.

    Raises:
        ConfigError: Unknown reward.
    """
    # Goals of the recipe are for goal-conditioned rows alone.
    reward, goals = spec.method, GoalConfig()
    if spec.goals is not None:
        reward = f"{spec.method}(goal_weight={spec.goals.weight}, kind='{spec.goals.reward_type}')"
        goals = with_goals(recipe.goals)
    epochs = recipe.epochs * spec.epochs_fraction
    constraints = recipe.constraints if spec.goals is None else ()  # goals ask for a speed
    return replace(
        recipe, reward=reward, seed=spec.seed, epochs=epochs, credit=spec.credit, goals=goals, constraints=constraints
    )
