"""Bodies from what SUMO has shown: vehicles from a bumper on a lane, smooth walkers from jerky pedestrians.

Arrays run over the steps (0.1 s) during which a road user exists; positions in plan coordinates, meters. Boxes of a
world that runs again follow from the past alone: plain numbers in a fixed order of operations have the same bits.
"""

import math
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow.csv
from jaxtyping import Float

from rlftsim.scenario.synthetic.network import Lane, Network
from rlftsim.scenario.synthetic.sumo import DISCARDED_S, RoadUserType, draw_size
from rlftsim.scenario.types import STEP_S, ObjectType

REAR_AXLE_FROM_BUMPER = 0.78
"""Fraction of the length between front bumper and rear axle."""
WALKER_REACH_M = 0.4
WALKER_SMOOTHING = 0.2
"""Fraction of the way to a pedestrian, whom SUMO moves in jerks, that the box covers in a step."""

SumoPose = tuple[float, float, float]
"""Position that SUMO reports, of a vehicle the front bumper's, and the angle in degrees clockwise from north."""
BodyMotion = tuple[float, float, float, float, float]
"""x, y, heading, vx, vy of the center."""
MIN_STEPS = 12
LONGEST_STRIDE_M = 1.6
SMALLEST_JUMP_M = 0.3
"""Smallest sideways jump that is a lane change.

Lanes that follow one another may not quite meet: bicycles keep right in a car's lane.
"""
LONGEST_EVALUATED_M = 7.0


class BodyShape(NamedTuple):
    """Constants of a body that SUMO's position drags along."""

    reach_m: float
    """Distance from the front back to the axle, which cannot slip sideways."""
    ahead_m: float
    """Distance from the center forward to the front."""
    left_m: float
    """Habit of the driver: offset to the left of the lane's center."""
    smoothing: float
    """Fraction of the way to SUMO's position that the front covers in a step."""


class BodyState(NamedTuple):
    """All that the next box depends on besides SUMO's next pose."""

    front_x: float
    front_y: float
    axle_x: float
    axle_y: float
    center_x: float
    center_y: float


def build_shape(object_type: ObjectType, length_m: float, left_m: float = 0.0) -> BodyShape:
    """Constants of a body.

    Args:
        object_type: Type of the road user; SUMO reports the center of a pedestrian.
        length_m: Length of the body, m.
        left_m: Habit of the driver, m to the left of the lane's center.
    """
    if object_type == ObjectType.PEDESTRIAN:
        return BodyShape(WALKER_REACH_M, 0.0, 0.0, WALKER_SMOOTHING)
    return BodyShape(REAR_AXLE_FROM_BUMPER * length_m, length_m / 2, left_m, 1.0)


def begin_body(shape: BodyShape, pose: SumoPose) -> BodyState:
    """State of a body when SUMO shows it for the first time: directed along SUMO's angle.

    Args:
        shape: Constants of the body.
        pose: First pose that SUMO reports.
    """
    angle = math.radians(90.0 - pose[2])
    return _put_behind(shape, *_move_left(shape, pose), math.cos(angle), math.sin(angle))


def advance_body(shape: BodyShape, state: BodyState, pose: SumoPose) -> tuple[BodyState, BodyMotion]:
    """State and box of a body 0.1 s later: the axle is dragged behind the front (a tractrix).

    Args:
        shape: Constants of the body.
        state: State before the step.
        pose: Pose that SUMO reports after the step.
    """
    x, y = _move_left(shape, pose)
    if shape.smoothing < 1.0:
        x = state.front_x + shape.smoothing * (x - state.front_x)
        y = state.front_y + shape.smoothing * (y - state.front_y)
    dx, dy = x - state.axle_x, y - state.axle_y
    distance = math.sqrt(dx * dx + dy * dy) or 1.0
    dx, dy = dx / distance, dy / distance
    following = _put_behind(shape, x, y, dx, dy)
    velocity = (following.center_x - state.center_x) / STEP_S, (following.center_y - state.center_y) / STEP_S
    return following, (following.center_x, following.center_y, math.atan2(dy, dx), *velocity)


