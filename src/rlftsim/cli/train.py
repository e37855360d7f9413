"""Verbs that train models: pretrain, finetune."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import tyro
from tyro.conf import Positional

from rlftsim.cli.recipe_verb import Processes, RecipeVerb, refuse_settings, value_of
from rlftsim.errors import ConfigError, RlftsimError
from rlftsim.evaluation.calibration_picture import write_calibration_picture
from rlftsim.evaluation.learning_curve import write_learning_curve
from rlftsim.jobs.progress import log
from rlftsim.policies.registry import load_policy
from rlftsim.recipes.base import Recipe
from rlftsim.recipes.train import GoalConditioning, finetune_model, pretrain_policy
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.open import list_splits, open_dataset
from rlftsim.tokens.vocabulary import Vocabulary
from rlftsim.training.goal_relabeling import NOT_VALIDATED
from rlftsim.training.parallel import is_first_process
from rlftsim.training.registry import METHODS, method_by_name

VALIDATION = "validation"
"""Split that is validated on where none is named."""
ClassName = Literal["vehicle", "pedestrian", "cyclist"]
RecipeArgument = Annotated[Positional[str], tyro.conf.arg(metavar="RECIPE")]


@dataclass(frozen=True)
class Pretrain(RecipeVerb):
    """Train a model on logged tracks (SMART: to predict the next motion token of every agent), from fresh weights or
    further (--init-from).

    Writes checkpoints, metrics and the finished model, OUT/model. An interrupted run continues when the same
    command is repeated.
    """

    sections: ClassVar[tuple[str, ...]] = ("model", "pretrain")

    recipe: RecipeArgument
    """Model and training settings; `rlftsim recipe` lists all recipes. The flags below change single fields."""
    data: str
    """Folder of a data set, or "synthetic" for the scenarios that ship with the package."""
    out: Path
    """Folder of the run: configuration, metrics, checkpoints, model."""
    vocabulary: Path | None = None
    """File that `rlftsim tokens` wrote; needed by models with a vocabulary, such as SMART. With --init-from its motion
    tokens take the places of the most similar ones of the model, which keeps its map pieces."""
    keep_tokens: list[ClassName] = field(default_factory=list)
    """Classes whose tokens stay those of --init-from, with --vocabulary."""
    init_from: str | None = None
    """Model to train further, such as one of synthetic scenarios on logs: a run, a model folder or a registered name.
    It brings its vocabulary (but see --vocabulary) and the settings --model.*; flags change those that its weights do
    not depend on, such as the number of neighbors. Left out: fresh weights."""
    processes: Processes = None
    """Processes that train, in short for --pretrain.device.processes."""
    split: str = "training"
    """Split of the data set to train on."""
    validation_split: str | None = None
    """Split to validate on in closed loop, see --pretrain.validation.every. Left out: "validation", if the data
    set has it."""
    config: Path | None = None
    """JSON file of settings: the output of `rlftsim recipe NAME --json`, or the config.json of an earlier run. The
    latter holds only the section pretrain: sizes of the model are those of RECIPE and the flags --model.*. A run
    repeated from its own config.json, with the same recipe, flags of the model, vocabulary and data, gives the same
    weights bit for bit. Flags override the file."""

    @classmethod
    def recipe_for(cls, name: str, words: Sequence[str]) -> Recipe:
        """The recipe of a command line, for models like the one that is trained further, if there is one.

        Args:
            name: of the recipe.
            words: the words behind the verb.
        """
        recipe, start = super().recipe_for(name, words), value_of("--init-from", words)
        # A recipe of another package may know no models but its own: those are trained further as they are.
        return recipe if start is None or type(recipe).like is Recipe.like else recipe.like(load_policy(start))

    @classmethod
    def sections_in_file(cls, words: Sequence[str]) -> tuple[str, ...]:
        """Sections that are read from the file of settings; a model that is trained further has its own sizes."""
        return ("pretrain",) if value_of("--init-from", words) else cls.sections

    def refuse_useless(self, flags: Sequence[str]) -> None:
        """Refuse what a model that is trained further brings along.

        Raises:
            ConfigError: tokens are to be kept where there are none or no others, or a flag would change what the
                weights are made for.
        """
        if self.keep_tokens and (self.init_from is None or self.vocabulary is None):
            raise ConfigError("--keep-tokens has no effect without both --init-from and --vocabulary: leave it out.")
        if self.init_from is None:
            return
        free = self.starting_recipe.free_fields
        for flag in flags:
            name = flag.removeprefix("--model.").replace("-", "_")
            if flag.startswith("--model.") and name not in free:
                raise ConfigError(
                    f"{flag} cannot be changed with --init-from {self.init_from}, whose weights are made for it; these "
                    f"can: {', '.join('--model.' + one.replace('_', '-') for one in free) or 'none'}."
                )

    def run(self) -> int:
        """Build or load the model and train it."""
        recipe = self.settings
        if self.vocabulary is None and recipe.tokens is not None and self.init_from is None:
            raise ConfigError(
                f"recipe {self.recipe} needs a vocabulary: build one with `rlftsim tokens`, then name it with "
                "--vocabulary, or train a model further with --init-from."
            )
        if self.vocabulary is not None and recipe.tokens is None:
            raise ConfigError(f"recipe {self.recipe} makes a model without a vocabulary: leave --vocabulary out.")
        scenarios = open_dataset(self.data, self.split)
        vocabulary = Vocabulary.load(self.vocabulary) if self.vocabulary else None
        held_out = _held_out(self.data, self.validation_split, recipe.pretrain.validation.every)
        # The curve is drawn of interrupted runs, too.
        with _learning_curve(self.out):
            start = load_policy(self.init_from) if self.init_from else None
            if start is None:
                policy = recipe.new_policy(vocabulary)
            elif vocabulary is None:  # all that recipes of other packages may know
                policy = recipe.train_further(start)
            else:
                policy = recipe.train_further(start, vocabulary, self.keep_tokens)
            model = pretrain_policy(
                policy, scenarios, recipe.pretrain, self.out, start=self.init_from, held_out=held_out
            )
        print(f"model: {model}")
        return 0


@dataclass(frozen=True)
class Finetune(RecipeVerb):
    """Fine-tune a model in closed loop: by policy gradient on a realism reward (RLFTSim), by CAT-K, by RoaD or by
    calibration.

    Example: rlftsim finetune smart-tiny --model runs/base --data data/womd --out runs/tuned --finetune.epochs 0.5

    Writes checkpoints, metrics and the finished model, OUT/model. An interrupted run continues when the same
    command is repeated.
    """

    sections: ClassVar[tuple[str, ...]] = ("finetune", "catk", "road", "gcsl", "calibrate")

    recipe: RecipeArgument
    """Settings to start from; `rlftsim recipe` lists all recipes. The flags below change single fields. The
    model brings its own architecture, so any recipe fits any model."""
    model: str
    """Model to start from: a run, a model folder or a registered name. rlft also uses it as the frozen KL reference."""
    data: str
    """Folder of a data set, or "synthetic" for the scenarios that ship with the package."""
    out: Path
    """Folder of the run: configuration, metrics, checkpoints, model."""
    method: Annotated[str, tyro.conf.arg(metavar="rlft|catk|road|gcsl|calibrate|NAME")] = "rlft"
    """rlft: policy gradient on a realism reward, fields finetune.*. catk: supervised fine-tuning along rollouts
    that choose the token closest to the log among the top K, fields catk.*. road: supervised
    fine-tuning on the model's own rollouts, guided by the log, fields road.*. gcsl: train the goal-conditioned
    weights on the model's own rollouts, relabelled with their endpoints, as a start for rlft with goals
    (--model OUT), fields gcsl.*. calibrate: fit the weights of a few named features on the token logits, no weight of
    the model, to a realism reward without a change of speed, fields calibrate.*. Another NAME: the method that another
    package has registered, fields NAME.*."""
    goal: Literal["concat", "indication"] | None = None
    """Fine-tune with goals, and how the model encodes them. Every agent's goal is its logged endpoint (see
    --finetune.goals.augmented for others). rlft then uses the reward gcft, catk trains the goal-conditioned
    weights alone. Left out, the model keeps the goal conditioning it has."""
    goal_logit_bias: Annotated[bool | None, tyro.conf.arg(metavar="/ --no-goal-logit-bias")] = None
    """With --goal: add a goal-progress bias to the token logits (ours, not the paper's). Left out: yes where
    goal conditioning is added, unchanged where the model has it."""
    processes: Processes = None
    """Processes that train, in short for the method's device.processes."""
    split: str = "training"
    """Split of the data set to train on."""
    validation_split: str | None = None
    """With catk and road: split to validate on in closed loop, see --catk.validation.every. Left out: "validation", if
    the data set has it."""
    config: Path | None = None
    """JSON file of settings: the output of `rlftsim recipe NAME --json`, or the config.json of an earlier run
    by the same method. A run repeated from its own config.json, with the same model and data, gives the same
    weights bit for bit. Flags override the file."""

    @classmethod
    def recipe_for(cls, name: str, words: Sequence[str]) -> Recipe:
        """The recipe of a command line, with goals if `--goal` is given.

        Args:
            name: of the recipe.
            words: the words behind the verb.
        """
        recipe, section = super().recipe_for(name, words), cls.run_section(words)
        if not hasattr(recipe, section):
            recipe = recipe.with_section(section, method_by_name(section).settings())
        return recipe.with_goals() if value_of("--goal", words) else recipe

    @classmethod
    def sections_for(cls, words: Sequence[str]) -> tuple[str, ...]:
        """Sections of the methods of this package, and that of the method."""
        return tuple(dict.fromkeys((*cls.sections, cls.run_section(words))))

    @classmethod
    def run_section(cls, words: Sequence[str]) -> str:
        """Section of the method."""
        return section_of_method(value_of("--method", words) or "rlft")

    def refuse_useless(self, flags: Sequence[str]) -> None:
        """Refuse settings of other methods, and flags that need another flag.

        Raises:
            ConfigError: one of them would have no effect.
        """
        # 1. settings of other methods
        used = section_of_method(self.method)
        others = [section for section in self.sections if section != used]
        refuse_settings(flags, others, f"with --method {self.method}: its settings are --{used}.*")
        # 2. flags that need another flag
        if self.goal is None and self.goal_logit_bias is not None:
            flag = "--goal-logit-bias" if self.goal_logit_bias else "--no-goal-logit-bias"
            raise ConfigError(f"{flag} has no effect without goals: add --goal concat or --goal indication.")
        if self.method == "gcsl" and self.validation_split:
            raise ConfigError(f"--validation-split {self.validation_split} has no effect: {NOT_VALIDATED}")

    def run(self) -> int:
        """Load the model and fine-tune it."""
        config = getattr(self.settings, section_of_method(self.method))
        if config is None:
            raise ConfigError(
                f"recipe {self.recipe} has no section {self.method}: name another recipe, or train by --method rlft."
            )
        scenarios = open_dataset(self.data, self.split)
        every = config.validation.every if method_by_name(self.method).validates else 0
        held_out = _held_out(self.data, self.validation_split, every)
        goals = None if self.goal is None else GoalConditioning(self.goal, self.goal_logit_bias)
        with _learning_curve(self.out):
            model = finetune_model(self.model, scenarios, config, self.out, conditioning=goals, held_out=held_out)
        if is_first_process():
            write_calibration_picture(model)
        print(f"model: {model}")
        return 0


def section_of_method(method: str) -> str:
    """Section of a recipe with the settings of a method of fine-tuning: "finetune" for rlft, else the method's name.

    Raises:
        ConfigError: Unknown, with the nearest known name, or "pretrain", which is no fine-tuning.
    """
    if method == "pretrain":
        raise ConfigError("method 'pretrain' has a command of its own: rlftsim pretrain --init-from MODEL.")
    METHODS.get(method)
    return "finetune" if method == "rlft" else method


def _held_out(data: str, split: str | None, every: int) -> ScenarioDataset | None:
    """Scenarios to validate on; None = no validation was requested, or the data set has no such split and none
    was named.

    Raises:
        ConfigError: a split is named, but there is no validation.
        DataError: no such split.
    """
    if split is not None and not every:
        raise ConfigError(f"--validation-split {split} has no effect: set validation.every to a number of updates.")
    if not every:
        return None
    if split is None and VALIDATION not in list_splits(data):
        log.info(f"no validation: {data} has no split {VALIDATION!r}, name another with --validation-split.")
        return None
    return open_dataset(data, split or VALIDATION)


@contextmanager
def _learning_curve(out: Path) -> Iterator[None]:
    """Draw the learning curve of a run when it ends, for whatever reason."""
    try:
        yield
    except BaseException:
        # The reason why the run ended matters more than a picture that could not be drawn.
        with suppress(RlftsimError, OSError):
            _draw(out)
        raise
    _draw(out)


def _draw(out: Path) -> None:
    if is_first_process():
        write_learning_curve(out)
