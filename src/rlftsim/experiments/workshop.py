"""Where experiments have their models trained and measured: a folder in which finished stages are found and not repeated.

config.json, environment.json   what the folder belongs to; anything else is refused
vocabulary.safetensors          motion and map tokens
runs/base/                      a training run each, see `training.run_folder`
runs/mloo-seed0/3-epochs/
evaluations/*.parquet           an evaluation each
variances/                      what `catalogue.variance_scaling` measures
attainment/                     who got where it was asked to go, see `experiments.attainment`
NAME.md, NAME.json, NAME.png    what an experiment found

Stages are shared: what one experiment has trained the next one uses.
"""

import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from rlftsim.errors import ConfigError, DataError
from rlftsim.experiments.contestants import (
    BASE,
    CATK,
    GCSL,
    Base,
    Baseline,
    Contestant,
    FineTuned,
    Guided,
    catk_config,
    finetune_config,
    gcsl_config,
)
from rlftsim.experiments.evaluate import EvaluateConfig, evaluate
from rlftsim.experiments.evaluation import SCHEMA, SCORE_COLUMNS, Evaluation, GoalsGiven
from rlftsim.experiments.stages import (
    NewSight,
    find_vocabulary,
    finetune_with_catk,
    finetune_with_reward,
    open_training,
    pretrain_smart,
    teach_goals,
)
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.progress import say
from rlftsim.recipes.models import Device, find_model, load_policy, load_policy_or_oracle
from rlftsim.recipes.smart import SmartRecipe
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.policy import Policy
from rlftsim.scenario.dataset import MANIFEST, ScenarioDataset
from rlftsim.scenario.shards import hash_file
from rlftsim.training.run_folder import RunFolder, flatten, may_change, to_plain


@dataclass(frozen=True, eq=False)
class Row:
    """A row of a table: one contestant, measured for each seed."""

    name: str
    by_seed: tuple[Evaluation, ...]

    @cached_property
    def mean(self) -> Evaluation:
        """Each scenario's mean over the seeds."""
        return mean_of_seeds(self.name, self.by_seed)


def mean_of_seeds(name: str, evaluations: Sequence[Evaluation]) -> Evaluation:
    """An evaluation whose scores are means over evaluations of the same scenarios, scenario by scenario.

    Raises:
        DataError: they are of different scenarios.
    """
    first = evaluations[0]
    if any(other.scenario_ids != first.scenario_ids for other in evaluations):
        raise DataError(f"{name}: the evaluations of its seeds are of different scenarios: remove them to start anew.")
    table = first.table
    for column in SCORE_COLUMNS:
        mean = np.mean([evaluation.values(column) for evaluation in evaluations], axis=0)
        table = table.set_column(table.schema.get_field_index(column), SCHEMA.field(column), pa.array(mean))
    return Evaluation(name, first.provenance, table, first.skipped)


@dataclass(frozen=True)
class Budget:
    """What every fine-tuned contestant may use."""

    updates: int
    scenarios_an_update: int
    rollouts_a_scenario: int

    def __str__(self) -> str:
        return f"{self.updates} updates of {self.scenarios_an_update} scenarios with {self.rollouts_a_scenario} rollouts each"


