"""A planner that simulates fifteen proposals and takes the best score, in the style of PDM-Closed.

After Dauner et al., "Parting with Misconceptions about Learning-based Vehicle Motion Planning" (2023), as configured in
tuplan_garage. Differences: the planner here reads observations of this package, plans every half second, and measures
the drivable area by road edges. n proposals, T steps, K other boxes; frame: the agent's at the time of planning.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

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
from rlftsim.envs.idm import LOOKAHEAD_M, IdmConfig, choose_leaders, compute_idm_acceleration, find_meetings
from rlftsim.envs.planner_scores import ACCELERATION, JERK, LATERAL
from rlftsim.envs.planners.view import View, read_view
from rlftsim.envs.road import OUTSIDE_M, nearest_edges
from rlftsim.geometry import boxes_overlap, clockwise_corners, wrapped
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


@dataclass(frozen=True, eq=False)
class Proposals:
    """Simulated motions, and the controls that lead there."""

    motion: Float[np.ndarray, "n T1 5"]
    controls: Float[np.ndarray, "n T 2"]
    """Acceleration (m/s²) and steering (rad)."""


class PdmPlanner:
    """The best of 15 proposals: 5 fractions of the wanted speed times 3 offsets from the route."""

    action: ActionType = "bicycle"

    def __init__(self) -> None:
        self._plan = np.zeros((0, 2), np.float32)

    def reset(self, info: dict[str, Any]) -> None:
        """Forget the last plan."""
        self._plan = self._plan[:0]

    def act(self, observation: dict[str, Any]) -> Float[np.ndarray, "2"]:
        """The next control of the plan, which is made anew every half second."""
        if not len(self._plan):
            view = read_view(observation)
            proposals = simulate_proposals(view)
            collides = collisions(view, proposals.motion)
            best = int(score_proposals(view, proposals.motion, collides).argmax())
            controls = proposals.controls[best, :REPLAN_STEPS].copy()
            if collides[best, : round(BRAKE_IF_WITHIN_S / STEP_S) + 1].any():
                controls[:, 0] = -ACCELERATION_MPS2
            scale = np.array([ACCELERATION_MPS2, STEERING_RAD])
            self._plan = np.clip(controls / scale, -1, 1).astype(np.float32)
        control, self._plan = self._plan[0], self._plan[1:]
        return control


def simulate_proposals(view: View) -> Proposals:
    """Drive along the route at several speeds and offsets for 4 s; all other agents keep a constant velocity."""
    fraction, offset = (v.ravel() for v in np.meshgrid(SPEED_FRACTIONS, OFFSETS_M))
    free_speed = fraction * (view.limit_mps or CONFIG.speed_mps)
    n, num_lines, bicycle = len(free_speed), len(OFFSETS_M), Bicycle()
    row, line_row = np.arange(n), np.repeat(np.arange(num_lines), len(SPEED_FRACTIONS))
    normal = np.stack([-np.sin(view.heading), np.cos(view.heading)], -1)
    lines = view.line + offset[:, None, None] * normal  # [n, P, 2]
    motion = np.tile([0.0, 0.0, 0.0, view.speed, 0.0], (n, 1))
    # the five proposals of an offset share a line, so boxes meet lines and not proposals
    shared_lines, headings = lines[:: len(SPEED_FRACTIONS)], np.tile(view.heading, (num_lines, 1))
    width, length = np.full(num_lines, view.size[1]), np.full(n, view.size[0])
    is_near = _nears_line(view)
    near_boxes, near_size = view.boxes[is_near], np.tile(view.box_size[is_near], (num_lines, 1, 1))
    states, controls = [motion], []
    for step in range(STEPS):
        boxes = np.tile(_coasted(near_boxes, step * STEP_S), (n, 1, 1))
        # 1. place on the line, and the leader from there on
        line_index = _measure_distance(lines, motion[:, None]).argmin(1)
        window = np.minimum(line_index[:, None] + np.arange(LOOKAHEAD_M), lines.shape[1] - 1)
        gap, lead = np.full(n, np.inf), np.zeros(n)
        if len(near_boxes):
            meets = find_meetings(shared_lines, headings, width, boxes[:num_lines], near_size)[line_row]
            meets = np.take_along_axis(meets, window[:, None], 2)  # [n, K, W]
            gap, lead = choose_leaders(meets, view.heading[window], length, boxes)
        to_stop = view.stop_m - line_index - view.size[0] / 2
        to_stop = np.where(to_stop > -1.0, np.maximum(to_stop, 0.0), np.inf)
        gap, lead = np.minimum(gap, to_stop), np.where(to_stop < gap, 0.0, lead)
        speed = np.maximum(signed_speed(motion), 0.0)
        acceleration = np.maximum(compute_idm_acceleration(speed, free_speed, gap, lead, CONFIG), -ACCELERATION_MPS2)
        # 2. pure pursuit of the line
        target = lines[row, np.minimum(line_index + pursuit_m(speed).astype(int), lines.shape[1] - 1)] - motion[:, :2]
        target = to_heading_frame(target[:, 0], target[:, 1], motion[:, 2])
        steering = pursue(np.stack(target, -1), view.size[:1])
        motion = bicycle.drive(motion, acceleration, steering, view.size[:1])
        states.append(motion)
        controls.append(np.stack([acceleration, steering], -1))
    return Proposals(np.stack(states, 1), np.stack(controls, 1))


def collisions(view: View, motion: Float[np.ndarray, "n T1 5"]) -> Bool[np.ndarray, "n T1"]:
    """True from the step on at which a proposal meets a box ahead or beside; overlaps at the start are left out.

    Args:
        view: View of the planner, in the ego frame: x ahead, meters.
        motion: Motion of the proposals, ego frame at the time of planning.
    """
    time = STEP_S * np.arange(motion.shape[1])
    meets = _meets(view, motion, np.stack([_coasted(view.boxes, t) for t in time]))  # [n, T + 1, K]
    meets &= ~meets[:, :1]
    return np.logical_or.accumulate(meets.any(-1), axis=1)


def score_proposals(
    view: View, motion: Float[np.ndarray, "n T1 5"], collides: Bool[np.ndarray, "n T1"]
) -> Float[np.ndarray, "n"]:
    """NC · DDC · DAC · (5 progress + 5 TTC + 2 comfort) / 12 of each proposal.

    Args:
        view: View of the planner, in the ego frame: x ahead, meters.
        motion: Motion of the proposals, ego frame at the time of planning.
        collides: True from the step of a collision on, as `collisions` returns it.
    """
    n = len(motion)
    # 1. what must not happen: collisions, driving against the route, leaving the road
    end = motion[:, -1]
    line_index = _measure_distance(view.line, end[:, None]).argmin(1)
    direction = np.cos(end[:, 2] - view.heading[line_index]) > 0
    sparse = motion[:, ::SPARSE]
    allowed = ~collides[:, -1] & direction & ~_leaves_road(view, sparse)
    # 2. progress along the route, as a fraction of the best proposal's
    progress = np.where(allowed, line_index, 0.0)
    best = progress.max()
    progress = progress / best if best > LEAST_PROGRESS_M else np.ones(n)
    # 3. time to collision and comfort
    risky = np.zeros(n, bool)
    time = STEP_S * SPARSE * np.arange(sparse.shape[1])
    for delay_s in TTC_S:
        coasted = sparse.copy()
        coasted[..., :2] += delay_s * sparse[..., 3:]
        meets = _meets(view, coasted, np.stack([_coasted(view.boxes, t + delay_s) for t in time]))
        risky |= (meets & (signed_speed(sparse) > 0.1)[..., None]).any((1, 2))
    speed = signed_speed(motion)
    acceleration = np.diff(speed, axis=1) / STEP_S
    lateral = speed[:, 1:] * wrapped(np.diff(motion[..., 2], axis=1)) / STEP_S
    jerk = np.diff(acceleration, axis=1) / STEP_S
    low, high = ACCELERATION
    comfort = ((acceleration >= low) & (acceleration <= high) & (np.abs(lateral) <= LATERAL)).all(1)
    comfort &= (np.abs(jerk) <= JERK).all(1)
    return allowed * (5 * progress + 5 * ~risky + 2 * comfort) / 12


def _meets(
    view: View, motion: Float[np.ndarray, "n t 5"], boxes: Float[np.ndarray, "t K 5"]
) -> Bool[np.ndarray, "n t K"]:
    """True where a proposal overlaps a box ahead or beside."""
    offset = boxes[..., :2] - motion[..., None, :2]  # [n, t, K, 2]
    meets = boxes_overlap(offset, motion[..., None, 2], boxes[..., 2], view.size, view.box_size)
    forward = offset[..., 0] * np.cos(motion[..., None, 2]) + offset[..., 1] * np.sin(motion[..., None, 2])
    return meets & (forward > -view.size[0] / 2)


def _leaves_road(view: View, motion: Float[np.ndarray, "n t 5"]) -> Bool[np.ndarray, "n"]:
    """True where a corner gets 0.3 m or more to the right of the nearest road edge."""
    if not len(view.edges):
        return np.zeros(len(motion), bool)
    corners = clockwise_corners(motion[..., :2], motion[..., 2], view.size).reshape(len(motion), -1, 2)  # [n, 4 t, 2]
    distance, side, _ = nearest_edges(corners, view.edges[None])
    return np.any((side < 0) & (distance >= OUTSIDE_M), axis=1)


def _nears_line(view: View) -> Bool[np.ndarray, "K"]:
    """True for boxes that may meet a proposal's line within the time of the proposals."""
    boxes = np.stack([_coasted(view.boxes, STEP_S * step) for step in range(0, STEPS + SPARSE, SPARSE)])  # [t, K, 5]
    distance = _measure_distance(boxes[:, :, None], view.line).min((0, 2), initial=np.inf)
    # between two sparse steps a box is at most half of its way from one of them
    distance -= SPARSE * STEP_S / 2 * np.hypot(*view.boxes[:, 3:].T)
    reach = np.linalg.norm(view.box_size + view.size[1], axis=-1) / 2 + max(OFFSETS_M)
    return distance <= reach + 1e-6


def _measure_distance(
    points: Float[np.ndarray, "*#m x"], others: Float[np.ndarray, "*#m y"]
) -> Float[np.ndarray, "*m"]:
    """Distance between points, of which x and y come first, m."""
    x, y = points[..., 0] - others[..., 0], points[..., 1] - others[..., 1]
    return np.sqrt(x * x + y * y)


def _coasted(boxes: Float[np.ndarray, "K 5"], time_s: float) -> Float[np.ndarray, "K 5"]:
    """Boxes at constant velocity after some time."""
    moved = boxes.copy()
    moved[:, :2] += time_s * boxes[:, 3:]
    return moved
