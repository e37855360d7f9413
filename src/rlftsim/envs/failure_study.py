"""How often a planner fails over many scenarios within a budget: a pilot everywhere, then repeats where they tell most.

The pilot drives a few undisturbed episodes of each scenario. What is left of the budget goes where the root of variance
times cost is largest, by a guess from the pilot; the estimates themselves use none of its episodes, so the guess biases
nothing. Where the guess is tiny, repeats may have no branches. `envs.failure_run` drives both.

A budget is a number of steps, so that the same command gives the same bytes on any machine; minutes are turned into
steps at `STEPS_PER_S`.
"""

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy import stats

import rlftsim
from rlftsim.envs import dangers, failures, splitting
from rlftsim.envs.dangers import EVENTS, find_event
from rlftsim.envs.failures import Failure, FailureChain, RepeatedEstimate, make_source
from rlftsim.envs.planners.registry import Planner, hash_code, hash_source, load_planner
from rlftsim.envs.source import Source, check_choice
from rlftsim.envs.splitting import KILLED
from rlftsim.errors import ConfigError, DataError, check_types, in_short, whole_number
from rlftsim.evaluation.scenario_source import hash_manifest
from rlftsim.jobs.documents import first_line, parse_json
from rlftsim.jobs.files import write_atomically
from rlftsim.jobs.tables import check_columns, read_parquet, read_parquet_metadata
from rlftsim.scenario.dataset import dataset_folder
from rlftsim.scenario.types import STEP_S

STEPS_PER_S = 600
"""Steps that a second of a budget stands for: about what a core does."""
FAILURES = "failures.parquet"
WAY_OUT = "remove it and repeat `rlftsim failures`"
REPEATS = 4
"""Estimates of a round, which run side by side."""
NUMBERS_PER_ROUND = 1 << 24
"""Dice of a round; those of the next round follow."""
LEAST_PROBABILITY = 1e-9
QUIET_PROBABILITIES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1.0)
"""Scenarios whose guess is below the least of these that the budget allows are measured by undisturbed episodes: for
them, dozens of levels would cost more than they tell."""
_BUDGET = re.compile(r"(\d+(?:\.\d+)?)([smh]?)")
_SECONDS = {"s": 1, "m": 60, "h": 3600}


@dataclass(frozen=True)
class StudyConfig:
    """Planner, traffic, scenarios and event."""

    planner: str
    data: str = "synthetic"
    split: str | None = "validation"
    model: str = "demo-base"
    traffic: str = "policy"
    event: str = "at_fault_collision"
    particles: int = 8
    """Undisturbed episodes that a repeat begins with."""
    pilot: int = 16
    """Undisturbed episodes of each scenario that share out the budget."""
    seed: int = 0
    scenarios: tuple[str, ...] | None = None
    limit: int | None = None

    def __post_init__(self) -> None:
        check_types(self)
        for name, least in (("particles", 2), ("pilot", 2), ("seed", 0)):
            whole_number(name, getattr(self, name), least)
        check_choice(self.scenarios, self.limit)
        if self.event not in EVENTS:
            raise ConfigError(f"event {in_short(self.event)}: known are {', '.join(EVENTS)}.")

    def identity(self) -> dict[str, Any]:
        """Values on which pilots and repeats depend, beside the scenario."""
        estimator: tuple[Any, ...] = dangers, failures, splitting
        return {
            "planner": self.planner, "planner_code": hash_code(self.planner),
            "model": load_source(self)[1].fingerprint, "manifest": hash_manifest(dataset_folder(self.data)),
            "split": self.split, "traffic": self.traffic, "event": self.event, "particles": self.particles,
            "estimator_code": "-".join(filter(None, map(hash_source, estimator))),
            "pilot": self.pilot, "seed": self.seed, "rlftsim_version": rlftsim.__version__,
        }  # fmt: skip

    def scenario_ids(self) -> list[str]:
        """Ids of the scenarios, in the order of the data unless they are named.

        Raises:
            ConfigError: No such scenario.
        """
        source = load_source(self)[1]
        for scenario_id in self.scenarios or ():
            source.scenario(scenario_id)
        return list(self.scenarios or source.scenario_ids)[: self.limit]

    def chain(self, scenario_id: str, number: int = 0, planner: str | None = None) -> FailureChain:
        """Episodes of a scenario.

        Args:
            scenario_id: Scenario of the data.
            number: Number of the round, each with dice of its own; 0 = the pilot.
            planner: Name of another planner among the same traffic.
        """
        driver, source = load_source(replace(self, planner=planner or self.planner))
        event, first_number = find_event(self.event), number * NUMBERS_PER_ROUND
        return FailureChain(source, driver, scenario_id, event, seed=self.seed, first_number=first_number)


