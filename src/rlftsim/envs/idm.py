"""The intelligent driver model (Treiber, Hennecke, Helbing, 2000) along lines: for planners and for traffic.

M agents with a line of W points each, a point every meter from the agent's center on; K other boxes. Meters, seconds.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float

from rlftsim.envs.actions import signed_speed, to_heading_frame
from rlftsim.envs.levels import RouteHeights, is_on_level
from rlftsim.envs.route import NEAR_LANE_M, compute_headings, trace_lanes
from rlftsim.envs.scene import RED, YELLOW, Scene
from rlftsim.geometry import heights_overlap, wrapped
from rlftsim.scenario.polylines import arc_length, resample_to, sample_line
from rlftsim.scenario.types import CURRENT_STEP, STEP_S, TOTAL_STEPS

LOOKAHEAD_M = 40
"""Leaders are searched so far ahead, as nuPlan's planner does."""
ON_LINE_M = 2.0
"""A light whose stop point is within this distance of a line is on the line."""
BEYOND_M = 60.0
"""A line goes straight on so far beyond the logged way."""
JOIN_M, EXIT_M = 5, 2.0
"""A way goes on along the lanes so far ahead of its end, and its agent leaves so far before these end."""
PARKED_MPS = 0.5
"""A vehicle that is never faster in its log stays parked."""
NEAREST, BEYOND_BOX_M = 16, 10.0
"""Leaders are searched among so many boxes, whose centers are no farther than this beyond the end of the search."""
STANDS_M = 2.0
"""An agent that never gets farther than this in its log has no direction of its own."""
TURN_M = 0.25
"""Ways that go back by less are noise."""
CREEP_MPS = 0.001
"""Speed that takes an agent past the point where it turns back; without it the point would never quite be reached."""


@dataclass(frozen=True)
class IdmConfig:
    """Parameters; the defaults are those of nuPlan's planner."""

    speed_mps: float = 10.0
    """Wanted where no limit is known."""
    gap_m: float = 1.0
    headway_s: float = 1.5
    acceleration_mps2: float = 1.0
    braking_mps2: float = 3.0
    exponent: float = 4.0
    hardest_braking_mps2: float = 8.0


def compute_idm_acceleration(
    speed: Float[np.ndarray, "*m"],
    free_speed: Float[np.ndarray, "*#m"],
    gap: Float[np.ndarray, "*m"],
    lead_speed: Float[np.ndarray, "*m"],
    config: IdmConfig,
) -> Float[np.ndarray, "*m"]:
    """Acceleration, m/s².

    Args:
        speed: Speed of each agent, m/s.
        free_speed: Speed of each agent on a free road, m/s.
        gap: Distance from bumper to bumper, m; infinite without a leader.
        lead_speed: Speed of the leader along the line, m/s.
        config: Parameters of the driver model.
    """
    closing = speed * (speed - lead_speed) / (2 * np.sqrt(config.acceleration_mps2 * config.braking_mps2))
    wanted_gap = config.gap_m + np.maximum(0.0, speed * config.headway_s + closing)
    free = (speed / np.maximum(free_speed, 0.1)) ** config.exponent
    acceleration = config.acceleration_mps2 * (1 - free - (wanted_gap / np.maximum(gap, 0.1)) ** 2)
    return np.maximum(acceleration, -config.hardest_braking_mps2)


