"""The exam: candidates against the base model, on scenarios that no choice was made on, looked at once.

OUT/tune/                        the base at some temperatures on the split `tune`, which chooses the best
OUT/synthetic-200-SEED/          an exam, named after data and seed
    scenarios/                   data set of a generated exam
    evaluations/*.parquet        scores of every model
    exam.md, exam.json           tables, margins and verdicts

The seed of a generated exam follows from the commit of the package, so no model can have been tuned on the exam. A
ledger counts the looks at every exam.
"""

import json
import math
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

import rlftsim
from rlftsim.errors import ConfigError, DataError
from rlftsim.evaluation.compare import PairedDifference, compare_paired
from rlftsim.evaluation.evaluate import evaluate
from rlftsim.evaluation.results import SCORE_COLUMNS, EvaluateConfig, Evaluation
from rlftsim.experiments.tables import RMM, Row
from rlftsim.jobs.documents import parse_json
from rlftsim.jobs.files import append_text
from rlftsim.policies.registry import Device, load_policy
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.policy import Policy
from rlftsim.scenario.dataset import EXAM, SYNTHETIC, TUNE, ScenarioDataset
from rlftsim.scenario.synthetic.generate import generate
from rlftsim.statistics import MeanInterval, prediction_interval
from rlftsim.training.run_folder import stored_settings

CHECKOUT = Path(rlftsim.__file__).resolve().parents[2]
"""Folder of the repository, if the package runs from one."""
LEDGER = "exam.jsonl"
SCENARIOS_PER_NETWORK = 8
"""200 scenarios are of 25 street networks."""
FIRST_SEED = 1 << 48
"""Added to the seed of an exam: no data set of `rlftsim synthesize` has a network of it, whatever its --seed."""
BASE = "base"


@dataclass(frozen=True)
class Ledger:
    """Looks at exams: a line of JSON for each look, in a file that only grows and may be missing."""

    path: Path

    @cached_property
    def entries(self) -> list[Mapping[str, Any]]:
        """Entries of the file, a mapping for each line.

        Raises:
            DataError: The file cannot be read, or has a line that is no entry of a ledger.
        """
        try:
            lines = self.path.read_text(encoding="utf-8").splitlines()
        except FileNotFoundError:
            return []
        except (OSError, ValueError) as error:
            raise DataError(f"{self.path} cannot be read ({error}): name another --ledger.") from None
        entries = []
        for number, line in enumerate(lines, 1):
            try:
                entry = parse_json(line, "mend it", source=str(self.path))
                _ = entry["exam"], entry["looks"], entry["recipe"], entry["date"], set(entry["fingerprints"])
            except (DataError, TypeError, KeyError):
                raise DataError(
                    f"{self.path}: line {number} is none of a ledger: mend or remove it, or name another --ledger."
                ) from None
            entries.append(entry)
        return entries

    def count_looks(self, exam: str, recipe: str, fingerprints: Sequence[str], *, is_repeat: bool) -> int:
        """Number of earlier looks at an exam by a recipe of this name or any of these models.

        Args:
            exam: Name of the exam.
            recipe: Name of the recipe.
            fingerprints: Fingerprints of the recipe's models, which may have sat under a former name.
            is_repeat: True allows a further look, which is counted; False refuses one.

        Raises:
            ConfigError: There was a look, and `is_repeat` is not set.
        """
        earlier = [
            entry
            for entry in self.entries
            if entry["looks"]  # not the base
            and entry["exam"] == exam
            and (entry["recipe"] == recipe or set(entry["fingerprints"]) & {*fingerprints})
        ]
        if earlier and not is_repeat:
            raise ConfigError(
                f"{recipe} sat the exam {exam} on {earlier[-1]['date']} ({self.path}): whoever looks twice chooses on "
                "the exam. Choose on the split tune, or add --again, which is counted."
            )
        return len(earlier)

    def append(self, entries: Sequence[Mapping[str, Any]]) -> None:
        """Add lines for a look."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        append_text(self.path, "".join(json.dumps(entry, allow_nan=False) + "\n" for entry in entries))


@dataclass(frozen=True)
class Margin:
    """Change of a column that a candidate may not exceed, however much realism the candidate gains."""

    column: str
    lowest: float = -math.inf
    highest: float = math.inf
    is_relative: bool = False
    """True = the change is a fraction of the base's mean."""

    def bounds(self, change: PairedDifference) -> tuple[float, float]:
        """Ends of a change's interval, as fractions of the base's mean where the margin is relative."""
        low, high = change.interval
        return (low / change.mean_a, high / change.mean_a) if self.is_relative else (low, high)

    def judge(self, change: PairedDifference) -> str:
        """Word for a change: holds, missed or undecided, by one-sided 95 % bounds; unknown without an interval.

        Args:
            change: Difference from the base at alpha = 0.1, whose ends are these bounds.
        """
        low, high = self.bounds(change)
        if math.isnan(low):
            return "unknown"
        if low > self.highest or high < self.lowest:
            return "missed"
        return "holds" if self.lowest <= low and high <= self.highest else "undecided"