def _put_behind(shape: BodyShape, x: float, y: float, dx: float, dy: float) -> BodyState:
    """State of a body whose front is at x, y and which points along dx, dy."""
    reach_m, ahead_m, *_ = shape
    return BodyState(x, y, x - reach_m * dx, y - reach_m * dy, x - ahead_m * dx, y - ahead_m * dy)


def _move_left(shape: BodyShape, pose: SumoPose) -> tuple[float, float]:
    """SUMO's position moved by the habit of the driver."""
    angle = math.radians(90.0 - pose[2])
    return pose[0] - shape.left_m * math.sin(angle), pose[1] + shape.left_m * math.cos(angle)


MIN_LANE_CHANGE_M = 18.0
LANE_CHANGE_S = 3.0
BUMPER_SMOOTHING_S = 0.15
WALK_SMOOTHING_S = 0.6
WALK_HEADING_SPEED_MPS = 0.3


@dataclass(frozen=True, eq=False)
class Dragging:
    """SUMO's id of a body that is dragged along by SUMO's position, and all that the next box depends on."""

    sumo_id: str
    shape: BodyShape
    states: list[BodyState]
    """States at the steps of the body's life."""


@dataclass(frozen=True, eq=False)
class Body:
    """A road user over the steps of existence, without label noise."""

    object_type: ObjectType
    first_step: int
    position: Float[np.ndarray, "n 2"]
    heading: Float[np.ndarray, "n"]
    velocity: Float[np.ndarray, "n 2"]
    size: tuple[float, float, float]
    is_parked: bool = False
    is_evaluable: bool = True
    """False = never among the tracks to predict (a lot's cars, long vehicles)."""
    dragging: Dragging | None = None
    """None = SUMO does not move it, or the box was made with the future."""

    @property
    def num_steps(self) -> int:
        """Length of life in steps."""
        return len(self.heading)


@dataclass(frozen=True, eq=False)
class BumperPath:
    """A vehicle's front bumper as SUMO reports it: points on lane centers, directions, and the lane changes."""

    first_step: int
    center: Float[np.ndarray, "n 2"]
    direction: Float[np.ndarray, "n 2"]
    """Unit tangent of the lane."""
    speed_mps: Float[np.ndarray, "n"]
    change_steps: tuple[int, ...] = ()
    """First step on the new lane."""
    change_left_m: tuple[float, ...] = ()
    """Distance from the old lane to the new lane, to the left (negative: to the right)."""