def find_leaders(
    line: Float[np.ndarray, "M W 2"],
    heading: Float[np.ndarray, "M W"],
    size: Float[np.ndarray, "M 2"],
    boxes: Float[np.ndarray, "M K 5"],
    box_size: Float[np.ndarray, "M K 2"],
    mask: Bool[np.ndarray, "M K"],
) -> tuple[Float[np.ndarray, "M"], Float[np.ndarray, "M"]]:
    """Gap to the first box that meets the swept line, and the box's speed along the line; infinite and 0 without a box.

    Args:
        line: Points ahead of each agent, a meter apart, map frame.
        heading: Direction of the line at each point, rad.
        size: Length and width of the agents, m.
        boxes: Motion x, y, heading, vx, vy of the boxes that each agent may meet.
        box_size: Length and width of these boxes, m.
        mask: True = a box that can be a leader; False = padding.
    """
    if not boxes.shape[1]:
        return np.full(len(line), np.inf), np.zeros(len(line))
    # 1. Every point of the line in the frame of every box [M, K, W].
    x, y = line[:, None, :, 0] - boxes[..., 0, None], line[:, None, :, 1] - boxes[..., 1, None]
    forward, lateral = map(np.abs, to_heading_frame(x, y, boxes[..., 2:3]))
    # 2. It meets the box if the agent's width across the line does.
    turn, half = heading[:, None] - boxes[..., 2:3], size[:, 1, None, None] / 2
    meets = forward <= box_size[..., :1] / 2 + half * np.abs(np.sin(turn))
    meets &= lateral <= box_size[..., 1:] / 2 + half * np.abs(np.cos(turn))
    meets &= mask[..., None]
    # 3. The first point that meets any box, and that box's speed along the line there.
    any_box = meets.any(1)  # [M, W]
    first, has_leader, row = any_box.argmax(1), np.any(any_box, axis=1), np.arange(len(meets))
    box = meets[row, :, first].argmax(1)
    velocity, line_heading = boxes[row, box, 3:], heading[row, first]
    speed = np.maximum(velocity[:, 0] * np.cos(line_heading) + velocity[:, 1] * np.sin(line_heading), 0.0)
    gap = np.maximum(first - size[:, 0] / 2, 0.0)
    return np.where(has_leader, gap, np.inf), np.where(has_leader, speed, 0.0)


@dataclass(frozen=True, eq=False)
class IdmLines:
    """The ways of the IDM-driven agents of a scenario: logged ways, from the current poses on."""

    agents: np.ndarray
    """Their rows, [M]."""
    points: Float[np.ndarray, "M P 2"]
    """One every meter; the last one repeated."""
    heading: Float[np.ndarray, "M P"]
    """Direction of the line."""
    facing: Float[np.ndarray, "M P"]
    """Heading of the agent there: against the line where it backs up in its log."""
    turn_m: Float[np.ndarray, "M P"]
    """Distance along the line to the next point where the agent stops to go the other way; infinite without one."""
    ground: Float[np.ndarray, "M P"]
    """Height of the ground; zeros in scenes without levels."""
    stop_m: Float[np.ndarray, "M T"]
    """Distance along the line to the stop point of each light; infinite where the light is on another way."""
    wanted_mps: Float[np.ndarray, "M"]
    """The fastest logged speed, at least that of `IdmConfig` unless the agent backs up."""
    exit_m: Float[np.ndarray, "M"]
    """Distance along the line where the agent leaves, beyond the lanes; infinite in scenes of 8 s and off the lanes."""


def build_idm_lines(scene: Scene, agents: np.ndarray, config: IdmConfig) -> IdmLines:
    """Lines of the agents that drive in the log; all other agents stay parked.

    Args:
        scene: Scene with the log, the lights and the levels of the agents.
        agents: Rows of the IDM-driven vehicles in the scene's agent axis.
        config: Parameters of the driver model.
    """
    fastest = np.linalg.norm(scene.logged[agents, CURRENT_STEP:, 3:], axis=-1).max(1, initial=0.0)
    agents, fastest = agents[fastest >= PARKED_MPS], fastest[fastest >= PARKED_MPS]
    ways = [_logged_path(scene, int(agent)) for agent in agents]
    sampled = [_sample_path(path) for path, _ in ways]
    longest = max((len(line) for line, _ in sampled), default=1)
    shape = (len(agents), longest)
    points, heading, backs_up = np.zeros((*shape, 2)), np.zeros(shape), np.zeros(shape, bool)
    for row, (line, is_backward) in enumerate(sampled):
        beyond = (0, longest - len(line))
        points[row] = np.pad(line, (beyond, (0, 0)), mode="edge")
        heading[row] = np.pad(compute_headings(line), beyond, mode="edge")
        backs_up[row] = np.pad(is_backward, beyond, mode="edge")
    turn_m = np.full(shape, np.inf)
    turn_m[:, :-1][backs_up[:, 1:] != backs_up[:, :-1]] = 1.0
    turn_m = np.minimum.accumulate((turn_m + np.arange(longest))[:, ::-1], axis=1)[:, ::-1]
    free_speed = np.where(backs_up.any(1), fastest, np.maximum(fastest, config.speed_mps))
    offset = np.linalg.norm(points[:, :, None] - scene.lights.point, axis=-1)  # [M, P, T]
    ground = np.zeros(heading.shape)
    if scene.levels is not None:
        ground = scene.levels.follow_lines(points, scene.z[agents] - scene.size[agents, 2] / 2)
        offset[~is_on_level(scene.lights.z - ground[..., None])] = np.inf
    stop = np.where(offset.min(1) <= ON_LINE_M, offset.argmin(1), np.inf)
    facing = np.where(backs_up, wrapped(heading + np.pi), heading)
    exit_m = np.array([arc_length(path[:, :2])[-2] - EXIT_M if goes_on else np.inf for path, goes_on in ways])
    return IdmLines(agents, points, heading, facing, turn_m, ground, stop, free_speed, exit_m)


