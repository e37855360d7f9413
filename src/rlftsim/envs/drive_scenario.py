"""A scenario driven by a planner: scores, and films."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import cast

import numpy as np

from rlftsim.envs.config import EnvConfig
from rlftsim.envs.drivers import TRAFFIC, Traffic
from rlftsim.envs.ego_env import EgoEnv
from rlftsim.envs.planners.registry import Planner, guard_planner, load_planner, read_action_settings
from rlftsim.envs.result import SCORE_NAMES, Result, build_animation
from rlftsim.envs.source import Source, check_choice
from rlftsim.envs.traffic_scores import blamed_others_rate, compute_traffic_realism
from rlftsim.errors import ConfigError, EpisodeFailure, in_short, whole_number
from rlftsim.evaluation.drive_results import FAILED, DriveResult, find_failures, is_failure, rank_scenarios
from rlftsim.scenario.types import Scenario, count_steps
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
    seconds: float = 8.0
    """Length of the episodes."""
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
        count_steps(self.seconds)
        check_choice(self.scenarios, self.limit)
        for traffic in self.traffic or ("",):
            if traffic not in TRAFFIC:
                raise ConfigError(f"traffic must be some of {', '.join(TRAFFIC)}, got {traffic!r}.")
        if len(set(self.traffic)) < len(self.traffic):
            raise ConfigError(f"traffic names a type twice: {', '.join(self.traffic)}.")
        if self.film is not None and not FILMS.fullmatch(self.film):
            raise ConfigError(f"film must be first, failures, or worst:N such as worst:5, got {in_short(self.film)}.")

    def settings(self, traffic: str) -> EnvConfig:
        """Settings of the environment for a type of traffic: no event ends an episode, and no reward is given."""
        return EnvConfig(
            data=self.data, split=self.split, model=self.model, traffic=cast(Traffic, traffic), stop_on=(),
            reward="none", max_steps=count_steps(self.seconds), **read_action_settings(load_planner(self.planner)),
        )  # fmt: skip


def run_planner(env: EgoEnv, planner: Planner, scenario: Scenario, *, seed: int, rollout: int = 0) -> Result:
    """Drive a scenario from the current step to the end.

    Args:
        env: Environment with the planner's type of action.
        planner: Planner that drives, made by `load_planner`.
        scenario: Scenario of the environment to drive to the end.
        seed: Seed of the traffic; equal seeds, equal traffic for every planner.
        rollout: Number of the rollout, 0 or more; each with dice of its own.

    Raises:
        EpisodeFailure: SUMO fails, or the planner raises an error, calls exit(), or wants what its type of action does
            not allow.
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


def drive_scenario(config: DriveConfig, traffic: str, ids: Sequence[str], position: int) -> dict[str, object]:
    """Row of a scenario, and the scores that the scenario cannot give."""
    env, planner = make_environment(config, traffic), load_planner(config.planner)
    scenario = env.source.scenario(ids[position])
    rollouts = range(config.num_rollouts)
    try:
        results = [run_planner(env, planner, scenario, seed=config.seed, rollout=rollout) for rollout in rollouts]
    except EpisodeFailure as failure:  # of one rollout counts for the scenario
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
def make_environment(config: DriveConfig, traffic: str) -> EgoEnv:
    """Environment of a type of traffic, made once in each process."""
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
        failing = {scenario_id for result in results for scenario_id in find_failures(result)}
        return [scenario.scenario_id for scenario in worst if scenario.scenario_id in failing]
    return [scenario.scenario_id for scenario in worst[: int(choice.partition(":")[2])]]


def write_film(config: DriveConfig, scenario_id: str, out: Path) -> Path:
    """Write a film of a scenario, the types of traffic side by side; returns the path.

    With `film="failures"` each traffic shows the first rollout with a failure, else the first rollout.

    Args:
        config: Planner, data, types of traffic and number of rollouts.
        scenario_id: Scenario of the data set.
        out: Folder for the film SCENARIO.webp.

    Raises:
        EpisodeFailure: The planner or SUMO fails in this scenario.
    """
    records, scores = {}, []
    for traffic in config.traffic:
        env = make_environment(config, traffic)
        planner, scenario = load_planner(config.planner), env.source.scenario(scenario_id)
        rollouts = range(config.num_rollouts if config.film == "failures" else 1)
        results = (run_planner(env, planner, scenario, seed=config.seed, rollout=rollout) for rollout in rollouts)
        first = next(results)
        shown = first if is_failure(first.scores) else next((r for r in results if is_failure(r.scores)), first)
        records[f"{config.planner} in {traffic}"] = shown.record
        scores.append(shown.planner.nuplan_style)
    path = out / f"{scenario_id}.webp"
    to_film(path, build_animation(records, scores), steps_per_frame=2, dots_per_inch=70)
    return path
