"""A reward, an exporter and a planner for rlftsim: the smallest of each kind that does something."""

import csv
from pathlib import Path

from torch import Tensor

from rlftsim.realism import RealismResult, SimulatedStates
from rlftsim.rewards import leave_one_out
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import Scenario


def on_the_road(scores: RealismResult, rollouts: Rollouts, batch: ScenarioBatch, *, scale: float = 1.0) -> Tensor:
    """Off-road rate of the evaluated agents, against the other rollouts of the scenario, shape [B, N].

    Use: `rlftsim finetune smart-demo --finetune.reward "mloo + 0.1*on_the_road(scale=2)" ...`
    """
    return leave_one_out(-scale * scores.rollout_offroad_rate)


def write_csv(scenario: Scenario, states: SimulatedStates, folder: Path) -> Path:
    """Where every agent ends, a line per rollout and agent: FOLDER/SCENARIO.csv, world frame, meters.

    Use: `rlftsim simulate demo-base --data synthetic --out rollouts --export csv`
    """
    path = folder / f"{scenario.scenario_id}.csv"
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["rollout", "agent", "x", "y"])
        for rollout in range(len(states.x)):
            for row, agent in enumerate(states.object_id.tolist()):
                table.writerow([rollout, agent, float(states.x[rollout, row, -1]), float(states.y[rollout, row, -1])])
    return path


def coast(observation: dict) -> list[float]:
    """Acceleration and steering of a planner that touches neither pedal nor wheel.

    Use: `rlftsim drive coast --data synthetic --out drives`
    """
    return [0.0, 0.0]