def _logged_path(scene: Scene, agent: int) -> tuple[Float[np.ndarray, "p 3"], bool]:
    """Poses of an agent's log where the agent moves, and a last pose; True where lanes of a long scene lie between."""
    logged = scene.logged[agent, CURRENT_STEP:]
    step = np.linalg.norm(np.diff(logged[:, :2], axis=0), axis=1)
    poses = logged[np.append(True, step > 0.05), :3]
    direction = logged[0, 2] + (np.pi if signed_speed(logged[:1])[0] < 0 else 0.0)
    if np.linalg.norm(poses[:, :2] - poses[0, :2], axis=1).max() > STANDS_M:
        last = poses[-1] - poses[max(len(poses) - 5, 0)]
        direction = np.arctan2(last[1], last[0])
    else:
        poses = poses[:1]
    goes_on = False
    if scene.num_steps > TOTAL_STEPS:
        lane_points = trace_lanes(scene, agent)
        distance = np.linalg.norm(lane_points - poses[-1, :2], axis=1)
        is_on_lane = distance.min(initial=np.inf) <= NEAR_LANE_M
        lane_points = lane_points[int(distance.argmin()) + JOIN_M :] if is_on_lane else lane_points[:0]
        goes_on = len(lane_points) > 1
        if goes_on:
            poses = np.vstack([poses, np.column_stack([lane_points, compute_headings(lane_points)])])
            direction = poses[-1, 2]
    beyond = poses[-1] + BEYOND_M * np.array([np.cos(direction), np.sin(direction), 0.0])
    return np.vstack([poses, beyond]), goes_on


def _sample_path(path: Float[np.ndarray, "p 3"]) -> tuple[Float[np.ndarray, "P 2"], Bool[np.ndarray, "P"]]:
    """Points a meter apart along a path, and where the agent backs up to the next one.

    Points where it turns back are kept; before them the distances are whole parts of the length.
    """
    step, length = np.diff(path[:, :2], axis=0), arc_length(path)
    is_backward = step[:, 0] * np.cos(path[:-1, 2]) + step[:, 1] * np.sin(path[:-1, 2]) < 0
    turns = np.append(0, np.flatnonzero(np.diff(is_backward)) + 1)
    turns = turns[np.diff(length[turns], append=length[-1]) >= TURN_M]
    turns = turns[np.append(True, np.diff(is_backward[turns]))]
    bounds = [0, *turns[1:].tolist()]
    lines = [
        resample_to(path[start : end + 1, :2], round(float(length[end] - length[start])) + 1)[:-1]
        for start, end in pairwise(bounds)
    ]
    lines.append(sample_line(path[bounds[-1] :, :2], 1.0))
    return np.concatenate(lines), np.repeat(is_backward[turns], [len(line) for line in lines])


def _compute_turning_speed(
    distance: Float[np.ndarray, "M"], speed: Float[np.ndarray, "M"], config: IdmConfig
) -> Float[np.ndarray, "M"]:
    """Largest speed after a step from which the usual braking ends in a standstill at the turn, m/s.

    Args:
        distance: Distance to the turn before the step, m.
        speed: Speed before the step, m/s.
        config: Parameters of the driver model.
    """
    braking, half_step = config.braking_mps2, STEP_S / 2
    square = CREEP_MPS**2 + 2 * braking * (distance - speed * half_step) + (braking * half_step) ** 2
    return np.maximum(np.sqrt(np.maximum(square, 0.0)) - braking * half_step, 0.0)


