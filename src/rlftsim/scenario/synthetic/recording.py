"""SUMO's output files read back: bodies of all road users, states of all lights."""

import re
from pathlib import Path

import numpy as np
import pyarrow.csv

from rlftsim.scenario.synthetic.bodies import Body, BumperPath, build_pedestrian, build_vehicle
from rlftsim.scenario.synthetic.demand import RoadUserType, draw_size
from rlftsim.scenario.synthetic.network import Lane, Network
from rlftsim.scenario.synthetic.sumo import DISCARDED_S
from rlftsim.scenario.types import STEP_S

MIN_STEPS = 12
LONGEST_STRIDE_M = 1.6
SMALLEST_JUMP_M = 0.3
"""Smallest sideways jump that is a lane change.

Lanes that follow one another may not quite meet: bicycles keep right in a car's lane.
"""
LONGEST_EVALUATED_M = 7.0


def _read_table(path: Path, names: tuple[str, ...]) -> dict[str, np.ndarray] | None:
    """Columns of a trajectory file; None where SUMO has written no file or no rows."""
    if not path.exists():
        return None
    table = pyarrow.csv.read_csv(path, parse_options=pyarrow.csv.ParseOptions(delimiter=";"))
    if not set(names) <= set(table.column_names) or table.num_rows == 0:
        return None
    return {name: table.column(name).to_numpy(zero_copy_only=False) for name in names}


def _runs_by_id(ids: np.ndarray, step: np.ndarray) -> list[np.ndarray]:
    """Row indices of every road user in time order; a user with a gap in time counts as two."""
    # by road user, then by time
    order = np.lexsort((step, ids.astype(str)))
    new = (ids[order][1:] != ids[order][:-1]) | (np.diff(step[order]) != 1)
    return [run for run in np.split(order, np.flatnonzero(new) + 1) if len(run) >= MIN_STEPS]


def _lane_path(lanes: dict[str, Lane], rows: dict[str, np.ndarray], first_step: int) -> BumperPath:
    """Bumper of a vehicle along lane centers, with the jumps between neighboring lanes listed as lane changes."""
    lane_ids, positions = rows["vehicle_lane"], rows["vehicle_pos"]
    center = np.empty((len(lane_ids), 2))
    direction = np.empty_like(center)
    starts = np.append(0, np.flatnonzero(lane_ids[1:] != lane_ids[:-1]) + 1)
    changes, distances = [], []
    for start, stop in zip(starts, np.append(starts[1:], len(lane_ids)), strict=True):
        lane = lanes[str(lane_ids[start])]
        center[start:stop] = lane.points_at(positions[start:stop])
        direction[start:stop] = lane.directions_at(positions[start:stop])
        if start == 0:
            continue
        last_lane = lanes[str(lane_ids[start - 1])]
        # Side by side, the jump is measured at one position; through a junction the two lanes have none in common.
        if last_lane.street is not None and last_lane.street is lane.street:
            jump = center[start] - last_lane.points_at(positions[start : start + 1])[0]
        else:
            jump = center[start] - center[start - 1]
        left_m = float(jump @ np.array([-direction[start, 1], direction[start, 0]]))
        if abs(left_m) > SMALLEST_JUMP_M:
            changes.append(int(start))
            distances.append(left_m)
    return BumperPath(first_step, center, direction, rows["vehicle_speed"], tuple(changes), tuple(distances))


def read_vehicles(path: Path, network: Network, types: dict[str, RoadUserType], rng: np.random.Generator) -> list[Body]:
    """Bodies of all motor vehicles and bicycles.

    Args:
        path: Trajectory file of the vehicles, CSV; without a file there are no vehicles.
        network: Compiled network; states off the lanes are left out.
        types: Vehicle types by type id, as `write_demand` returns them.
        rng: Generator of heights and of the drivers' habits.
    """
    names = ("timestep_time", "vehicle_id", "vehicle_type", "vehicle_speed", "vehicle_pos", "vehicle_lane")
    table = _read_table(path, names)
    if table is None:
        return []
    is_on_lane = np.array([lane in network.lanes for lane in table["vehicle_lane"]])
    table = {name: column[is_on_lane] for name, column in table.items()}
    step = np.rint((table["timestep_time"] - DISCARDED_S) / STEP_S).astype(int)
    bodies = []
    for run in _runs_by_id(table["vehicle_id"], step):
        user_type = types[str(table["vehicle_type"][run[0]])]
        lane_path = _lane_path(network.lanes, {name: table[name][run] for name in names}, int(step[run[0]]))
        # a type has one size for SUMO; heights may differ, because SUMO does not know them
        height = user_type.height_m + float(np.clip(rng.normal(0, 0.04), -0.1, 0.1))
        habit = (float(rng.normal(0, 0.14)), float(rng.uniform(0.0, 0.12)), float(rng.uniform(0, 2 * np.pi)))
        size = (user_type.length_m, user_type.width_m, height)
        is_evaluable = user_type.length_m <= LONGEST_EVALUATED_M
        bodies.append(build_vehicle(lane_path, user_type.object_type, size, habit, is_evaluable))
    return bodies


def read_pedestrians(path: Path, rng: np.random.Generator) -> list[Body]:
    """Bodies of all pedestrians.

    Args:
        path: Trajectory file of the persons, CSV; without a file there are no pedestrians.
        rng: Generator of the pedestrians' sizes.
    """
    names = ("timestep_time", "person_id", "person_x", "person_y", "person_angle")
    table = _read_table(path, names)
    if table is None:
        return []
    step = np.rint((table["timestep_time"] - DISCARDED_S) / STEP_S).astype(int)
    bodies = []
    for run in _runs_by_id(table["person_id"], step):
        position = np.stack([table["person_x"][run], table["person_y"][run]], axis=1).astype(float)
        if np.linalg.norm(np.diff(position, axis=0), axis=1).max() > LONGEST_STRIDE_M:
            # SUMO moves a few of them at once to the other side of a junction; smoothing hides jumps of a meter only
            continue
        # SUMO's angles are clockwise from north
        heading = np.pi / 2 - np.radians(float(table["person_angle"][run[0]]))
        bodies.append(build_pedestrian(int(step[run[0]]), position, heading, draw_size(rng, "pedestrian")))
    return bodies


def read_signals(path: Path) -> tuple[str, ...]:
    """Letters of SUMO for all links of a junction, a text per simulated step from the first on.

    Args:
        path: File with the junction's signal states, XML of SUMO.
    """
    entries = re.findall(r'time="([\d.]+)"[^>]*state="([^"]*)"', path.read_text())
    return tuple(state for time, state in entries if float(time) >= DISCARDED_S - 1e-6)
