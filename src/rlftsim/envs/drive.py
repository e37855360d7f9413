"""Planners measured: every scenario driven in several kinds of traffic, scores in a file for each kind.

Interrupted in any way, the same call goes on where the work stopped, see `evaluation.resumable`.
"""

import math
import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, cast

import numpy as np

import rlftsim
from rlftsim.envs.config import EnvConfig
from rlftsim.envs.drivers import TRAFFIC, Traffic
from rlftsim.envs.ego_env import EgoEnv
from rlftsim.envs.planners.registry import (
    Planner,
    PlannerFailure,
    guard_planner,
    hash_code,
    load_planner,
    read_action_settings,
)
from rlftsim.envs.result import SCORE_NAMES, Result, build_animation
from rlftsim.envs.source import Source
from rlftsim.envs.traffic_scores import blamed_others_rate, compute_traffic_realism
from rlftsim.errors import ConfigError, in_short, whole_number
from rlftsim.evaluation.drive_results import FAILED, FAILURES, DriveResult, DriveSettings, rank_scenarios
from rlftsim.evaluation.resumable import (
    ScenarioValues,
    check_same_work,
    check_scenarios_stay,
    claim_result,
    read_finished,
    run_groups,
)
from rlftsim.evaluation.scenario_source import hash_manifest
from rlftsim.jobs.progress import log
from rlftsim.jobs.runner import choose_runner
from rlftsim.scenario.dataset import dataset_folder
from rlftsim.scenario.types import Scenario
from rlftsim.statistics import mean_interval
from rlftsim.viewer.film import to_film

ROW_SCORES = (*SCORE_NAMES, "blamed_others_rate", "others_realism")
"""Scores in the row of a scenario."""
FILMS = re.compile(r"first|failures|worst:[1-9]\d{0,5}")


@dataclass(frozen=True)
class DriveConfig:
    """A planner, the scenarios and the traffic."""

    planner: str
    """Name of a planner, or package.module:Class, with options such as careful:Careful(headway=1.0) if any."""
    data: str = "synthetic"
    split: str | None = "validation"
    model: str = "demo-base"
    """Traffic model."""
    traffic: tuple[str, ...] = ("policy", "replay")
    num_rollouts: int = 1
    """Episodes of each scenario, with dice of their own."""
    seed: int = 0
    limit: int | None = None
    """Only the first so many scenarios."""
    scenarios: tuple[str, ...] | None = None
    """Only these, by id."""
    jobs: int = 1
    """Processes. Changes no result."""
    film: str | None = None
    """Scenarios to film, see `choose_films`. Changes no result."""

    def __post_init__(self) -> None:
        for name in ("num_rollouts", "jobs"):
            whole_number(name, getattr(self, name), 1)
        whole_number("seed", self.seed, 0)
        if self.limit is not None:
            whole_number("limit", self.limit, 1)
        for traffic in self.traffic or ("",):
            if traffic not in TRAFFIC:
                raise ConfigError(f"traffic must be some of {', '.join(TRAFFIC)}, got {traffic!r}.")
        if len(set(self.traffic)) < len(self.traffic):
            raise ConfigError(f"traffic names one kind twice: {', '.join(self.traffic)}.")
        if len(set(self.scenarios or ())) < len(self.scenarios or ()):
            raise ConfigError(f"scenarios names one twice: {', '.join(self.scenarios or ())}.")
        if self.film is not None and not FILMS.fullmatch(self.film):
            raise ConfigError(f"film must be first, failures, or worst:N such as worst:5, got {in_short(self.film)}.")

    def settings(self, traffic: str) -> EnvConfig:
        """Settings of the environment for a kind of traffic: no event ends an episode, and no reward is given."""
        return EnvConfig(
            data=self.data, split=self.split, model=self.model, traffic=cast(Traffic, traffic), stop_on=(),
            reward="none", **read_action_settings(load_planner(self.planner)),
        )  # fmt: skip


