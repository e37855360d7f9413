"""A planner that simulates fifteen proposals and takes the best score, in the style of PDM-Closed.

After Dauner et al., "Parting with Misconceptions about Learning-based Vehicle Motion Planning" (2023), as configured in
tuplan_garage. Differences: the planner here reads observations of this package, plans every half second, and measures
the drivable area by road edges. M agents, n proposals each, T steps, K other boxes; frame: each agent's own at the time
of planning.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int64

from rlftsim.envs.actions import (
    ACCELERATION_MPS2,
    STEERING_RAD,
    ActionType,
    Bicycle,
    pursue,
    pursuit_m,
    signed_speed,
    to_heading_frame,
)
from rlftsim.envs.idm import LOOKAHEAD_M, IdmConfig, compute_idm_acceleration
from rlftsim.envs.planner_scores import ACCELERATION, JERK, LATERAL
from rlftsim.envs.planners.batch import BatchPlanner, Observe
from rlftsim.envs.planners.view import View, read_view
from rlftsim.envs.road import nearest_edges
from rlftsim.geometry import boxes_overlap, clockwise_corners, wrapped
from rlftsim.realism.map_based import OUTSIDE_M
from rlftsim.scenario.types import STEP_S

SPEED_FRACTIONS = (0.2, 0.4, 0.6, 0.8, 1.0)
OFFSETS_M = (-1.0, 0.0, 1.0)
CONFIG = IdmConfig(speed_mps=15.0, acceleration_mps2=1.5, braking_mps2=3.0, exponent=10.0)
STEPS = 40
REPLAN_STEPS = 5
BRAKE_IF_WITHIN_S = 2.0
TTC_S = (0.3, 0.6, 0.9)
SPARSE = 5
"""Every so many steps the drivable area and the time to collision are looked at."""
LEAST_PROGRESS_M = 0.1
_NEVER = 1 << 20
"""Index of no point."""


class PdmPlanner(BatchPlanner):
    """The best of 15 proposals: 5 fractions of the wanted speed times 3 offsets from the route."""

    action: ActionType = "bicycle"
    memory = ("_plan",)

    def __init__(self) -> None:
        self._plan = np.zeros((0, 0, 2), np.float32)
        """Controls that are left of each agent's plan, the next one first."""

    def reset(self, info: dict[str, Any]) -> None:
        """Forget the last plan."""
        self._plan = self._plan[:, :0]

    def act_batch(self, observe: Observe) -> Float[np.ndarray, "M 2"]:
        """The next controls of the plans, which are made anew every half second."""
        if not self._plan.shape[1]:
            view = read_view(observe())
            motion, proposed_controls = simulate_proposals(view)
            collides = collisions(view, motion)
            best = score_proposals(view, motion, collides).argmax(1)
            row = np.arange(len(best))
            controls = proposed_controls[row, best, :REPLAN_STEPS]
            is_braking = collides[row, best, : round(BRAKE_IF_WITHIN_S / STEP_S) + 1].any(1)
            controls[is_braking, :, 0] = -ACCELERATION_MPS2
            scale = np.array([ACCELERATION_MPS2, STEERING_RAD])
            self._plan = np.clip(controls / scale, -1, 1).astype(np.float32)
        control, self._plan = self._plan[:, 0], self._plan[:, 1:]
        return control