def smoother_step(u: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Rises from 0 at u = 0 to 1 at u = 1 with two vanishing derivatives at both ends; constant outside."""
    u = np.clip(u, 0.0, 1.0)
    return u**3 * (u * (6 * u - 15) + 10)


def lane_change_offset(
    driven_m: Float[np.ndarray, "n"], speed_mps: Float[np.ndarray, "n"], step: int, left_m: float
) -> Float[np.ndarray, "n"]:
    """Lateral offset that turns a jump between two lane centers into a smooth step along the driven distance.

    A function of distance, not of time: a car that stops in the middle of a lane change stands still.

    Args:
        driven_m: Distance driven since the first step, m.
        speed_mps: Speed at each step; a faster change is longer.
        step: First step on the new lane.
        left_m: Signed distance from the old lane to the new lane, m, positive to the left.

    Returns:
        Meters to the left to add to the center of the current lane; the sum with the jump has no discontinuity.
    """
    length = max(MIN_LANE_CHANGE_M, LANE_CHANGE_S * float(speed_mps[step]))
    # half of the change is driven before SUMO jumps to the new lane, half after
    fraction = smoother_step((driven_m - driven_m[step]) / length + 0.5)
    on_new_lane = np.arange(len(driven_m)) >= step
    return left_m * (fraction - on_new_lane)


def drag_rear_axle(
    bumper: Float[np.ndarray, "n 2"], length_m: float, direction: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "n"]:
    """Heading of a body whose rear axle is dragged behind the front bumper (a tractrix), unwrapped.

    Args:
        bumper: Path of the middle of the front bumper over n steps, m.
        length_m: Length of the body, m.
        direction: Unit vector that the body points along at the first step.
    """
    # The rear wheels cannot slip sideways, so the axle only ever moves towards the bumper, at a fixed distance.
    reach = REAR_AXLE_FROM_BUMPER * length_m
    rear_x, rear_y = bumper[0] - reach * direction
    heading = np.empty(len(bumper))
    for step, (x, y) in enumerate(bumper.tolist()):
        dx, dy = x - rear_x, y - rear_y
        distance = math.hypot(dx, dy)
        rear_x, rear_y = x - dx / distance * reach, y - dy / distance * reach
        heading[step] = math.atan2(dy, dx)
    return np.unwrap(heading)


def smooth_over_time(values: Float[np.ndarray, "n ..."], sigma_s: float) -> Float[np.ndarray, "n ..."]:
    """Values convolved with a Gaussian along the steps; beyond the ends the first and the last value are repeated.

    Args:
        values: Values with a row per step, 0.1 s apart.
        sigma_s: Standard deviation of the Gaussian in seconds.
    """
    # beyond four standard deviations the Gaussian adds less than the grid that positions are rounded to
    sigma = sigma_s / STEP_S
    radius = int(np.ceil(4 * sigma))
    kernel = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    columns = values.reshape(len(values), -1)  # [n, k]
    padded = np.pad(columns, ((radius, radius), (0, 0)), mode="edge")
    smooth = [np.convolve(column, kernel / kernel.sum(), mode="valid") for column in padded.T]
    return np.stack(smooth, axis=1).reshape(values.shape)


def build_vehicle(
    path: BumperPath,
    object_type: ObjectType,
    size: tuple[float, float, float],
    habit: tuple[float, float, float] = (0.0, 0.0, 0.0),
    is_evaluable: bool = True,
) -> Body:
    """Body of a vehicle that follows a bumper path.

    Args:
        path: Bumper on lane centers, with the lane changes.
        object_type: Type of the road user, VEHICLE or CYCLIST.
        size: Length, width and height in meters.
        habit: Position in the lane: constant offset to the left and amplitude of a slow weave in meters, and the phase
            of the weave in radians.
        is_evaluable: True = the vehicle may be a track to predict.
    """
    # 1. Offset from the lane centers: the driver's habit and smooth lane changes.
    driven = np.concatenate([[0.0], np.cumsum(path.speed_mps[1:] * STEP_S)])
    left = habit[0] + habit[1] * np.sin(driven / 14.0 + habit[2])
    for step, distance in zip(path.change_steps, path.change_left_m, strict=True):
        left = left + lane_change_offset(driven, path.speed_mps, step, distance)
    # 2. The bumper's path, the heading of a body dragged by it, the center half a length behind it.
    normal = np.stack([-path.direction[:, 1], path.direction[:, 0]], axis=1)
    bumper = smooth_over_time(path.center + left[:, None] * normal, BUMPER_SMOOTHING_S)
    # [n]: the path of the bumper alone decides the heading, which can neither jump nor slip
    heading = drag_rear_axle(bumper, size[0], path.direction[0])
    center = bumper - size[0] / 2 * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    velocity = np.gradient(center, STEP_S, axis=0)
    return Body(object_type, path.first_step, center, heading, velocity, size, is_evaluable=is_evaluable)


def build_causal_body(
    sumo_id: str,
    first_step: int,
    poses: list[SumoPose],
    object_type: ObjectType,
    size: tuple[float, float, float],
    left_m: float = 0.0,
    is_evaluable: bool = True,
) -> Body:
    """Body whose box at each step is made from SUMO's poses up to the step.

    Args:
        sumo_id: Name of the road user in SUMO.
        first_step: Step of the first pose.
        poses: Poses that SUMO reports, a step each.
        object_type: Type of the road user.
        size: Length, width and height in meters.
        left_m: Habit of the driver, m to the left of the lane's center.
        is_evaluable: True = the body may be a track to predict.
    """
    shape = build_shape(object_type, size[0], left_m)
    states = [begin_body(shape, poses[0])]
    motion = [(states[0].center_x, states[0].center_y, math.radians(90.0 - poses[0][2]), 0.0, 0.0)]
    for pose in poses[1:]:
        state, moved = advance_body(shape, states[-1], pose)
        states.append(state)
        motion.append(moved)
    rows = np.array(motion)
    heading, dragging = np.unwrap(rows[:, 2]), Dragging(sumo_id, shape, states)
    return Body(object_type, first_step, rows[:, :2], heading, rows[:, 3:], size, False, is_evaluable, dragging)


def build_pedestrian(
    first_step: int, position: Float[np.ndarray, "n 2"], heading_rad: float, size: tuple[float, float, float]
) -> Body:
    """Body of a pedestrian; a standing pedestrian keeps the last heading.

    Args:
        first_step: Step of the first position.
        position: Positions over n steps as reported by SUMO, m.
        heading_rad: Heading of a pedestrian that never walks, rad.
        size: Length, width and height in meters.
    """
    smooth = smooth_over_time(position, WALK_SMOOTHING_S)
    velocity = np.gradient(smooth, STEP_S, axis=0)
    walking = np.flatnonzero(np.linalg.norm(velocity, axis=1) > WALK_HEADING_SPEED_MPS)
    heading = np.full(len(position), heading_rad)
    if len(walking):
        measured = np.unwrap(np.arctan2(velocity[walking, 1], velocity[walking, 0]))
        # index of the latest walking step: a pedestrian that stands keeps the heading of that step
        latest = np.clip(np.searchsorted(walking, np.arange(len(position)), side="right") - 1, 0, None)
        heading = smooth_over_time(measured[latest], WALK_SMOOTHING_S)
    return Body(ObjectType.PEDESTRIAN, first_step, smooth, heading, velocity, size)


def add_label_noise(
    rng: np.random.Generator, noise_m: float, position: np.ndarray, heading: np.ndarray, velocity: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position [n, 2], heading [n] and velocity [n, 2] with noise that fades below 0.5 m/s and is 0 at a standstill.

    Args:
        rng: Generator of the noise, which draws for every step.
        noise_m: Standard deviation along the heading, m; 0.4 times as much across, 0.1 times in rad, 3 times in m/s.
        position: Centers [n, 2], m.
        heading: Directions [n], rad.
        velocity: Velocities [n, 2], m/s; slow steps have less noise.
    """
    # below a tenth of the limit there is no noise at all: a body that stands does not jitter
    moving = np.clip(np.linalg.norm(velocity, axis=1) / 0.5, 0.0, 1.0)
    moving[moving < 0.1] = 0.0
    forward = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    left = np.stack([-forward[:, 1], forward[:, 0]], axis=1)
    shape = len(heading)
    shift = (rng.normal(0, noise_m, shape) * moving)[:, None] * forward
    shift += (rng.normal(0, 0.4 * noise_m, shape) * moving)[:, None] * left
    turned = heading + rng.normal(0, 0.1 * noise_m, shape) * moving
    pushed = velocity + rng.normal(0, 3.0 * noise_m, (shape, 2)) * moving[:, None]
    return position + shift, turned, pushed


# --- files of SUMO ---------------------------------------------------------------------------------------------------


def _read_users(
    path: Path, user: str, names: tuple[str, ...], lanes: Collection[str] = ()
) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """First step and rows of every road user in time order; a user with a gap in time counts as two.

    Args:
        path: Trajectory file; there are no users where SUMO has written no file or no rows.
        user: SUMO's word for the users, "vehicle" or "person".
        names: Columns that are read besides id and pose.
        lanes: Ids of the lanes whose rows count; empty = all rows do.
    """
    columns = {"time": "timestep_time"} | {name: f"{user}_{name}" for name in ("id", "x", "y", "angle", *names)}
    if not path.exists():
        return
    file = pyarrow.csv.read_csv(path, parse_options=pyarrow.csv.ParseOptions(delimiter=";"))
    if not set(columns.values()) <= set(file.column_names) or file.num_rows == 0:
        return
    table = {name: file.column(column).to_numpy(zero_copy_only=False) for name, column in columns.items()}
    if lanes:
        is_on_lane = np.array([lane in lanes for lane in table["lane"]])
        table = {name: column[is_on_lane] for name, column in table.items()}
    step, ids = np.rint((table["time"] - DISCARDED_S) / STEP_S).astype(int), table["id"]
    order = np.lexsort((step, ids.astype(str)))
    new = (ids[order][1:] != ids[order][:-1]) | (np.diff(step[order]) != 1)
    for run in np.split(order, np.flatnonzero(new) + 1):
        if len(run) >= MIN_STEPS:
            yield int(step[run[0]]), {name: column[run] for name, column in table.items()}


def _lane_path(lanes: dict[str, Lane], rows: dict[str, np.ndarray], first_step: int) -> BumperPath:
    """Bumper of a vehicle along lane centers, with the jumps between neighboring lanes listed as lane changes."""
    lane_ids, positions = rows["lane"], rows["pos"]
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
    return BumperPath(first_step, center, direction, rows["speed"], tuple(changes), tuple(distances))


def _list_poses(rows: dict[str, np.ndarray]) -> list[SumoPose]:
    return list(zip(*(rows[name].astype(float).tolist() for name in ("x", "y", "angle"))))


def read_vehicles(
    path: Path, network: Network, types: dict[str, RoadUserType], rng: np.random.Generator, is_causal: bool = False
) -> list[Body]:
    """Bodies of all motor vehicles and bicycles.

    Args:
        path: Trajectory file of the vehicles, CSV; without a file there are no vehicles.
        network: Compiled network; states off the lanes are left out.
        types: Vehicle types by type id, as `write_demand` returns them.
        rng: Generator of heights and of the drivers' habits.
        is_causal: True = boxes are made from the past alone, as worlds that run again need; False = smooth ones.
    """
    bodies = []
    for first_step, rows in _read_users(path, "vehicle", ("type", "speed", "pos", "lane"), network.lanes):
        user_type = types[str(rows["type"][0])]
        # a type has one size for SUMO; heights may differ, because SUMO does not know them
        height = user_type.height_m + float(np.clip(rng.normal(0, 0.04), -0.1, 0.1))
        habit = (float(rng.normal(0, 0.14)), float(rng.uniform(0.0, 0.12)), float(rng.uniform(0, 2 * np.pi)))
        size = (user_type.length_m, user_type.width_m, height)
        is_evaluable = user_type.length_m <= LONGEST_EVALUATED_M
        if is_causal:
            dragged = str(rows["id"][0]), first_step, _list_poses(rows)
            bodies.append(build_causal_body(*dragged, user_type.object_type, size, habit[0], is_evaluable))
            continue
        lane_path = _lane_path(network.lanes, rows, first_step)
        bodies.append(build_vehicle(lane_path, user_type.object_type, size, habit, is_evaluable))
    return bodies


def read_pedestrians(path: Path, rng: np.random.Generator, is_causal: bool = False) -> list[Body]:
    """Bodies of all pedestrians.

    Args:
        path: Trajectory file of the persons, CSV; without a file there are no pedestrians.
        rng: Generator of the pedestrians' sizes.
        is_causal: True = boxes are made from the past alone, as worlds that run again need; False = smooth ones.
    """
    bodies = []
    for first_step, rows in _read_users(path, "person", ()):
        position = np.stack([rows["x"], rows["y"]], axis=1).astype(float)
        if np.linalg.norm(np.diff(position, axis=0), axis=1).max() > LONGEST_STRIDE_M:
            # SUMO moves a few of them at once to the other side of a junction; smoothing hides jumps of a meter only
            continue
        # SUMO's angles are clockwise from north
        size = draw_size(rng, "pedestrian")
        if is_causal:
            dragged = str(rows["id"][0]), first_step, _list_poses(rows)
            bodies.append(build_causal_body(*dragged, ObjectType.PEDESTRIAN, size))
            continue
        heading = np.pi / 2 - np.radians(float(rows["angle"][0]))
        bodies.append(build_pedestrian(first_step, position, heading, size))
    return bodies


def read_signals(path: Path) -> tuple[str, ...]:
    """Letters of SUMO for all links of a junction, a text per simulated step from the first on.

    Args:
        path: File with the junction's signal states, XML of SUMO.
    """
    entries = re.findall(r'time="([\d.]+)"[^>]*state="([^"]*)"', path.read_text())
    return tuple(state for time, state in entries if float(time) >= DISCARDED_S - 1e-6)
