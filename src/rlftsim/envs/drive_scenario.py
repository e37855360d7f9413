"""Scenarios driven by a planner, and their scores."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import cast

import numpy as np

from rlftsim.envs.config import MAX_STEPS, EnvConfig
from rlftsim.envs.drivers import TRAFFIC, Traffic
from rlftsim.envs.planner_episode import run_planner
from rlftsim.envs.planner_scores import blamed_others_rate, compute_traffic_realism
from rlftsim.envs.planners.batch import acts_in_batches
from rlftsim.envs.planners.registry import load_planner, read_action_settings
from rlftsim.envs.result import SCORE_NAMES, Result
from rlftsim.envs.source import Source, check_choice
from rlftsim.errors import ConfigError, EpisodeFailure, in_short, whole_number
from rlftsim.evaluation.drive_results import FAILED
from rlftsim.jobs.progress import log
from rlftsim.scenario.types import STEP_S, count_steps
from rlftsim.statistics import mean_interval

ROW_SCORES = (*SCORE_NAMES, "blamed_others_rate", "others_realism")
"""Scores in the row of a scenario."""
SIDE_BY_SIDE = 16
"""Episodes that are driven or kept at once at most."""
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
    entries: str | None = None
    """Model of who enters traffic "policy", see `EnvConfig.entries`."""
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
        if count_steps(self.seconds) > MAX_STEPS:
            raise ConfigError(f"seconds must be at most {STEP_S * MAX_STEPS:g}, got {in_short(self.seconds)}.")
        check_choice(self.scenarios, self.limit)
        for traffic in self.traffic or ("",):
            if traffic not in TRAFFIC:
                raise ConfigError(
                    f"traffic must be some of {', '.join(TRAFFIC)}, got {traffic!r}: 'policy' is the model of --model."
                )
        if len(set(self.traffic)) < len(self.traffic):
            raise ConfigError(f"traffic names a type twice: {', '.join(self.traffic)}.")
        if self.entries is not None and "policy" not in self.traffic:
            raise ConfigError(f"entries={self.entries} has no effect: add policy to the traffic, or leave it out.")
        if self.film is not None and not FILMS.fullmatch(self.film):
            raise ConfigError(f"film must be first, failures, or worst:N such as worst:5, got {in_short(self.film)}.")

    def settings(self, traffic: str) -> EnvConfig:
        """Settings of the environment for a type of traffic: no event ends an episode, and no reward is given."""
        return EnvConfig(
            data=self.data, split=self.split, model=self.model, traffic=cast(Traffic, traffic), stop_on=(),
            entries=self.entries if traffic == "policy" else None, reward="none", max_steps=count_steps(self.seconds),
            **read_action_settings(load_planner(self.planner)),
        )  # fmt: skip

    def count_side_by_side(self, traffic: str, num_scenarios: int) -> int:
        """Number of scenarios that are driven at once, such that every process has some.

        Args:
            traffic: Driver of the other agents. Worlds of SUMO and of IDM agents run one after the other; so does a
                traffic model, whose last bits depend on what else is in a batch and may decide for another token.
            num_scenarios: Number of scenarios in the whole work.
        """
        if traffic not in ("replay", "constant_velocity") or not acts_in_batches(load_planner(self.planner)):
            return 1
        return max(min(SIDE_BY_SIDE // self.num_rollouts, num_scenarios // self.jobs), 1)


def drive_scenarios(
    config: DriveConfig, traffic: str, ids: Sequence[str], positions: Sequence[int]
) -> list[dict[str, object]]:
    """Rows of scenarios that are driven side by side, and the scores that each scenario cannot give."""
    source, planner = load_source(config, traffic), load_planner(config.planner)
    scenarios = [source.scenario(ids[position]) for position in positions]
    try:
        episodes = run_planner(source, planner, scenarios, seed=config.seed, rollouts=range(config.num_rollouts))
        results = [rollout for rollout, _ in episodes]
    except EpisodeFailure as failure:
        if len(positions) > 1:  # the scenarios in which nothing fails have their scores
            log.warning(f"{failure} These scenarios are driven one by one.")
            return [row for position in positions for row in drive_scenarios(config, traffic, ids, [position])]
        row = {"scenario_id": ids[positions[0]], "traffic": traffic, **dict.fromkeys(ROW_SCORES, math.nan)}
        return [{"row": row, "missing": {FAILED: str(failure)}}]  # of one rollout counts for the scenario
    return [_build_row(ids[position], traffic, rows) for position, rows in zip(positions, zip(*results))]


def _build_row(scenario_id: str, traffic: str, results: Sequence[Result]) -> dict[str, object]:
    """Row of a scenario by the results of the rollouts."""
    rows = [result.scores for result in results]
    # a rollout that cannot give a score leaves it to the others
    means = {name: mean_interval(np.array([row[name] for row in rows])).mean for name in rows[0]}
    collisions = [collision for result in results for collision in result.record.collisions]
    means["blamed_others_rate"] = blamed_others_rate(collisions)
    realism = compute_traffic_realism([result.record for result in results])
    row = {"scenario_id": scenario_id, "traffic": traffic, **means, "others_realism": realism}
    return {"row": row, "missing": results[0].missing}


@lru_cache(maxsize=8)
def load_source(config: DriveConfig, traffic: str) -> Source:
    """Scenarios and model of a type of traffic, loaded once in each process."""
    return Source(config.settings(traffic))
