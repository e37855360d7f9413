"""Runs a study of failures: pilots, then repeats, as items of `jobs` with a file each.

An interrupted study goes on where it was, and a larger budget adds to a smaller one, never the reverse.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from rlftsim.envs.failure_study import (
    FAILURES,
    REPEATS,
    Pilot,
    ScenarioEstimate,
    Study,
    StudyConfig,
    load_source,
    read_settings,
    share_budget,
)
from rlftsim.envs.failures import Failure, Repeat
from rlftsim.errors import ConfigError, DataError, EpisodeFailure
from rlftsim.evaluation.resumable import ScenarioValues, check_scenarios_stay, measure_scenarios, read_finished
from rlftsim.jobs.documents import read_json
from rlftsim.jobs.files import remove_temporaries
from rlftsim.jobs.folder import check_folder, describe_differences, find_differences, write_identity
from rlftsim.jobs.runner import Runner

ABOUT = "failures.json"
"""Settings of the study in a folder."""
Value = TypeVar("Value")


@dataclass(frozen=True)
class _Round:
    """Repeats of a scenario that run side by side."""

    scenario_id: str
    number: int
    is_branching: bool

    @property
    def name(self) -> str:
        """Stem of the file."""
        return f"{self.scenario_id}-{'' if self.is_branching else 'quiet'}{self.number}"


def run_study(config: StudyConfig, out: Path, budget: int, runner: Callable[[int], Runner]) -> Study:
    """Estimates of all scenarios, and `failures.parquet`; only what earlier calls left undone is done.

    Args:
        config: Planner, traffic, scenarios and event.
        out: Folder of the study; holds the files of pilots and repeats, too.
        budget: Steps of all pilots and repeats.
        runner: Maker of the runner of a number of items; changes no result.

    Raises:
        ConfigError: A planner that cannot be copied, a budget that is too small, the folder of another study, or a
            result of a larger budget or of further scenarios.
        DataError: In every scenario the event holds at the start, or the ego cannot be driven.
        SetAside, Unfinished: See `run_items`. Shares do the pilot first, and with the same command the repeats.
    """
    ids = config.scenario_ids()
    config.chain(ids[0])  # a planner that cannot be copied ends here
    check_folder(out, "results")
    identity = config.identity()
    differences = find_differences(out / ABOUT, identity, "name another --out")
    if differences:
        described = describe_differences(differences, identity)
        raise ConfigError(f"{out} holds failures of another {described}: name another --out.")
    _check_result_stays(config, ids, out / FAILURES, budget)
    write_identity(out / ABOUT, identity)
    agreed = {"study": identity}  # in the file of each item
    # 1. the pilot
    pilot_files = ScenarioValues(out / "pilot", ids, dict.fromkeys(ids, agreed), _read_pilot)
    drive_pilot = partial(_drive_pilot, config, ids)
    all_pilots: list[Pilot] = measure_scenarios(
        f"pilot of {config.planner}", drive_pilot, pilot_files, runner=runner(len(ids))
    )
    pilots = [pilot for pilot in all_pilots if not pilot.problem]
    if not pilots:
        raise DataError(all_pilots[0].problem)
    # 2. the repeats
    plan = share_budget(pilots, config.particles, budget)
    items = [
        _Round(pilot.scenario_id, number, is_branching)
        for pilot, (count, is_branching) in zip(pilots, plan) for number in range(1, count + 1)
    ]  # fmt: skip
    names = [item.name for item in items]
    files = ScenarioValues(out / "repeats", names, dict.fromkeys(names, agreed), _read_round)
    drive, note = partial(_drive_round, config, items), partial(_describe_estimate, out / "repeats", {})
    rounds: list[tuple[Repeat, ...] | str] = measure_scenarios(
        f"failures of {config.planner}", drive, files, runner=runner(len(items)), note=note
    )
    repeats: dict[str, list[Repeat]] = {pilot.scenario_id: [] for pilot in pilots}
    problems = {pilot.scenario_id: pilot.problem for pilot in all_pilots if pilot.problem}
    for item, finished in zip(items, rounds):
        if isinstance(finished, str):
            problems[item.scenario_id] = finished
        else:
            repeats[item.scenario_id].extend(finished)
    measured = [pilot for pilot in pilots if pilot.scenario_id not in problems]
    if not measured:
        raise DataError(problems[pilots[0].scenario_id])
    estimates = [ScenarioEstimate(tuple(repeats[p.scenario_id]), config.particles, p) for p in measured]
    study = Study(config, tuple(estimates), problems)
    study.write(out / FAILURES, budget)
    remove_temporaries([out / ABOUT, out / FAILURES])  # of processes that were killed
    return study


def _check_result_stays(config: StudyConfig, ids: Sequence[str], path: Path, budget: int) -> None:
    """Check that a quick look with a smaller budget or fewer scenarios does not replace a result of the same study."""
    if (stored := read_finished(path, read_settings)) is None:
        return
    finished, steps = stored
    if budget < steps:
        raise ConfigError(
            f"a budget of {budget} steps is too small for {path}, the result of {steps}, which it would replace: give "
            f"--budget {steps} or more, or name another --out."
        )
    finished_ids = list(finished.scenarios or load_source(config)[1].scenario_ids)[: finished.limit]
    choice = f"limit={config.limit}" if config.limit is not None else "this choice"
    way_out = "name another --out, or drive all scenarios."
    check_scenarios_stay(path, len(finished_ids), len({*finished_ids} - {*ids}), choice, way_out)


def _drive_pilot(config: StudyConfig, ids: Sequence[str], position: int) -> dict[str, object]:
    episodes = config.chain(ids[position])
    try:
        episodes.check_start()
        paths, danger = episodes.start(np.arange(config.pilot))
    except EpisodeFailure as error:  # other scenarios may be driven
        return asdict(Pilot(ids[position], (), 0.0, 0, str(error)))
    driven_m = float(np.mean([path.driven_m for path in paths]))
    worst = tuple(danger.max(1).tolist())
    return asdict(Pilot(ids[position], worst, driven_m, sum(len(path.motion) for path in paths)))


def _read_pilot(name: str, values: Mapping[str, Any]) -> Pilot:
    pilot = _build(Pilot, values)
    if pilot.scenario_id != name:
        raise ValueError("of another scenario")
    return pilot


def _drive_round(config: StudyConfig, items: Sequence[_Round], position: int) -> dict[str, object]:
    item = items[position]
    episodes = config.chain(item.scenario_id, item.number)
    try:
        repeats = episodes.estimate(config.particles, REPEATS, is_branching=item.is_branching)
    except EpisodeFailure as error:  # without this repeat the estimate would be biased: the scenario is left out
        return {"probability": 0.0, "repeats": [], "problem": str(error)}
    return {"probability": float(np.mean([r.probability for r in repeats])), "repeats": [asdict(r) for r in repeats]}


def _read_round(name: str, values: Mapping[str, Any]) -> tuple[Repeat, ...] | str:
    """Repeats of a round, or what the planner did wrong."""
    if problem := values.get("problem"):
        return str(problem)
    repeats = tuple(
        _build(Repeat, {**repeat, "failures": tuple(_build(Failure, failure) for failure in repeat["failures"])})
        for repeat in values["repeats"]
    )
    if len(repeats) != REPEATS:
        raise ValueError("some repeats are missing")
    return repeats


def _build(cls: type[Value], values: Mapping[str, Any]) -> Value:
    """Dataclass of values of a file, of which others are left out.

    Raises:
        KeyError, TypeError, ValueError: The file was cut or edited.
    """
    arguments = {field.name: values[field.name] for field in fields(cls)}  # type: ignore[arg-type]
    # JSON has lists where the dataclasses have tuples
    return cls(**{name: tuple(value) if isinstance(value, list) else value for name, value in arguments.items()})


def _describe_estimate(folder: Path, probabilities: dict[str, float]) -> str:
    """Mean over the scenarios with a repeat, from the files of finished repeats; `probabilities` has those read."""
    for path in folder.glob("*.json"):
        if path.stem not in probabilities:
            with suppress(DataError, OSError, KeyError, TypeError, ValueError):  # a damaged file is made again
                probabilities[path.stem] = float(read_json(path, "measure it again")["probability"])
    of_scenario: dict[str, list[float]] = {}
    for name, probability in probabilities.items():
        of_scenario.setdefault(name.rpartition("-")[0], []).append(probability)
    return f"P so far {np.mean([np.mean(p) for p in of_scenario.values()]):.2g}" if of_scenario else ""