@dataclass(frozen=True)
class Workshop:
    """A folder of stages and the settings they share.

    Raises:
        CheckpointError: the folder belongs to other settings, data or base model.
        DataError: no such data set.
        ConfigError: no seed, or training in several processes.
    """

    recipe: SmartRecipe
    data: Path
    """A data set with the splits training and validation."""
    out: Path
    evaluation: EvaluateConfig = field(default_factory=EvaluateConfig)
    num_seeds: int = 1
    """Of fine-tuning. More may be added later."""
    base_model: str | None = None
    """Model folder to fine-tune; None = one is pre-trained by the recipe."""
    device: Device = "cpu"
    """Of evaluations; training has its own in the recipe."""

    def __post_init__(self) -> None:
        if self.num_seeds < 1:
            raise ConfigError(f"an experiment needs at least one seed, got {self.num_seeds}.")
        if any(
            section.device.devices != 1 for section in (self.recipe.pretrain, self.recipe.finetune, self.recipe.catk)
        ):
            raise ConfigError(
                "experiments train in one process: leave device.devices at 1, or train by `rlftsim finetune` and compare by "
                "`rlftsim evaluate`."
            )
        _ = self.training  # a data set that is not there must not claim the folder,
        ScenarioDataset(
            self.data, self.evaluation.split
        )  # and one that nothing can be measured on must not be trained on
        RunFolder(self.out, self._what_counts())

    @cached_property
    def training(self) -> ScenarioDataset:
        """The training scenarios."""
        return open_training(self.data)

    @property
    def budget(self) -> Budget:
        """The same for all."""
        config = self.recipe.finetune
        return Budget(config.num_updates(len(self.training)), config.batch_size, config.num_rollouts)

    def measure(self, rows: Mapping[str, Sequence[Contestant]], *, goals: GoalsGiven = "none") -> dict[str, Row]:
        """Train and evaluate whoever is not yet, and return the rows by their names.

        Args:
            rows: by name, the contestants of a row: the same with several seeds.
            goals: what agents are asked in the evaluation.
        """
        everybody = list(dict.fromkeys(c for contestants in rows.values() for c in contestants))
        agenda = Agenda(self._steps(everybody, goals=goals))
        config = replace(self.evaluation, goals=goals)
        measured = {}
        for contestant in everybody:
            model = self._model(contestant, agenda)
            with agenda.step(self._evaluation_title(contestant, goals)):
                policy = load_policy_or_oracle(model, self.device)
                folder, name = self.out / "evaluations", self.evaluation_name(contestant, goals)
                measured[contestant] = evaluate(policy, self.data, folder, config, name=name)
        return {name: Row(name, tuple(measured[c] for c in contestants)) for name, contestants in rows.items()}

    def base(self) -> Path:
        """Folder of the base model; pre-trained, if it is not there yet."""
        return Path(self.models([BASE])[BASE])

    def models(self, contestants: Sequence[Contestant]) -> dict[Contestant, str]:
        """Names or folders of contestants' policies; whoever is not trained yet is trained."""
        agenda = Agenda(self._steps(contestants, evaluated=False))
        return {contestant: self._model(contestant, agenda) for contestant in contestants}

    def policy(self, contestant: Base | FineTuned) -> Policy:
        """A contestant's policy, on the device of evaluations; trained, if it is not yet."""
        return load_policy(self._model(contestant, Agenda(self._steps([contestant], evaluated=False))), self.device)

    def title(self, contestant: Contestant) -> str:
        """A contestant in words."""
        if isinstance(contestant, Guided):
            return f"{self.title(contestant.of)}, guided {contestant.times:g} times"
        if not isinstance(contestant, FineTuned):
            return contestant.name.replace("_", " ")
        epochs = self._epochs(contestant)
        return f"{contestant.name} ({epochs:g} epoch{'s' if epochs != 1 else ''})"

    def model_folder(self, contestant: Base | FineTuned) -> Path:
        """Folder of the run that makes a contestant."""
        if isinstance(contestant, Base):
            return self.out / "runs" / contestant.name
        return self.out / "runs" / contestant.name / f"{self._epochs(contestant):g}-epochs"

    # ---- stages ---------------------------------------------------------------------------------------------------

    def _steps(
        self, contestants: Sequence[Contestant], *, evaluated: bool = True, goals: GoalsGiven = "none"
    ) -> dict[str, bool]:
        """Titles of the stages ahead, in their order, and whether each was finished before."""
        steps: dict[str, bool] = {}
        for contestant in contestants:
            for needed in self._lineage(contestant):
                steps[self._training_title(needed)] = (self.model_folder(needed) / "model").exists()
            if evaluated:
                path = self.out / "evaluations" / f"{self.evaluation_name(contestant, goals)}.parquet"
                steps[self._evaluation_title(contestant, goals)] = path.exists()
        return steps

    def _lineage(self, contestant: Contestant) -> list[Base | FineTuned]:
        """What has to be trained for a contestant, the base model first."""
        if isinstance(contestant, Guided):
            return self._lineage(contestant.of)
        if isinstance(contestant, Baseline) or (contestant == BASE and self.base_model):
            return []
        before = self._lineage(contestant.base) if isinstance(contestant, FineTuned) else []
        return [*before, contestant]

    def _training_title(self, contestant: Base | FineTuned) -> str:
        return f"{'pre-train' if isinstance(contestant, Base) else 'fine-tune'} {self.title(contestant)}"

    def _model(self, contestant: Contestant, agenda: "Agenda") -> str:
        """Name or folder of a contestant's policy, which is trained if it is not there yet."""
        if isinstance(contestant, Baseline):
            return contestant.name
        for needed in self._lineage(contestant):
            with agenda.step(self._training_title(needed)):
                self._pretrain(needed) if isinstance(needed, Base) else self._finetune(needed)
        return str(self._guide(contestant) if isinstance(contestant, Guided) else self._result(contestant))

    def _guide(self, contestant: Guided) -> Path:
        """Folder of a guided model, made anew: nothing is trained."""
        folder = self.model_folder(contestant.of) / f"guided-{contestant.times:g}"
        policy = load_policy(str(self._result(contestant.of)), goal_guidance=contestant.times)
        policy.save_pretrained(folder, card=f"# {self.title(contestant)}\n")  # type: ignore[attr-defined]
        return folder

    def _result(self, contestant: Base | FineTuned) -> Path:
        if contestant == BASE and self.base_model:
            return find_model(self.base_model)
        return self.model_folder(contestant) / "model"

    def _pretrain(self, base: Base) -> None:
        config = self.recipe.pretrain if base.epochs is None else replace(self.recipe.pretrain, epochs=base.epochs)
        if self.base_model:
            like = SmartPolicy.from_pretrained(find_model(self.base_model))
            model, vocabulary = like.config, like.vocabulary
        else:
            origin = f"experiments on {self.data.name}, {self.recipe.tokens}"
            path = self.out / "vocabulary.safetensors"
            model = self.recipe.model
            vocabulary = find_vocabulary(self.training, self.recipe.tokens, path, origin=origin)
        pretrain_smart(vocabulary, self.training, model, config, self.model_folder(base))

    def _finetune(self, contestant: FineTuned) -> None:
        out, base = self.model_folder(contestant), self._result(contestant.base)
        if contestant.method == CATK:
            finetune_with_catk(base, self.training, catk_config(contestant, self.recipe), out)
            return
        goals = contestant.goals
        sight = None if goals is None else NewSight(goals.sight, goals.aim)
        if contestant.method == GCSL:
            teach_goals(base, self.training, gcsl_config(contestant, self.recipe.gcsl), out, sight=sight)
            return
        self._start_from_shorter(out, self._epochs(contestant))
        config = finetune_config(contestant, self.recipe.finetune)
        finetune_with_reward(base, self.training, config, out, sight=sight)

    def _start_from_shorter(self, out: Path, epochs: float) -> None:
        """Take over the end of a shorter run of the same contestant: a longer one passes through the same weights, because
        nothing in a run with a reward depends on when it will end."""
        shorter = [
            path for path in out.parent.glob("*-epochs") if (path / "model").exists() and _epochs_of(path) < epochs
        ]
        if out.exists() or not shorter:
            return
        found, partial = max(shorter, key=_epochs_of), out.with_name(f".partial-{out.name}")
        shutil.rmtree(partial, ignore_errors=True)
        shutil.copytree(found / "checkpoints", partial / "checkpoints")
        shutil.copy(found / "metrics.jsonl", partial / "metrics.jsonl")
        partial.rename(out)

    def _epochs(self, contestant: FineTuned) -> float:
        section = self.recipe.gcsl if contestant.method == GCSL else self.recipe.finetune
        return section.epochs * contestant.share

    def evaluation_name(self, contestant: Contestant, goals: GoalsGiven = "none") -> str:
        """Of a contestant's results."""
        if isinstance(contestant, Guided):
            return f"{self.evaluation_name(contestant.of, goals)}-guided-{contestant.times:g}"
        suffix = f"-{self._epochs(contestant):g}-epochs" if isinstance(contestant, FineTuned) else ""
        return f"{contestant.name}{suffix}{'' if goals == 'none' else f'-{goals}-goals'}"

    def _evaluation_title(self, contestant: Contestant, goals: GoalsGiven) -> str:
        return f"evaluate {self.title(contestant)}{'' if goals == 'none' else f', {goals} goals'}"

    def _what_counts(self) -> dict[str, Any]:
        """What all stages of the folder share; what changes no result is left out."""
        recipe = flatten(to_plain(self.recipe))
        return {
            "recipe": {name: value for name, value in recipe.items() if not may_change(name.partition(".")[2])},
            "evaluation": {**self.evaluation.what_counts(), "limit": self.evaluation.limit},
            "data": hash_file(self.data / MANIFEST),
            "base_model": fingerprint_policy(load_policy(self.base_model)) if self.base_model else None,
        }