@lru_cache(maxsize=8)
def load_source(config: StudyConfig) -> tuple[Planner, Source]:
    """Planner, and the source of its episodes; made once in each process."""
    planner = load_planner(config.planner)
    settings = {name: getattr(config, name) for name in ("data", "split", "model", "traffic")}
    return planner, make_source(planner, None, **settings)


def parse_budget(text: str) -> int:
    """Steps of a budget: a duration such as "10m" (of one core), or a number of steps.

    Raises:
        ConfigError: Neither.
    """
    match = _BUDGET.fullmatch(text.strip())
    if match is None or float(match[1]) <= 0:
        raise ConfigError(f"budget {in_short(text)}: write a duration such as 90s, 10m or 2h, or a number of steps.")
    return int(float(match[1]) * (_SECONDS[match[2]] * STEPS_PER_S if match[2] else 1))


@dataclass(frozen=True)
class Pilot:
    """Undisturbed episodes of a scenario."""

    scenario_id: str
    danger: tuple[float, ...]
    """Largest danger of each."""
    driven_m: float
    """Mean distance of the planner."""
    num_steps: int
    """Steps of all of them."""
    problem: str = ""
    """Reason for leaving the scenario out."""

    def __post_init__(self) -> None:
        check_types(self)
        object.__setattr__(self, "danger", tuple(map(float, self.danger)))
        is_whole = self.num_steps > 0 and len(self.danger) > 1 and 0 <= self.driven_m < math.inf
        if not (self.problem or is_whole):
            raise ConfigError(f"a pilot of {self.num_steps} steps, {len(self.danger)} episodes, {self.driven_m} m.")

    def guess(self) -> float:
        """Probability of the event, roughly: the rate, or beyond all episodes the tail of the upper half."""
        danger = np.sort(np.array(self.danger))
        if (danger >= 0).any():
            return float((danger >= 0).mean())
        upper = danger[len(danger) // 2 :]
        if not np.isfinite(upper).all():
            return LEAST_PROBABILITY
        scale = max(float((upper - upper[0]).mean()), 1e-3)
        return float(np.clip(0.5 * math.exp(max(upper[0] / scale, -700)), LEAST_PROBABILITY, 1 / len(danger)))


@dataclass(frozen=True, eq=False)
class ScenarioEstimate(RepeatedEstimate):
    """Probability of the event in a scenario of a study."""

    pilot: Pilot


@dataclass(frozen=True, eq=False)
class Study:
    """Estimates of all scenarios."""

    config: StudyConfig
    scenarios: tuple[ScenarioEstimate, ...]
    problems: Mapping[str, str]
    """Scenario id to the reason for leaving it out."""

    @property
    def failures(self) -> list[Failure]:
        """Failing episodes with the probability of each in its scenario, the most probable first."""
        failures = [
            replace(failure, probability=failure.probability / len(scenario.repeats))
            for scenario in self.scenarios for repeat in scenario.repeats for failure in repeat.failures
        ]  # fmt: skip
        return sorted(failures, key=lambda failure: -failure.probability)

    def mean_interval(self) -> tuple[float, float, float]:
        """Probability of the event in an episode of these scenarios, a stratified mean, and its 95 % interval.

        The upper end has what scenarios without an event may hide, too: the exact bound by their undisturbed episodes,
        which is largest where all of them hide the same.
        """
        variances = np.array([s.variance for s in self.scenarios]) / len(self.scenarios) ** 2
        mean = float(np.mean([s.probability for s in self.scenarios]))
        quiet, hidden = [s.particles * len(s.repeats) for s in self.scenarios if s.probability == 0], 0.0
        if quiet:
            hidden = len(quiet) / len(self.scenarios) * (1 - 0.05 ** (1 / (min(quiet) * len(quiet))))
        if mean == 0:
            return 0.0, 0.0, hidden
        counts = np.array([len(s.repeats) for s in self.scenarios])
        variance = float(variances.sum())
        if not variance > 0:
            return mean, math.nan, math.nan
        has_variance = variances > 0
        degrees = variance**2 / float((variances[has_variance] ** 2 / (counts[has_variance] - 1)).sum())
        # of the logarithm, which keeps the lower end positive
        half = float(stats.t.ppf(0.975, degrees)) * math.sqrt(variance) / mean
        return mean, mean * math.exp(-half), min(mean * math.exp(half) + hidden, 1.0)

    def describe_total(self) -> str:
        """Events per 1 000 km and per hour driven, with interval; of a standing planner per hour alone."""
        values, texts = self.mean_interval(), []
        # that an episode drives on average
        km = float(np.mean([s.pilot.driven_m for s in self.scenarios])) / 1000
        hours = load_source(self.config)[1].config.max_steps * STEP_S / 3600
        for unit, size in (("1 000 km", km / 1000), ("hour", hours)):
            if not size:
                texts.append(f"no rate per {unit}, as the planner stands still")
                continue
            rate, low, high = (value / size for value in values)
            interval = f" [{format_rate(low)}, {format_rate(high)}]" if math.isfinite(low) else ""
            texts.append(
                f"{format_rate(rate)} per {unit}{interval}" if rate else f"fewer than {format_rate(high)} per {unit}"
            )
        note = "" if math.isfinite(values[1]) else "; without an interval: too few repeats"
        return f"{self.config.event} of {self.config.planner}: {', '.join(texts)}{note}"

    def write(self, path: Path, budget: int) -> None:
        """Write the failing episodes as Parquet, a row each, with all that is needed to run them again.

        Args:
            path: File that a study of a smaller budget will not replace.
            budget: Steps of all pilots and repeats.
        """
        rows = [asdict(failure) for failure in self.failures]
        about = json.dumps({**asdict(self.config), "budget": budget})
        table = pa.Table.from_pylist(rows, schema=SCHEMA).replace_schema_metadata({"rlftsim": about})
        write_atomically(path, lambda temporary: pq.write_table(table, temporary, compression="zstd"))


def format_rate(rate: float) -> str:
    """A rate with three digits, without an exponent where it is large."""
    return f"{rate:,.0f}".replace(",", " ") if rate >= 100 else f"{rate:.3g}"


SCHEMA = pa.schema({
    "scenario_id": pa.string(), "probability": pa.float64(), "dice": pa.list_(pa.int64()),
    "step": pa.int64(), "digest": pa.string(), "contact": pa.string(), "at_fault": pa.bool_(),
    "closing_mps": pa.float64(), "agent": pa.int64(),
})  # fmt: skip


@contextmanager
def _errors_name_study(path: Path) -> Iterator[None]:
    try:
        yield
    except (ConfigError, DataError, KeyError, TypeError, AttributeError) as error:
        raise DataError(f"{path} is no table of failures ({first_line(error)}): {WAY_OUT}.") from None


def read_settings(path: Path) -> tuple[StudyConfig, int]:
    """Settings of a stored study, and the steps of the budget.

    Args:
        path: File that `Study.write` wrote.

    Raises:
        DataError: A file that was cut or edited.
    """
    with _errors_name_study(path):
        about = parse_json(read_parquet_metadata(path)[b"rlftsim"], WAY_OUT, source=str(path))
        about["scenarios"] = about["scenarios"] and tuple(about["scenarios"])
        budget = whole_number("budget", about.pop("budget"), 0)
        return StudyConfig(**about), budget


def read_failure(folder: Path, number: int) -> tuple[StudyConfig, Failure]:
    """A failing episode of a study that was written, and the study's settings.

    Args:
        folder: Folder of `rlftsim failures`.
        number: Row of failures.parquet, from 0 on.

    Raises:
        DataError: No such study or row, or a file that was cut or edited.
    """
    path = folder / FAILURES
    table = read_parquet(path, WAY_OUT, missing=f"{path} is not there: name the --out of `rlftsim failures`.")
    if not 0 <= number < len(table):
        raise DataError(f"{path} has {len(table)} failures, counted from 0: there is no number {number}.")
    config, _ = read_settings(path)
    with _errors_name_study(path):
        check_columns(table, SCHEMA)
        row = table.slice(number, 1).to_pylist()[0]
        return config, Failure(**row | {"dice": tuple(row["dice"])})


def share_budget(pilots: Sequence[Pilot], particles: int, budget: int) -> list[tuple[int, bool]]:
    """Rounds of repeats of each scenario, one for each and the others where they narrow the total most, and True for
    rounds with branches.

    Args:
        pilots: Pilot of each scenario.
        particles: Undisturbed episodes that a repeat begins with.
        budget: Steps for all, those of the pilots included.

    Raises:
        ConfigError: Too few steps for one round of each scenario.
    """
    guess = np.array([pilot.guess() for pilot in pilots])
    undisturbed = REPEATS * particles * np.array([pilot.num_steps / len(pilot.danger) for pilot in pilots])
    rest = budget - sum(pilot.num_steps for pilot in pilots)
    if rest < undisturbed.sum():
        needed = math.ceil((budget - rest + undisturbed.sum()) / STEPS_PER_S / 6) / 10
        raise ConfigError(
            f"a budget of {budget} steps is too small for {REPEATS} repeats in each of {len(pilots)} scenarios: give "
            f"--budget {needed:g}m or more, or choose fewer with --limit."
        )
    num_levels = np.log(guess) / math.log(1 - KILLED)
    for quiet in QUIET_PROBABILITIES:
        is_branching = guess >= quiet
        cost = undisturbed * (1 + KILLED * np.where(is_branching, num_levels, 0.0))
        if cost.sum() <= rest:
            break
    deviation = guess * np.sqrt((1 - guess - np.log(guess)) / (REPEATS * particles))
    share = deviation * np.sqrt(cost) + 1e-300
    counts = 1 + np.floor((rest - cost.sum()) * share / share.sum() / cost)
    return [(int(count), bool(branches)) for count, branches in zip(counts, is_branching)]