def drive(config: DriveConfig, out: Path | None = None) -> list[DriveResult]:
    """Scores of a planner in each kind of traffic, written to OUT/PLANNER-TRAFFIC.parquet.

    Interrupted in any way, the same call goes on where the work stopped. A kind of traffic that is finished is read
    from the file, with a message. A planner with a changed file is driven anew.

    Args:
        config: Planner, data, kinds of traffic and number of rollouts.
        out: Folder for the Parquet files; None = results are returned and not written.

    Raises:
        ConfigError: an unknown planner, kind of traffic or scenario, or a result of other scenarios that a limit or a
            choice would replace.
        DataError: no such data, a scenario that the planner cannot drive, or a folder that cannot be written to.
    """
    # everything that can be refused is refused before anything is driven
    environments = [_environment(config, traffic) for traffic in config.traffic]
    ids = list(config.scenarios or environments[0].source.scenario_ids)[: config.limit]
    for scenario_id in ids:
        environments[0].source.scenario(scenario_id)
    common_settings = {
        "planner": config.planner, "dataset": config.data, "split": config.split, "num_rollouts": config.num_rollouts,
        "seed": config.seed, "rlftsim_version": rlftsim.__version__,
        "planner_code": hash_code(config.planner),
        "manifest_sha256": hash_manifest(dataset_folder(config.data)),
    }  # fmt: skip
    drive_settings = [
        DriveSettings(traffic=traffic, model=env.source.fingerprint, **common_settings)
        for traffic, env in zip(config.traffic, environments)
    ]
    # processes hand their rows over in files, so even results that are not kept need a folder
    with tempfile.TemporaryDirectory() as nowhere:
        # options such as Careful(gap='wide/far') may have signs that names of files cannot have
        name = re.sub(r"[^\w.()=,+-]+", "", config.planner.replace(":", "."))
        paths = [(out or Path(nowhere)) / f"{name}-{traffic}.parquet" for traffic in config.traffic]
        for settings, path in zip(drive_settings, paths):
            _read_and_refuse(config, settings, ids, path)
        return [_drive_traffic(config, settings, ids, path) for settings, path in zip(drive_settings, paths)]


def run_planner(env: EgoEnv, planner: Planner, scenario: Scenario, *, seed: int, rollout: int = 0) -> Result:
    """Drive a scenario from the current step to the end.

    Args:
        env: Environment with the planner's type of action.
        planner: Planner that drives, made by `load_planner`.
        scenario: Scenario of the environment to drive to the end.
        seed: Seed of the traffic; equal seeds, equal traffic for every planner.
        rollout: Number of the rollout, 0 or more; each with dice of its own.

    Raises:
        PlannerFailure: The planner raises an error, calls exit(), or wants what its type of action does not allow.
    """
    observation, info = env.reset(seed=seed, options={"scenario": scenario.scenario_id, "rollout": rollout})
    with guard_planner(planner, scenario.scenario_id, lambda: env.state.world.step):
        planner.reset(info)
    while not env.state.ended[0]:
        with guard_planner(planner, scenario.scenario_id, lambda: env.state.world.step):
            action = planner.act(observation)
        # of a step of the world only the action is the planner's
        with guard_planner(planner, scenario.scenario_id, lambda: env.state.world.step, errors=(ConfigError,)):
            observation, *_ = env.step(action)
    return env.result()