def _epochs_of(path: Path) -> float:
    return float(path.name.removesuffix("-epochs"))


class Agenda:
    """Says which stage is under way, how many there are, and about how long the rest takes."""

    def __init__(self, steps: Mapping[str, bool]):
        self._open = dict(steps)
        self._total = len(steps)
        self._seconds: dict[str, list[float]] = {}

    @contextmanager
    def step(self, title: str) -> Iterator[None]:
        """A stage; those that were announced are counted, and each only once."""
        if title not in self._open:
            yield
            return
        number = self._total - len(self._open) + 1
        is_done = self._open[title]
        say(f"{number}/{self._total}  {title}{'  (finished before)' if is_done else self._time_left()}")
        start = time.monotonic()
        yield
        del self._open[title]
        if not is_done:
            self._seconds.setdefault(_kind(title), []).append(time.monotonic() - start)

    def _time_left(self) -> str:
        """In words; empty as long as one kind of stage has not been timed."""
        ahead = [_kind(title) for title, is_done in self._open.items() if not is_done]
        if not ahead or not all(kind in self._seconds for kind in ahead):
            return ""
        minutes = sum(float(np.mean(self._seconds[kind])) for kind in ahead) / 60
        return f"  (about {minutes:.0f} min to go)" if minutes >= 1 else "  (less than a minute to go)"


def _kind(title: str) -> str:
    return title.partition(" ")[0]