def simulate_proposals(view: View) -> tuple[Float[np.ndarray, "M n T1 5"], Float[np.ndarray, "M n T 2"]]:
    """Motion along the route at several speeds and offsets for 4 s, and its acceleration (m/s²) and steering (rad).

    All other agents keep a constant velocity.
    """
    count, num_lines, num_speeds = len(view.speed), len(OFFSETS_M), len(SPEED_FRACTIONS)
    shape, bicycle = (count, num_lines, num_speeds), Bicycle()  # the proposals of an offset share a line
    limit = np.where(view.limit_mps > 0, view.limit_mps, CONFIG.speed_mps)
    free_speed = limit[:, None, None] * SPEED_FRACTIONS
    length = view.size[:, :1, None]
    normal = np.stack([-np.sin(view.heading), np.cos(view.heading)], -1)
    lines = view.line[:, None] + np.array(OFFSETS_M)[:, None, None] * normal[:, None]  # [M, l, P, 2]
    x, y = (np.ascontiguousarray(lines[..., axis])[:, :, None] for axis in range(2))  # [M, l, 1, P]
    row, line_row = np.arange(count)[:, None, None], np.arange(num_lines)[:, None]
    meetings = _Meetings.find(view, lines)
    motion = np.zeros((*shape, 5))
    motion[..., 3] = view.speed[:, None, None]
    states, controls = [motion], []
    for step in range(STEPS):
        # 1. place on the line, and the leader from there on
        index = _find_nearest(x, y, motion)
        gap, lead = np.full(shape, np.inf), np.zeros(shape)
        if len(meetings.scene):
            first_box, next_point = meetings.after(step, count)
            point = next_point[row, line_row, index]
            led = np.nonzero(point < index + LOOKAHEAD_M)
            gap[led] = np.maximum(point - index - length / 2, 0.0)[led]
            lead[led] = meetings.speed[first_box[led[0], led[1], point[led]], point[led]]
        to_stop = view.stop_m[:, None, None] - index - length / 2
        to_stop = np.where(to_stop > -1.0, np.maximum(to_stop, 0.0), np.inf)
        gap, lead = np.minimum(gap, to_stop), np.where(to_stop < gap, 0.0, lead)
        speed = np.maximum(signed_speed(motion), 0.0)
        acceleration = np.maximum(compute_idm_acceleration(speed, free_speed, gap, lead, CONFIG), -ACCELERATION_MPS2)
        # 2. pure pursuit of the line
        target = row, line_row, 0, np.minimum(index + pursuit_m(speed).astype(int), x.shape[-1] - 1)
        offset = x[target] - motion[..., 0], y[target] - motion[..., 1]
        steering = pursue(np.stack(to_heading_frame(*offset, motion[..., 2]), -1), length)
        motion = bicycle.drive(motion, acceleration, steering, length)
        states.append(motion)
        controls.append(np.stack([acceleration, steering], -1))
    size = count, num_lines * num_speeds
    return np.stack(states, 3).reshape(*size, -1, 5), np.stack(controls, 3).reshape(*size, -1, 2)


@dataclass(frozen=True, eq=False)
class _Meetings:
    """Boxes that come near the lines of proposals: N boxes of all scenes, l lines of P points each."""

    scene: Int64[np.ndarray, "N"]
    """Ascending."""
    boxes: Float[np.ndarray, "N 5"]
    line_x: Float[np.ndarray, "N l P"]
    line_y: Float[np.ndarray, "N l P"]
    reach: Float[np.ndarray, "N 2 1 P"]
    """Distances of a center from that of the box, along the box and across, at which the box is met."""
    speed: Float[np.ndarray, "N P"]
    """Speed of the box along the line, not negative."""

    @classmethod
    def find(cls, view: View, lines: Float[np.ndarray, "M l P 2"]) -> "_Meetings":
        """Boxes near the lines of the proposals."""
        scene, column = np.nonzero(_nears_line(view))
        boxes, size, heading = view.boxes[scene, column], view.box_size[scene, column], view.heading[scene]
        turn, half = heading - boxes[:, 2:3], view.size[scene, 1:] / 2
        reach = [size[:, [axis]] / 2 + half * np.abs(across(turn)) for axis, across in enumerate((np.sin, np.cos))]
        speed = boxes[:, 3:4] * np.cos(heading) + boxes[:, 4:5] * np.sin(heading)
        x, y = np.ascontiguousarray(np.moveaxis(lines[scene], -1, 0))
        return cls(scene, boxes, x, y, np.stack(reach, 1)[:, :, None], np.maximum(speed, 0.0))

    def after(self, step: int, count: int) -> tuple[Int64[np.ndarray, "M l P"], Int64[np.ndarray, "M l P"]]:
        """Box that is met at each point of the lines, and the first point from there on at which a box is met.

        Args:
            step: Step of 0.1 s from the time of planning on, with the boxes at constant velocity.
            count: Number M of scenes.
        """
        boxes = self.boxes.copy()
        boxes[:, :2] += step * STEP_S * boxes[:, 3:]
        x, y = self.line_x - boxes[:, :1, None], self.line_y - boxes[:, 1:2, None]
        forward, lateral = map(np.abs, to_heading_frame(x, y, boxes[:, 2:3, None]))
        meets = (forward <= self.reach[:, 0]) & (lateral <= self.reach[:, 1])  # [N, l, P]
        box, line, point = (index[::-1] for index in np.nonzero(meets))
        shape = count, *meets.shape[1:]
        first_box, next_point = np.zeros(shape, np.int64), np.full(shape, _NEVER)
        # of several boxes at a point the nearest to the agent is written last
        first_box[self.scene[box], line, point] = box
        next_point[self.scene[box], line, point] = point
        return first_box, np.minimum.accumulate(next_point[..., ::-1], axis=-1)[..., ::-1]