def _read_finished(config: DriveConfig, settings: DriveSettings, ids: Sequence[str], path: Path) -> DriveResult | None:
    """The result of an earlier call for the same scenarios in the same kind of traffic; None if there is none.

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
        check_same_work(path, sorted(differing), "choose another --out")
    return result


def _drive_traffic(config: DriveConfig, settings: DriveSettings, ids: Sequence[str], path: Path) -> DriveResult:
    """Drive the missing scenarios in a kind of traffic and write the result, unless finished.

    Args:
        config: Planner, data, scenarios and processes of the call.
        settings: Values that the result must agree with.
        ids: Ids of the scenarios of the result.
        path: File of the result; finished scenarios lie beside this file until all are there.
    """
    identity = {"settings": settings.what_counts()}
    format = ScenarioValues(path.with_suffix(".parts"), ids, dict.fromkeys(ids, identity), _row_and_missing)
    runner, find = choose_runner(config.jobs, len(ids)), partial(_read_finished, config, settings, ids, path)
    with claim_result(path, format, ids, find, runner) as claim:
        if claim.lease is not None:
            work = partial(_drive_scenario, config, settings.traffic, ids)
            rows = run_groups(f"{config.planner} in {settings.traffic}", ids, work, format, claim.lease, runner)
            missing = {row["scenario_id"]: reasons for row, reasons in rows}
            claim.result = DriveResult.of(settings, [row for row, _ in rows], missing)
    assert claim.result is not None
    return claim.result


def _row_and_missing(scenario_id: str, values: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, str]]:
    """Row of a scenario, and the scores that the scenario cannot give, as the file has both.

    Raises:
        KeyError, TypeError, ValueError: the file was cut or edited.
    """
    row, missing = values["row"], values["missing"]
    if row["scenario_id"] != scenario_id or not all(isinstance(reason, str) for reason in missing.values()):
        raise ValueError("of another scenario, or without a reason")
    numbers = {name: float(row[name]) for name in ROW_SCORES}
    return {"scenario_id": scenario_id, "traffic": values["settings"]["traffic"], **numbers}, missing


def _drive_scenario(config: DriveConfig, traffic: str, ids: Sequence[str], position: int) -> dict[str, object]:
    """Row of a scenario, and the scores that the scenario cannot give."""
    env, planner = _environment(config, traffic), load_planner(config.planner)
    scenario = env.source.scenario(ids[position])
    rollouts = range(config.num_rollouts)
    try:
        results = [run_planner(env, planner, scenario, seed=config.seed, rollout=rollout) for rollout in rollouts]
    except PlannerFailure as failure:  # of one rollout counts for the scenario
        row = {"scenario_id": ids[position], "traffic": traffic, **dict.fromkeys(ROW_SCORES, math.nan)}
        return {"row": row, "missing": {FAILED: str(failure)}}
    rows = [result.scores for result in results]
    # a rollout that cannot give a score leaves it to the others
    means = {name: mean_interval(np.array([row[name] for row in rows])).mean for name in rows[0]}
    collisions = [collision for result in results for collision in result.record.collisions]
    means["blamed_others_rate"] = blamed_others_rate(collisions)
    realism = compute_traffic_realism([result.record for result in results])
    row = {"scenario_id": ids[position], "traffic": traffic, **means, "others_realism": realism}
    return {"row": row, "missing": results[0].missing}


@lru_cache(maxsize=8)
def _environment(config: DriveConfig, traffic: str) -> EgoEnv:
    """Environment of a kind of traffic, made once in each process."""
    return EgoEnv(source=Source(config.settings(traffic)))


def choose_films(results: Sequence[DriveResult], choice: str) -> list[str]:
    """Ids of the scenarios to film, the worst first; none in which the planner failed.

    Args:
        results: Results of a planner in all types of traffic.
        choice: "first"; "worst:N" for the N lowest scores `nuplan_style` in any traffic; "failures" for scenarios in
            which the planner is at fault for a collision or leaves the road.
    """
    failed = {scenario_id for result in results for scenario_id in result.failures}
    if choice == "first":
        return [scenario_id for scenario_id in results[0].scenario_ids if scenario_id not in failed][:1]
    worst = [scenario for scenario in rank_scenarios(results) if scenario.scenario_id not in failed]
    if choice == "failures":
        return [scenario.scenario_id for scenario in worst if {*scenario.causes} & {*FAILURES}]
    return [scenario.scenario_id for scenario in worst[: int(choice.partition(":")[2])]]


def film(config: DriveConfig, scenario_id: str, out: Path) -> Path:
    """Write a film of a scenario, the types of traffic side by side; returns the path.

    Args:
        config: Planner, data, types of traffic and number of rollouts.
        scenario_id: Scenario of the data set.
        out: Folder for the film SCENARIO.webp.

    Raises:
        PlannerFailure: The planner fails in this scenario.
    """
    records = {}
    for traffic in config.traffic:
        env = _environment(config, traffic)
        planner, scenario = load_planner(config.planner), env.source.scenario(scenario_id)
        records[f"{config.planner} in {traffic}"] = run_planner(env, planner, scenario, seed=config.seed).record
    path = out / f"{scenario_id}.webp"
    to_film(path, build_animation(records), steps_per_frame=2, dots_per_inch=70)
    return path
