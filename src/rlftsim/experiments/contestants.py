"""Who takes part in an experiment: baselines, base models, and what fine-tuning makes of them. Descriptions only, nothing runs here."""

from dataclasses import dataclass, replace
from typing import Literal

from rlftsim.policies.smart.config import GoalSight
from rlftsim.recipes.smart import SmartRecipe
from rlftsim.training.catk import CatkConfig
from rlftsim.training.finetune import FinetuneConfig
from rlftsim.training.gcsl import GcslConfig
from rlftsim.training.goals import GoalConfig, with_goals_asked
from rlftsim.training.rewards import CreditTo

WEAK_EPOCHS = 1.0
"""Pre-training of the paper's weaker base model."""


@dataclass(frozen=True)
class Baseline:
    """Somebody without weights."""

    name: Literal["oracle", "constant_velocity"]


@dataclass(frozen=True)
class Base:
    """A pre-trained model."""

    epochs: float | None = None
    """None = as the recipe has it, or the model that was handed in."""

    @property
    def name(self) -> str:
        """Of its files."""
        return "base" if self.epochs is None else f"base-{self.epochs:g}-epochs"


GoalKind = Literal["soft", "hard"]


@dataclass(frozen=True)
class GoalTraining:
    """How a model learns to follow goals."""

    sight: GoalSight
    """How it sees them."""
    kind: GoalKind | None = None
    """What is rewarded: coming by, or being there in the end. None = nothing, it is told where its own rollouts led."""
    weight: float = 0.1
    """Of goals in the reward (lambda)."""
    aim: bool = True
    """Tokens are weighed by where they lead, too; False = as in the paper."""

    @property
    def name(self) -> str:
        """Of its files, without the weight."""
        return "-".join([self.sight, *([self.kind] if self.kind else []), *([] if self.aim else ["no-aim"])])


@dataclass(frozen=True)
class FineTuned:
    """A base model after fine-tuning. Everything that is not said here is the recipe's: all have the same budget."""

    method: str = "mloo"
    """A reward's name, or "catk" or "gcsl"."""
    credit: CreditTo = "rollout"
    """Whom the reward is owed to."""
    seed: int = 0
    share: float = 1.0
    """Of the recipe's fine-tuning epochs."""
    base: "Base | FineTuned" = Base()
    """What the fine-tuning starts from."""
    goals: GoalTraining | None = None
    """None = goal-free."""

    @property
    def name(self) -> str:
        """Of its files, without how long it was trained."""
        credit = "" if self.credit == "rollout" else f"-{self.credit}"
        base = "" if self.base == Base() else f"-from-{self.base.name}"
        goals = "" if self.goals is None else f"-{self.goals.name}"
        return f"{self.method}{goals}{credit}{base}-seed{self.seed}"


@dataclass(frozen=True)
class Guided:
    """A fine-tuned model that follows goals more closely than it learned to, see `SmartPolicy.guided`."""

    of: FineTuned
    times: float

    @property
    def name(self) -> str:
        """Of its files."""
        return f"{self.of.name}-guided-{self.times:g}"


CATK, GCFT, GCSL = "catk", "gcft", "gcsl"
VARIED = (
    "finetune.reward", "finetune.credit", "finetune.seed", "catk.seed", "catk.epochs", "catk.batch_size", "gcsl.seed",
)  # fmt: skip
"""Fields of a recipe that contestants set for themselves."""
Contestant = Baseline | Base | FineTuned | Guided
ORACLE, CONSTANT_VELOCITY, BASE = Baseline("oracle"), Baseline("constant_velocity"), Base()


def over_seeds(contestant: FineTuned, num_seeds: int) -> tuple[FineTuned, ...]:
    """The same with seeds 0, 1, ..."""
    return tuple(replace(contestant, seed=seed) for seed in range(num_seeds))


def finetune_config(contestant: FineTuned, recipe: FinetuneConfig) -> FinetuneConfig:
    """How a contestant is fine-tuned with a reward.

    Raises:
        ConfigError: there is no such reward.
    """
    reward, goals = contestant.method, GoalConfig()
    if contestant.goals is not None:
        reward = f"{contestant.method}(goal_weight={contestant.goals.weight}, kind='{contestant.goals.kind}')"
        goals = with_goals_asked(recipe.goals)
    return replace(
        recipe, reward=reward, seed=contestant.seed, epochs=recipe.epochs * contestant.share, credit=contestant.credit, goals=goals,
    )  # fmt: skip


def catk_config(contestant: FineTuned, recipe: SmartRecipe) -> CatkConfig:
    """How a contestant is fine-tuned with CAT-K: the recipe's way, for as many updates of as many scenarios as with a reward."""
    epochs = recipe.finetune.epochs * contestant.share
    return replace(recipe.catk, seed=contestant.seed, epochs=epochs, batch_size=recipe.finetune.batch_size)


def gcsl_config(contestant: FineTuned, recipe: GcslConfig) -> GcslConfig:
    """How a contestant learns what goals are."""
    return replace(recipe, seed=contestant.seed, epochs=recipe.epochs * contestant.share)