MARGINS = (
    Margin("kinematic", lowest=-0.002),
    Margin("interactive", lowest=-0.002),
    Margin("map_based", lowest=-0.002),
    Margin("min_average_displacement_error", highest=0.03, is_relative=True),
    Margin("speed_gap", lowest=-0.1, highest=0.1),
    Margin("speed_gap_all", lowest=-0.1, highest=0.1),
    Margin("unlogged_stop_rate", highest=0.01),
)
"""No sub-score lower by 0.002, minADE by at most 3 % higher, speed within 0.1 m/s, at most 1 % more stops."""


@dataclass(frozen=True)
class ExamConfig:
    """Models, scenarios and settings of an exam."""

    candidates: Mapping[str, Sequence[str]]
    """Models by the name of the row; several are runs of the same recipe with different seeds."""
    bases: Sequence[str] = ("demo-base",)
    """Model that the candidates started from; of several, each has an equal share of every row's models, in the same
    order."""
    data: str = SYNTHETIC
    """Data set whose split exam is taken; "synthetic" generates an exam."""
    seed: int | None = None
    """Seed of a generated exam; None = the seed follows from the commit."""
    num_scenarios: int = 200
    """Scenarios of a generated exam."""
    temperatures: Sequence[float] = (0.7, 0.8, 0.9, 1.0, 1.1)
    """Of the base, tried on the split tune; the best has a row."""
    evaluation: EvaluateConfig = field(default_factory=EvaluateConfig)
    device: Device = "cpu"

    def __post_init__(self) -> None:
        if not self.candidates or not self.bases:
            raise ConfigError("an exam needs a base model and at least one other: name it with --models.")
        if not self.temperatures:
            raise ConfigError("an exam needs a temperature of the base, such as 1.")
        for name, models in self.candidates.items():
            if len(models) % len(self.bases):
                raise ConfigError(
                    f"{name} has {len(models)} models for {len(self.bases)} base models: name equally many of each."
                )
            if name.startswith(BASE):
                raise ConfigError(f"{name!r} cannot name a row: the base model's begin so, write NAME={models[0]}.")

    @cached_property
    def exam_name(self) -> str:
        """Name that tells exams apart; equal names, equal scenarios."""
        if self.data != SYNTHETIC:
            scenarios = ScenarioDataset(self.data, EXAM)
            return f"{scenarios.folder.name}-{scenarios.fingerprint[:8]}"
        return f"synthetic-{self.num_scenarios}-{find_seed() if self.seed is None else self.seed}"