def begin_idm(lines: IdmLines, scene: Scene) -> Float[np.ndarray, "M 2"]:
    """Distance along the line, m, and speed, m/s, at the current step; an agent that rolls against its line stands.

    Args:
        lines: Lines of the IDM-driven agents, from the current poses on.
        scene: Scene with the log of the agents.
    """
    velocity, angle = scene.logged[lines.agents, CURRENT_STEP, 3:], lines.heading[:, 0]
    along = velocity[:, 0] * np.cos(angle) + velocity[:, 1] * np.sin(angle)
    speed = np.where(along < 0, 0.0, np.linalg.norm(velocity, axis=-1))
    return np.stack([np.zeros_like(speed), speed], -1)


def advance_idm(
    lines: IdmLines,
    idm_state: Float[np.ndarray, "M 2"],
    motion: Float[np.ndarray, "A 5"],
    z: Float[np.ndarray, "A"],
    present: Bool[np.ndarray, "A"],
    scene: Scene,
    step: int,
    config: IdmConfig,
) -> tuple[Float[np.ndarray, "M 2"], Float[np.ndarray, "M 5"]]:
    """Places and states of the IDM-driven agents of a scenario after 0.1 s.

    Args:
        lines: Lines of the IDM-driven agents, from the current poses on.
        idm_state: Distance along the line, m, and speed, m/s.
        motion: Motion x, y, heading, vx, vy of all agents before the step.
        z: Heights of the centers of all agents, m.
        present: False = the agent has left the scene and is no leader.
        scene: Scene with the log, the lights and the levels of the agents.
        step: Step of the log, which the states of the lights are read at.
        config: Parameters of the driver model.
    """
    position_m, speed = idm_state.T
    rows, size = np.arange(len(lines.agents)), scene.size[:, :2]
    # 1. The next 40 m of each line; the agent's own box is no leader.
    window = np.minimum(position_m.astype(int)[:, None] + np.arange(LOOKAHEAD_M), lines.points.shape[1] - 1)
    distance = np.linalg.norm(motion[lines.agents, None, :2] - motion[:, :2], axis=-1)
    distance[:, ~present] = np.inf
    distance[rows, lines.agents] = np.inf
    nearest = np.argsort(distance, axis=1)[:, :NEAREST]
    mask = np.take_along_axis(distance, nearest, 1) < LOOKAHEAD_M + BEYOND_BOX_M
    line, heading = lines.points[rows[:, None], window], lines.heading[rows[:, None], window]
    if scene.levels is not None:
        height, ground = scene.size[:, 2], lines.ground[rows[:, None], window]
        center = z[nearest] - height[lines.agents, None] / 2
        heights = RouteHeights.measure(motion[nearest, :2], center, line, ground)
        distance = np.take_along_axis(distance, nearest, 1)
        rise = heights.differences(distance, ground[:, 0], np.zeros(len(rows)))
        mask &= heights_overlap(rise, height[lines.agents, None], height[nearest])
    gap, lead = find_leaders(line, heading, size[lines.agents], motion[nearest], size[nearest], mask)
    # 2. A red or yellow light ahead is a standing leader.
    front = position_m + size[lines.agents, 0] / 2
    waits = np.isin(scene.lights.state[step], (RED, YELLOW))
    to_stop = np.where(waits & (lines.stop_m >= front[:, None]), lines.stop_m - front[:, None], np.inf)
    to_stop = to_stop.min(1, initial=np.inf)
    lead, gap = np.where(to_stop < gap, 0.0, lead), np.minimum(gap, to_stop)
    # 3. Along the line by the mean speed of the step.
    acceleration = compute_idm_acceleration(speed, lines.wanted_mps, gap, lead, config)
    slowed = _compute_turning_speed(lines.turn_m[rows, position_m.astype(int)] - position_m, speed, config)
    slowed = np.maximum(slowed, speed - config.hardest_braking_mps2 * STEP_S)
    new_speed = np.clip(speed + acceleration * STEP_S, 0.0, slowed)
    position_m = np.minimum(position_m + (speed + new_speed) / 2 * STEP_S, lines.points.shape[1] - 1.001)
    low = position_m.astype(int)
    fraction = (position_m - low)[:, None]
    position = (1 - fraction) * lines.points[rows, low] + fraction * lines.points[rows, low + 1]
    angle = lines.heading[rows, low]
    velocity = new_speed[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    facing = lines.facing[rows, low]
    return np.stack([position_m, new_speed], -1), np.concatenate([position, facing[:, None], velocity], -1)
