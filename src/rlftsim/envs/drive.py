"""Planners measured: every scenario driven in several kinds of traffic, scores in one file for each kind."""

from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, cast

import numpy as np

import rlftsim
from rlftsim.atomic_io import errors_name
from rlftsim.envs.config import EnvConfig
from rlftsim.envs.drivers import TRAFFIC, Traffic
from rlftsim.envs.ego_env import EgoEnv
from rlftsim.envs.planners.registry import Planner, action_of, horizon_of, load_planner
from rlftsim.envs.result import Result, animation_of
from rlftsim.envs.source import Source
from rlftsim.envs.traffic_scores import blamed_others_rate, realism_of_others
from rlftsim.errors import ConfigError, whole_number
from rlftsim.evaluation.drive_results import DriveResult, DriveSettings
from rlftsim.progress import progress_bar
from rlftsim.scenario.types import Scenario
from rlftsim.statistics import mean_interval
from rlftsim.threads import one_thread
from rlftsim.viewer.film import to_film
from rlftsim.workers import on_this_machine


@dataclass(frozen=True)
class DriveConfig:
    """A planner, its scenarios and its traffic."""

    planner: str
    """Name of a planner, or package.module:Class."""
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

    def settings(self, traffic: str) -> EnvConfig:
        """Settings of the environment for one kind of traffic: nothing ends an episode, and nothing is rewarded."""
        planner = load_planner(self.planner)
        return EnvConfig(
            data=self.data, split=self.split, model=self.model, traffic=cast(Traffic, traffic),
            action=action_of(planner), horizon=horizon_of(planner), stop_on=(), reward="none",
        )  # fmt: skip


def drive(config: DriveConfig, out: Path | None = None) -> list[DriveResult]:
    """Scores of a planner in each kind of traffic, written to OUT/PLANNER-TRAFFIC.parquet.

    Args:
        config: what is driven.
        out: folder for the files; None writes none.

    Raises:
        ConfigError: an unknown planner, kind of traffic or scenario.
        DataError: no such data, or a scenario that the planner cannot drive.
    """
    environments = [_environment(config, traffic) for traffic in config.traffic]  # refuses before anything is driven
    ids = list(config.scenarios or environments[0].source.scenario_ids)[: config.limit]
    for scenario_id in ids:
        environments[0].source.scenario(scenario_id)
    if out is not None:
        with errors_name(out):
            out.mkdir(parents=True, exist_ok=True)
    name = config.planner.replace(":", ".")
    results = []
    for traffic, env in zip(config.traffic, environments):
        with progress_bar(f"{name} in {traffic}", len(ids)) as advance, one_thread():
            runner = on_this_machine(config.jobs, len(ids))
            found = runner.run(partial(_drive_scenario, config, traffic), ids, advance=advance)
        settings = DriveSettings(
            planner=config.planner, traffic=traffic, model=env.source.fingerprint, dataset=config.data,
            split=config.split, num_rollouts=config.num_rollouts, seed=config.seed, rlftsim_version=rlftsim.__version__,
        )  # fmt: skip
        result = DriveResult.of(settings, [row for row, _ in found], {row["scenario_id"]: why for row, why in found})
        if out is not None:
            result.write(out / f"{name}-{traffic}.parquet")
        results.append(result)
    return results


def run_planner(env: EgoEnv, planner: Planner, scenario: Scenario, *, seed: int, rollout: int = 0) -> Result:
    """Drive one scenario from the current step to the end.

    Args:
        env: whose actions are those of the planner.
        planner: drives.
        scenario: one of the environment's.
        seed: of the traffic.
        rollout: number of the dice.
    """
    observation, info = env.reset(seed=seed, options={"scenario": scenario.scenario_id, "rollout": rollout})
    planner.reset(info)
    while not env.state.ended[0]:
        observation, *_ = env.step(planner.act(observation))
    return env.result()


def _drive_scenario(
    config: DriveConfig, traffic: str, scenario_id: str, advance: Any, stop: Any
) -> tuple[dict[str, Any], dict[str, str]]:
    """Row of one scenario, and the scores that it cannot give."""
    env, planner = _environment(config, traffic), load_planner(config.planner)
    scenario = env.source.scenario(scenario_id)
    results = [
        run_planner(env, planner, scenario, seed=config.seed, rollout=rollout) for rollout in range(config.num_rollouts)
    ]
    rows = [{**asdict(result.planner), **asdict(result.traffic)} for result in results]
    # a rollout that cannot give a score leaves it to the others
    means = {name: mean_interval(np.array([row[name] for row in rows])).mean for name in rows[0]}
    means["blamed_others_rate"] = blamed_others_rate([one for result in results for one in result.record.collisions])
    realism = realism_of_others([result.record for result in results])
    advance(1)
    return {"scenario_id": scenario_id, "traffic": traffic, **means, "others_realism": realism}, results[0].missing


@lru_cache(maxsize=8)
def _environment(config: DriveConfig, traffic: str) -> EgoEnv:
    """Environment of one kind of traffic, made once in each process."""
    return EgoEnv(source=Source(config.settings(traffic)))


def film(config: DriveConfig, out: Path) -> Path:
    """Write a film of the first scenario, the kinds of traffic side by side; returns its path.

    Args:
        config: what is driven.
        out: folder for the file.
    """
    records = {}
    for traffic in config.traffic:
        env = _environment(config, traffic)
        scenario = env.source.scenario((config.scenarios or env.source.scenario_ids)[0])
        result = run_planner(env, load_planner(config.planner), scenario, seed=config.seed)
        records[f"{config.planner} in {traffic}"] = result.record
    path = out / f"{scenario.scenario_id}.webp"
    to_film(path, animation_of(records), every=2, dots_per_inch=70)
    return path