def collisions(view: View, motion: Float[np.ndarray, "M n T1 5"]) -> Bool[np.ndarray, "M n T1"]:
    """True from the step on at which a proposal meets a box ahead or beside; overlaps at the start are left out.

    Args:
        view: View of the planner, in the ego frame: x ahead, meters.
        motion: Motion of the proposals, ego frame at the time of planning.
    """
    meets = _meets(view, motion, STEP_S * np.arange(motion.shape[2]))  # [M, n, T + 1, K]
    meets &= ~meets[:, :, :1]
    return np.logical_or.accumulate(meets.any(-1), axis=2)


def score_proposals(
    view: View, motion: Float[np.ndarray, "M n T1 5"], collides: Bool[np.ndarray, "M n T1"]
) -> Float[np.ndarray, "M n"]:
    """NC · DDC · DAC · (5 progress + 5 TTC + 2 comfort) / 12 of each proposal.

    Args:
        view: View of the planner, in the ego frame: x ahead, meters.
        motion: Motion of the proposals, ego frame at the time of planning.
        collides: True from the step of a collision on, as `collisions` returns it.
    """
    # 1. what must not happen: collisions, driving against the route, leaving the road
    end = motion[:, :, -1]
    line_index = _find_nearest(view.line[:, None, :, 0], view.line[:, None, :, 1], end)
    direction = np.cos(end[..., 2] - np.take_along_axis(view.heading, line_index, 1)) > 0
    sparse = motion[:, :, ::SPARSE]
    allowed = ~collides[..., -1] & direction & ~_leaves_road(view, sparse)
    # 2. progress along the route, as a fraction of the best proposal's
    progress = np.where(allowed, line_index, 0.0)
    best = progress.max(1, keepdims=True)
    progress = np.where(best > LEAST_PROGRESS_M, progress / np.maximum(best, LEAST_PROGRESS_M), 1.0)
    # 3. time to collision and comfort
    risky = np.zeros(progress.shape, bool)
    time = STEP_S * SPARSE * np.arange(sparse.shape[2])
    for delay_s in TTC_S:
        coasted = sparse.copy()
        coasted[..., :2] += delay_s * sparse[..., 3:]
        risky |= (_meets(view, coasted, time + delay_s).any(-1) & (signed_speed(sparse) > 0.1)).any(-1)
    speed = signed_speed(motion)
    acceleration = np.diff(speed, axis=2) / STEP_S
    lateral = speed[..., 1:] * wrapped(np.diff(motion[..., 2], axis=2)) / STEP_S
    jerk = np.diff(acceleration, axis=2) / STEP_S
    low, high = ACCELERATION
    comfort = ((acceleration >= low) & (acceleration <= high) & (np.abs(lateral) <= LATERAL)).all(2)
    comfort &= (np.abs(jerk) <= JERK).all(2)
    return allowed * (5 * progress + 5 * ~risky + 2 * comfort) / 12


