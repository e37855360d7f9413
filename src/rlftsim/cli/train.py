"""Verbs that make and change models: pretrain, finetune."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from rlftsim.cli.data import open_split, splits_of
from rlftsim.errors import ConfigError, RlftsimError
from rlftsim.experiments.learning_curve import write_learning_curve
from rlftsim.experiments.stages import NewSight, finetune_with_catk, finetune_with_reward, pretrain_smart, teach_goals
from rlftsim.policies.smart.config import GoalSight
from rlftsim.progress import say
from rlftsim.recipes.configure import Override, configure
from rlftsim.recipes.smart import RECIPES, RecipeName
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.tokens.vocabulary import Vocabulary
from rlftsim.training.gcsl import NOT_VALIDATED
from rlftsim.training.parallel import is_first_process

AIM = {"yes": True, "no": False, None: None}
VALIDATION = "validation"
"""Split that is validated on where none is named."""


@dataclass(frozen=True)
class Pretrain:
    """Train a model to predict the next motion token of every agent.

    Interrupted in any way, the same command goes on where it was. The result is in OUT/model.
    """

    recipe: Positional[RecipeName]
    data: str
    """Folder of a data set, or "synthetic"."""
    out: Path
    """Folder of the run: configuration, metrics, checkpoints, model."""
    vocabulary: Path
    """File that `rlftsim tokens` wrote."""
    split: str = "training"
    validation_split: str | None = None
    """What to validate on in closed loop, every so many updates: see pretrain.validation.every, which is 0 (never). Left out,
    "validation" where the data set has it."""
    set: list[Override] = field(default_factory=list)
    """Other values for fields of the recipe, e.g. pretrain.epochs=2 model.dim=64."""

    def run(self) -> int:
        """Build the model and train it."""
        recipe = configure(RECIPES[self.recipe](), self.set, sections=("model", "pretrain"))
        scenarios = open_split(self.data, self.split)
        vocabulary = Vocabulary.load(self.vocabulary)
        held_out = _held_out(self.data, self.validation_split, recipe.pretrain.validation.every)
        with _drawn(self.out):
            model = pretrain_smart(vocabulary, scenarios, recipe.model, recipe.pretrain, self.out, held_out=held_out)
        print(f"model: {model}")
        return 0


def _held_out(data: str, split: str | None, every: int) -> ScenarioDataset | None:
    """Scenarios to validate on; None = none are asked for, or the data set has no such split and none was named.

    Raises:
        ConfigError: a split is named, but there is no validation.
        DataError: no such split.
    """
    if split is not None and not every:
        raise ConfigError(f"--validation-split {split} has no effect: set validation.every to a number of updates.")
    if not every:
        return None
    if split is None and VALIDATION not in splits_of(data):
        say(f"no validation: {data} has no split {VALIDATION!r}, name another with --validation-split.")
        return None
    return open_split(data, split or VALIDATION)


@contextmanager
def _drawn(out: Path) -> Iterator[None]:
    """A run whose learning curve is drawn however it ends."""
    try:
        yield
    except BaseException:
        with suppress(RlftsimError, OSError):  # why the run ended matters more than why nothing could be drawn
            _draw(out)
        raise
    _draw(out)


def _draw(out: Path) -> None:
    if is_first_process():
        write_learning_curve(out)


@dataclass(frozen=True)
class Finetune:
    """Fine-tune a model closed-loop: with a realism reward (RLFTSim), as a baseline with CAT-K, or on where its own rollouts led.

    Interrupted in any way, the same command goes on where it was. The result is in OUT/model.
    """

    recipe: Positional[RecipeName]
    model: str
    """Model folder to start from; rlft holds on to it as its reference, too."""
    data: str
    """Folder of a data set, or "synthetic"."""
    out: Path
    """Folder of the run: configuration, metrics, checkpoints, model."""
    method: Literal["rlft", "catk", "gcsl"] = "rlft"
    """rlft: policy gradient of a realism reward, fields finetune.*. catk: imitation along rollouts that keep near the record, the
    closest among the top K tokens, fields catk.*. gcsl: learn what goals are from the model's own rollouts, told where they ended, before
    rlft with goals (--model OUT); trains only the weights that see goals, fields gcsl.*."""
    goal: GoalSight | None = None
    """Fine-tune with goals: how the model is to see them, concat or indication. Every agent is asked to go where its record ends; rlft then
    takes the reward gcft (see finetune.goals for other goals), catk trains only the weights that see goals. Left out, the model keeps the
    sight it has."""
    goal_aim: Literal["yes", "no"] | None = None
    """With --goal: weigh tokens by where they lead, too (an aim, not in the paper). Left out, a model that is given sight of goals gets one,
    and a model that sees goals keeps what it has."""
    split: str = "training"
    validation_split: str | None = None
    """For catk: what to validate on, see catk.validation.every, which is 0 (never). Left out, "validation" where the data set has it."""
    set: list[Override] = field(default_factory=list)
    """Other values for fields of the recipe, e.g. finetune.learning-rate=1e-5 finetune.reward=rloo, or catk.num-candidates=16."""

    def run(self) -> int:
        """Load the model and fine-tune it."""
        section = "finetune" if self.method == "rlft" else self.method
        recipe = RECIPES[self.recipe]()
        if self.goal is not None:
            recipe = recipe.with_goals()
        elif self.goal_aim is not None:
            raise ConfigError(f"--goal-aim {self.goal_aim} has no effect: name a --goal.")
        recipe = configure(recipe, self.set, sections=(section,))
        scenarios = open_split(self.data, self.split)
        if self.method == "gcsl" and self.validation_split:
            raise ConfigError(f"--validation-split {self.validation_split} has no effect: {NOT_VALIDATED}")
        every = recipe.catk.validation.every if self.method == "catk" else 0
        held_out = _held_out(self.data, self.validation_split, every)
        sight = None if self.goal is None else NewSight(self.goal, AIM[self.goal_aim])
        with _drawn(self.out):
            match self.method:
                case "rlft":
                    model = finetune_with_reward(self.model, scenarios, recipe.finetune, self.out, sight=sight)
                case "catk":
                    model = finetune_with_catk(
                        self.model, scenarios, recipe.catk, self.out, sight=sight, held_out=held_out
                    )
                case "gcsl":
                    model = teach_goals(self.model, scenarios, recipe.gcsl, self.out, sight=sight)
        print(f"model: {model}")
        return 0