@dataclass(frozen=True, eq=False)
class Examinee:
    """A model that sits the exam."""

    name: str
    """Run, model folder or registered name."""
    policy: Policy

    @cached_property
    def fingerprint(self) -> str:
        """Hash of weights and settings."""
        return fingerprint_policy(self.policy)

    @property
    def has_noise(self) -> bool:
        """True if the policy draws its decisions, which a temperature changes."""
        return bool(self.policy.noise_size or self.policy.initial_noise_size)

    @property
    def seed(self) -> int | None:
        """Seed of the run that trained the model; None for a model of no run."""
        folder = Path(self.name)
        return stored_settings(folder.parent if folder.name == "model" else folder).get("seed")

    def evaluate(self, scenarios: ScenarioDataset, out: Path, config: EvaluateConfig) -> Evaluation:
        """Scores of the scenarios, read from the folder where finished.

        Args:
            scenarios: Split of a data set.
            out: Folder of the evaluation; the name of the file tells models and temperatures apart.
            config: Rollouts, metric and temperature.
        """
        suffix = f"-temperature-{config.temperature:g}" if config.temperature != 1 else ""
        name = f"{type(self.policy).__name__}-{self.fingerprint[:12]}{suffix}"
        return evaluate(self.policy, scenarios, out, config, name=name)


@dataclass(frozen=True, eq=False)
class ExamRow:
    """Evaluations of a row's models, a run each, beside those of the base model of each run."""

    name: str
    models: Sequence[Examinee]
    by_run: Sequence[Evaluation]
    references: Sequence[Evaluation]
    """Evaluation of the base model of each run."""

    @property
    def mean(self) -> Row:
        """The same as a row of experiments."""
        return Row(self.name, tuple(self.by_run))

    def change(self, column: str, alpha: float = 0.05) -> PairedDifference:
        """Difference from the base, with an interval by bootstrap over street networks and runs.

        Args:
            column: One of `SCORE_COLUMNS`.
            alpha: Probability that the interval misses the true difference.
        """
        reference_scores, scores = (
            np.stack([evaluation.values(column) for evaluation in evaluations])
            for evaluations in (self.references, self.by_run)
        )  # [runs, scenarios]
        return compare_paired(column, reference_scores, scores, alpha=alpha, clusters=self.by_run[0].clusters)

    @cached_property
    def changes(self) -> dict[str, PairedDifference]:
        """Difference from the base by column."""
        return {column: self.change(column) for column in SCORE_COLUMNS}

    @cached_property
    def margins(self) -> dict[str, str]:
        """Word of each margin by column."""
        return {margin.column: margin.judge(self.change(margin.column, alpha=0.1)) for margin in MARGINS}

    @property
    def gains(self) -> Float[np.ndarray, "runs"]:
        """Mean difference in RMM of each run from its base."""
        pairs = zip(self.by_run, self.references)
        return np.array([np.nanmean(run[RMM] - reference[RMM]) for run, reference in pairs])

    @property
    def next_run(self) -> MeanInterval:
        """Mean gain in RMM, with the interval in which a further run of the recipe lies; NaN for a single run."""
        return prediction_interval(self.gains)

    @property
    def verdict(self) -> str:
        """Result of the exam in a line: gain, and the margins that do not hold."""
        gain, words = self.changes[RMM], set(self.margins.values())
        exceptions = [f"{column} {word}" for column, word in self.margins.items() if word != "holds"]
        passed = gain.is_difference and gain.difference > 0 and words == {"holds"}
        failed = (gain.is_difference and gain.difference < 0) or "missed" in words
        result = "passes" if passed else "fails" if failed else "undecided"
        return f"{self.name} {result}: RMM {gain.verdict} Margins: {', '.join(exceptions) or 'all hold'}."


@dataclass(frozen=True, eq=False)
class ExamResult:
    """Rows of an exam and the folder of the results."""

    name: str
    folder: Path
    base: Row
    temperature: float
    """Of the base, best on the split tune."""
    rows: Sequence[ExamRow]
    """The base at its best temperature, if that is not 1, then the candidates."""
    looks: Mapping[str, int]
    """Looks at this exam by candidate, the present look included."""


