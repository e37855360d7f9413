"""Planners measured: every scenario driven in several types of traffic, scores in a file for each type.

Interrupted in any way, the same call goes on where the work stopped, see `evaluation.resumable`.
"""

import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import rlftsim
from rlftsim.envs.drive_scenario import ROW_SCORES, DriveConfig, drive_scenarios, load_source
from rlftsim.envs.planners.registry import hash_code
from rlftsim.evaluation.drive_results import DriveResult, DriveSettings
from rlftsim.evaluation.resumable import (
    ScenarioValues,
    check_same_work,
    check_scenarios_stay,
    open_result,
    read_finished,
)
from rlftsim.evaluation.scenario_source import hash_manifest
from rlftsim.jobs.folder import describe_differences
from rlftsim.jobs.items import group_positions, run_items
from rlftsim.jobs.processes import Advance
from rlftsim.jobs.progress import log
from rlftsim.jobs.runner import choose_runner
from rlftsim.rollout.entries import identify_entries
from rlftsim.scenario.dataset import dataset_folder


def drive(config: DriveConfig, out: Path | None = None) -> list[DriveResult]:
    """Scores of a planner in each type of traffic, written to OUT/PLANNER-TRAFFIC.parquet.

    Interrupted in any way, the same call goes on where the work stopped. A type of traffic that is finished is read
    from the file, with a message. A planner with a changed file is driven anew.

    Args:
        config: Planner, data, types of traffic and number of rollouts.
        out: Folder for the Parquet files; None = results are returned and not written.

    Raises:
        ConfigError: an unknown planner, type of traffic or scenario, or a result of other scenarios that a limit or a
            choice would replace.
        DataError: no such data, a scenario that the planner cannot drive, or a folder that cannot be written to.
    """
    # everything that can be refused is refused before anything is driven
    sources = [load_source(config, traffic) for traffic in config.traffic]
    ids = list(config.scenarios or sources[0].scenario_ids)[: config.limit]
    for scenario_id in ids:
        sources[0].scenario(scenario_id)
    base = {
        "planner": config.planner, "dataset": config.data, "split": config.split, "num_rollouts": config.num_rollouts,
        "seed": config.seed, "seconds": float(config.seconds), "rlftsim_version": rlftsim.__version__,
        "planner_code": hash_code(config.planner),
        "manifest_sha256": hash_manifest(dataset_folder(config.data)),
    }  # fmt: skip
    drive_settings = [
        DriveSettings(traffic=name, model=source.fingerprint, entries=identify_entries(source.config.entries), **base)
        for name, source in zip(config.traffic, sources)
    ]
    # processes hand their rows over in files, so even results that are not kept need a folder
    with tempfile.TemporaryDirectory() as nowhere:
        # options such as Careful(gap='wide/far') may have signs that names of files cannot have
        name = re.sub(r"[^\w.()=,+-]+", "", config.planner.replace(":", "."))
        paths = [(out or Path(nowhere)) / f"{name}-{traffic}.parquet" for traffic in config.traffic]
        for settings, path in zip(drive_settings, paths):
            _read_and_refuse(config, settings, ids, path)
        return [_drive_traffic(config, settings, ids, path) for settings, path in zip(drive_settings, paths)]


def _read_finished(config: DriveConfig, settings: DriveSettings, ids: Sequence[str], path: Path) -> DriveResult | None:
    """The result of an earlier call for the same scenarios in the same type of traffic; None if there is none.

    Args:
        config: Planner, data and scenarios of the call.
        settings: Values that the result must agree with.
        ids: Ids of the scenarios that the result must have, in this order.
        path: File of the result.

    Raises:
        ConfigError: The stored result has other scenarios, which a limit or a choice would replace.
    """
    result = _read_and_refuse(config, settings, ids, path)
    if result is None:
        return None
    differing = _differences(result.settings, settings)
    if result.scenario_ids != list(ids):
        differing.append("choice of scenarios")
    if differing:
        log.info(f"{path} is of another {', '.join(differing)}: it will be replaced.")
        return None
    # code beside the planner's file, or its weights, may have changed
    log.info(f"{path} is finished and is read: remove it to drive anew.")
    return result


