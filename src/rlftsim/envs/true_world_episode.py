"""An episode of a planner in a world that made a log, or in other traffic, as a row of scores."""

import math
import re
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from rlftsim.envs.planner_episode import run_planner
from rlftsim.envs.planner_scores import PlannerScores
from rlftsim.envs.planners.registry import load_planner, read_action_settings
from rlftsim.envs.result import Result
from rlftsim.envs.sumo_traffic import SumoState
from rlftsim.envs.true_world_traffic import Surroundings, list_conflicts, load_scenario, load_source
from rlftsim.errors import EpisodeFailure
from rlftsim.jobs.progress import log
from rlftsim.scenario.types import CURRENT_STEP

PLANNERS = {
    "log": "replay", "constant_velocity": "constant_velocity", "idm": "idm", "pdm": "pdm",
    "timid": "rlftsim.envs.planners.flawed:Timid", "rush": "rlftsim.envs.planners.flawed:Rush",
    "late_braker": "rlftsim.envs.planners.flawed:LateBraker", "hard_braker": "rlftsim.envs.planners.flawed:HardBraker",
}  # fmt: skip
"""Planners from good to bad by name: among planners of one quality a ranking means nothing."""
SCORES = tuple(field.name for field in fields(PlannerScores))
COUNTS = ("distance_m", "off_lane_steps", "num_strangers", "seconds")
"""Distance from the log at the end, steps at which SUMO did not see the ego, road users of SUMO alone that came near,
and CPU time of this process."""
TEXTS = ("network", "window", "conflicts", "planner", "traffic")


@dataclass(frozen=True)
class Trip:
    """An episode to drive."""

    data: str
    window: str
    """Id of a scenario with a world."""
    network: str
    surroundings: Surroundings
    planner: str
    """Name of `PLANNERS`, or any that `load_planner` takes."""
    seed: int
    is_random: bool = True
    """False = the window was chosen for its conflict."""
    rollout: int = 0
    """Number of the rollout, each with dice of its own."""

    @property
    def name(self) -> str:
        """Stem of the file."""
        name = re.sub(r"[^\w.()=,+-]+", ".", f"{self.window}-{self.surroundings.name}-{self.planner}")
        return f"{name}~{self.rollout}" if self.rollout else name

    @property
    def planner_name(self) -> str:
        """Name that `load_planner` takes."""
        return PLANNERS.get(self.planner, self.planner)

    def run(self) -> tuple[Result, tuple[SumoState, ...]]:
        """Result of the episode, and the last states of SUMO if it drives.

        Raises:
            EpisodeFailure: The planner or SUMO fails.
        """
        planner, scenario = load_planner(self.planner_name), load_scenario(self.data, self.window)
        settings = tuple(sorted(read_action_settings(planner).items()))
        source = load_source(self.data, self.window, self.surroundings, settings)
        (((result,), state),) = run_planner(source, planner, [scenario], seed=self.seed, rollouts=[self.rollout])
        return result, state.world.sumo_states

    def drive(self) -> dict[str, object]:
        """Row of the episode; NaN where the planner fails, or SUMO."""
        begin = time.process_time()
        row: dict[str, object] = {
            "network": self.network, "window": self.window,
            "conflicts": " ".join(sorted(list_conflicts(self.data, self.window))), "planner": self.planner,
            "traffic": self.surroundings.name, "rollout": self.rollout,
        }  # fmt: skip
        try:
            result, sumo_states = self.run()
        except EpisodeFailure as failure:
            log.warning(str(failure))
            return {"row": row | dict.fromkeys((*SCORES, *COUNTS), math.nan)}
        record = result.record
        offset = record.agent_motion[-1, :2] - record.scene.logged[record.agent, CURRENT_STEP + record.steps, :2]
        counts = {
            "distance_m": float(np.hypot(*offset)),
            "off_lane_steps": float(sum(state.off_lane_steps for state in sumo_states)),
            "num_strangers": float(sum(state.num_strangers for state in sumo_states)),
            "seconds": time.process_time() - begin,
        }
        return {"row": row | asdict(result.planner) | counts}


def read_row(name: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Row of an episode's file.

    Args:
        name: Stem of the file.
        values: Contents of the file.

    Raises:
        KeyError, TypeError, ValueError: The file was cut or edited.
    """
    row = values["row"]
    numbers = {column: float(row[column]) for column in (*SCORES, *COUNTS)}
    texts = {column: str(row[column]) for column in TEXTS}
    return {**texts, "rollout": int(row["rollout"]), **numbers}