def take_exam(config: ExamConfig, out: Path, ledger: Ledger, *, is_repeat: bool = False) -> ExamResult:
    """Evaluate base and candidates on an exam; what an interrupted call finished is not done again.

    The result is neither written nor in the ledger: see `experiments.exam_report`.

    Args:
        config: Models, scenarios and settings.
        out: Folder for scenarios, evaluations and results of all exams.
        ledger: Looks at exams so far.
        is_repeat: True allows a further look at a recipe or model that has sat this exam.

    Raises:
        ConfigError: A recipe or model has sat the exam and `is_repeat` is not set, no commit and no seed, or no SUMO.
        DataError: The data set has no split exam.
    """
    # 1. Refuse a second look before anything is simulated.
    names = (name for row in (config.bases, *config.candidates.values()) for name in row)
    models = {name: Examinee(name, load_policy(name, config.device)) for name in dict.fromkeys(names)}
    looks = {
        recipe: 1
        + ledger.count_looks(config.exam_name, recipe, [models[n].fingerprint for n in row], is_repeat=is_repeat)
        for recipe, row in config.candidates.items()
    }
    # 2. Scenarios of the exam.
    folder = out / config.exam_name
    generated = config.data == SYNTHETIC
    scenarios = generate_exam(config, folder / "scenarios") if generated else ScenarioDataset(config.data, EXAM)
    evaluations, bases = folder / "evaluations", [models[name] for name in config.bases]
    base = [model.evaluate(scenarios, evaluations, config.evaluation) for model in bases]
    rows = []
    # 3. The base at the temperature that is best on the split tune: a knob that costs nothing.
    has_noise = any(model.has_noise for model in bases)
    temperature = find_temperature(bases, config, out / "tune") if has_noise else 1.0
    if temperature != 1:
        settings = replace(config.evaluation, temperature=temperature)
        by_run = [model.evaluate(scenarios, evaluations, settings) for model in bases]
        rows.append(ExamRow(f"{BASE} at temperature {temperature:g}", bases, by_run, base))
    # 4. Candidates, each beside the base that it started from.
    for recipe, names in config.candidates.items():
        row = [models[name] for name in names]
        by_run = [model.evaluate(scenarios, evaluations, config.evaluation) for model in row]
        references = [reference for reference in base for _ in range(len(row) // len(base))]
        rows.append(ExamRow(recipe, row, by_run, references))
    return ExamResult(config.exam_name, folder, Row(BASE, tuple(base)), temperature, rows, looks)


def find_temperature(bases: Sequence[Examinee], config: ExamConfig, out: Path) -> float:
    """Temperature at which the base is most realistic on the split tune; a single candidate is not tried.

    Args:
        bases: Base models, whose mean counts.
        config: Data set and temperatures to try.
        out: Folder of the evaluations.

    Raises:
        DataError: The data set has no split tune.
    """
    if len(config.temperatures) == 1:
        return config.temperatures[0]
    scenarios = ScenarioDataset(config.data, TUNE)

    def mean_realism(temperature: float) -> float:
        settings, folder = replace(config.evaluation, temperature=temperature), out / scenarios.folder.name
        evaluations = [model.evaluate(scenarios, folder, settings) for model in bases]
        return float(np.mean([evaluation.mean_and_error(RMM).mean for evaluation in evaluations]))

    return max(config.temperatures, key=mean_realism)


def generate_exam(config: ExamConfig, folder: Path) -> ScenarioDataset:
    """Scenarios of a generated exam, made where they are missing.

    Args:
        config: Seed and number of scenarios.
        folder: Folder of the data set.

    Raises:
        ConfigError: SUMO is not installed.
    """
    seed = find_seed() if config.seed is None else config.seed
    generate(
        folder,
        num_scenarios=config.num_scenarios,
        seed=FIRST_SEED + seed,
        splits={EXAM: 1.0},
        scenarios_per_network=SCENARIOS_PER_NETWORK,
        jobs=config.evaluation.jobs,
    )
    return ScenarioDataset(folder, EXAM)


def find_seed() -> int:
    """Seed that follows from the commit of the checkout: the first eight hexadecimal digits.

    Raises:
        ConfigError: The package does not run from a checkout.
    """
    # an installed package may lie inside of somebody else's repository, whose commit says nothing
    if (CHECKOUT / ".git").exists():
        git = ["git", "-C", str(CHECKOUT), "rev-parse", "HEAD"]
        process = subprocess.run(git, capture_output=True, text=True, check=False)
        if process.returncode == 0:
            return int(process.stdout[:8], 16)
    raise ConfigError("the seed of an exam follows from the commit, and this is no checkout: give one by --seed.")