def _meets(
    view: View, motion: Float[np.ndarray, "M n t 5"], time_s: Float[np.ndarray, "t"]
) -> Bool[np.ndarray, "M n t K"]:
    """True where a proposal overlaps a box ahead or beside that has coasted for some time."""
    position = view.boxes[:, None, :, :2] + time_s[:, None, None] * view.boxes[:, None, :, 3:]  # [M, t, K, 2]
    x, y = (position[:, None, ..., axis] - motion[..., axis, None] for axis in range(2))  # [M, n, t, K]
    diagonal = np.hypot(view.box_size[..., 0], view.box_size[..., 1]) + np.hypot(*view.size.T)[:, None]
    reach = np.where(view.is_box, diagonal / 2 + 1e-6, -1.0)
    meets = x * x + y * y <= (np.abs(reach) * reach)[:, None, None]
    pairs = scene, proposal, step, box = np.nonzero(meets)
    gap, heading = np.stack([x[pairs], y[pairs]], -1), motion[scene, proposal, step, 2]
    size, box_size = view.size[scene], view.box_size[scene, box]
    is_hit = boxes_overlap(gap, heading, view.boxes[scene, box, 2], size, box_size)
    meets[pairs] = is_hit & (gap[:, 0] * np.cos(heading) + gap[:, 1] * np.sin(heading) > -size[:, 0] / 2)
    return meets


def _leaves_road(view: View, motion: Float[np.ndarray, "M n t 5"]) -> Bool[np.ndarray, "M n"]:
    """True where a corner gets 0.3 m or more to the right of the nearest road edge."""
    corners = clockwise_corners(motion[..., :2], motion[..., 2], view.size[:, None, None])  # [M, n, t, 4, 2]
    corners = corners.reshape(*motion.shape[:2], -1, 2)
    leaves = np.zeros(motion.shape[:2], bool)
    for row, edges in enumerate(view.edges):  # the numbers of a scene fit the cache
        distance, side, _ = nearest_edges(corners[row], edges[None])
        leaves[row] = np.any((side < 0) & (distance >= OUTSIDE_M), axis=1)
    return leaves


def _nears_line(view: View) -> Bool[np.ndarray, "M K"]:
    """True for boxes that may meet a proposal's line within the time of the proposals."""
    time_s = STEP_S * np.arange(0, STEPS + SPARSE, SPARSE)[:, None, None]
    position = view.boxes[:, None, :, :2] + time_s * view.boxes[:, None, :, 3:]  # [M, t, K, 2]
    square = np.full(view.is_box.shape, np.inf)
    for step in np.moveaxis(position, 1, 0):
        x, y = (step[..., axis, None] - view.line[:, None, :, axis] for axis in range(2))  # [M, K, P]
        square = np.minimum(square, (x * x + y * y).min(2))
    # between two sparse steps a box is at most half of its way from one of them
    distance = np.sqrt(square) - SPARSE * STEP_S / 2 * np.hypot(view.boxes[..., 3], view.boxes[..., 4])
    reach = np.linalg.norm(view.box_size + view.size[:, None, 1:], axis=-1) / 2 + max(OFFSETS_M)
    return view.is_box & (distance <= reach + 1e-6)


def _find_nearest(
    x: Float[np.ndarray, "*#m P"], y: Float[np.ndarray, "*#m P"], motion: Float[np.ndarray, "*m 5"]
) -> Int64[np.ndarray, "*m"]:
    """Index of the point of a line that is nearest to each state."""
    x, y = x - motion[..., :1], y - motion[..., 1:2]
    return (x * x + y * y).argmin(-1)