def _differences(stored: DriveSettings, current: DriveSettings) -> list[str]:
    """Names of the values that count and differ."""
    stored_values, values = stored.what_counts(), current.what_counts()
    return [name for name in values if stored_values.get(name) != values[name]]


def _read_and_refuse(
    config: DriveConfig, settings: DriveSettings, ids: Sequence[str], path: Path
) -> DriveResult | None:
    """The stored result, unless of other work, or a limit or a choice would leave out some of the stored scenarios."""
    result = read_finished(path, DriveResult.read)
    choice = f"limit={config.limit}" if config.limit is not None else "this choice" if config.scenarios else ""
    if result is not None and choice:
        left_out = len({*result.scenario_ids} - {*ids})
        way_out = "name another --out, or drive all scenarios."
        check_scenarios_stay(path, len(result.scenario_ids), left_out, choice, way_out)
    if result is not None:
        # a planner whose code has changed is driven anew, and so is one of an older version of this package
        differing = {*_differences(result.settings, settings)} - {"planner_code", "rlftsim_version"}
        stored, current = result.settings.what_counts(), settings.what_counts()
        described = describe_differences({name: stored.get(name) for name in sorted(differing)}, current)
        check_same_work(path, described, "choose another --out")
    return result


def _drive_traffic(config: DriveConfig, settings: DriveSettings, ids: Sequence[str], path: Path) -> DriveResult:
    """Drive the missing scenarios in a type of traffic and write the result, unless finished.

    Args:
        config: Planner, data, scenarios and processes of the call.
        settings: Values that the result must agree with.
        ids: Ids of the scenarios of the result.
        path: File of the result; finished scenarios lie beside this file until all are there.
    """
    identity = {"settings": settings.what_counts()}
    files = ScenarioValues(path.with_suffix(".parts"), ids, dict.fromkeys(ids, identity), _row_and_missing)
    runner, find = choose_runner(config.jobs, len(ids)), partial(_read_finished, config, settings, ids, path)

    with open_result(path, files, find, runner) as opened:
        if isinstance(opened, DriveResult):
            return opened
        groups = group_positions(len(ids), config.count_side_by_side(settings.traffic, len(ids)))
        title = f"{config.planner} in {settings.traffic}"
        task = partial(_drive_group, config, settings.traffic, files)
        stored = run_items(title, groups, task, format=files, lease=opened)
        rows = [row for group in stored for row in group]
        missing = {row["scenario_id"]: reasons for row, reasons in rows}
        result = DriveResult.of(settings, [row for row, _ in rows], missing)
        result.write(path)
    return result


Row = tuple[dict[str, Any], dict[str, str]]


def _drive_group(
    config: DriveConfig,
    traffic: str,
    files: ScenarioValues[Row],
    group: range,
    advance: Advance,
    is_stopped: Callable[[], bool],
) -> None:
    """Drive the scenarios of a group that have no file."""
    positions = [position for position in group if not files.is_finished(range(position, position + 1))]
    advance(len(group) - len(positions))
    if is_stopped():  # another process failed, or Ctrl-C
        return
    rows = drive_scenarios(config, traffic, files.scenario_ids, positions)
    for position, row in zip(positions, rows):
        files.write(range(position, position + 1), [row])
    advance(len(positions))


def _row_and_missing(scenario_id: str, values: Mapping[str, Any]) -> Row:
    """Row of a scenario, and the scores that the scenario cannot give, as the file has both.

    Raises:
        KeyError, TypeError, ValueError: the file was cut or edited.
    """
    row, missing = values["row"], values["missing"]
    if row["scenario_id"] != scenario_id or not all(isinstance(reason, str) for reason in missing.values()):
        raise ValueError("of another scenario, or without a reason")
    numbers = {name: float(row[name]) for name in ROW_SCORES}
    return {"scenario_id": scenario_id, "traffic": values["settings"]["traffic"], **numbers}, missing
