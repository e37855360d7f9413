"""Scores of a planner and of the traffic around it.

Of the planner nuPlan's closed-loop score and NAVSIM's PDMS as far as a log's map allows, and raw numbers; of the others
realism, reactivity and the blame for collisions.

Sources: the metric code and weights of motional/nuplan-devkit at e924167, and docs/metrics.md of navsim. Logs have road
edges and center lines but no lane polygons, hence the suffix `_style`: "inside one lane" and the drivable area are ours
(`contact.in_one_lane`, the official metric's distance to the road edge). Meters, seconds, radians.

Reactivity counts the seven events of ReactSim-Bench (arXiv 2606.14058), with thresholds of ours where the paper names
none.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property, lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, Shaped
from scipy.signal import savgol_filter

from rlftsim.envs.contact import BEHIND_RAD, Collision, in_one_lane, lane_search
from rlftsim.envs.record import Record
from rlftsim.envs.road import MAX_PAIRS, road_edges
from rlftsim.envs.route import Route
from rlftsim.envs.scene import Scene, build_env_scene
from rlftsim.geometry import boxes_overlap, clockwise_corners, heights_overlap, wrapped
from rlftsim.realism import METRIC_2025, SimulatedStates, score
from rlftsim.realism.agents import Trajectories
from rlftsim.realism.map_based import OUTSIDE_M, compute_distance_to_road_edge, compute_point_distance_to_road_edge
from rlftsim.realism.traffic_lights import Signals, build_signals, compute_traffic_light_violation
from rlftsim.scenario.types import (
    CURRENT_STEP,
    FUTURE_STEPS,
    HISTORY_STEPS,
    STEP_S,
    TOTAL_STEPS,
    ObjectType,
    Scenario,
    cached_on_scenario,
)
from rlftsim.viewer.scene import compute_overlap

PROGRESS_M = 2.0
"""Least progress that counts as one: 2 m in nuPlan's code and configuration, 0.1 m in the text of its documents."""
MAKING_PROGRESS = 0.2
WRONG_WAY_M, WRONG_WAY_STEPS = (2.0, 6.0), 10
"""Meters against the lane within 1 s: below the first 1, below the second 0.5, else 0."""
TTC_LEAST_S, TTC_HORIZON_S, TTC_MOVING_MPS = 0.95, 3.0, 0.005
AHEAD_RAD, CROSSING_RAD = np.radians(30.0), np.radians(45.0)
OVER_SPEED_MPS = 2.23
LANE_M = 2.0
"""Lanes farther than this from an agent say nothing about it."""
ACCELERATION, LATERAL, JERK = (-4.05, 2.40), 4.89, 8.37
COMFORT = {
    "longitudinal": ACCELERATION,
    "lateral": (-LATERAL, LATERAL),
    "yaw_rate": (-0.95, 0.95),
    "yaw_acceleration": (-1.93, 1.93),
    "longitudinal_jerk": (-4.13, 4.13),
    "jerk": (-JERK, JERK),
}
"""Bounds of comfort, m/s², m/s², rad/s, rad/s², m/s³, m/s³."""
SMOOTH_STEPS, SMOOTH_JERK_STEPS = 7, 15
"""Windows of the Savitzky-Golay filter. nuPlan takes 8 for acceleration, which newer versions of SciPy refuse."""
PDMS_STEPS = 40
WEIGHTS = {"progress": 5.0, "time_to_collision": 5.0, "speed_limit": 4.0, "comfort": 2.0}
PDMS_WEIGHTS = {"time_to_collision": 5.0, "progress": 5.0, "comfort": 2.0}
VULNERABLE = (ObjectType.PEDESTRIAN, ObjectType.CYCLIST)
RISKY_TTC_S = 1.0
INFEASIBLE_CURVATURE = 0.3
"""Turn per meter driven over half a second, rad/m: tighter than a radius of 3.3 m."""
SPAN_STEPS = 5
SLOW_MPS = 1.0
"""Curvature is not measured below this speed."""


@dataclass(frozen=True)
class PlannerScores:
    """Scores of an episode: higher is better, NaN = not measurable here. Names ending in _rate or _error: lower."""

    nuplan_style: float
    pdms_style: float
    """Over the first 4 s."""
    no_at_fault_collision: float
    drivable_area: float
    making_progress: float
    driving_direction: float
    progress: float
    time_to_collision: float
    speed_limit: float
    comfort: float
    collision_rate: float
    """1 = in contact with at least one track."""
    at_fault_collision_rate: float
    hit_rate: float
    """1 = at least one contact was not the planner's fault."""
    red_light_rate: float
    """1 = passed a red light, as the official metric defines it."""
    least_ttc_s: float
    """3 = at least that."""
    off_road_m: float
    """Largest distance of a corner off the road; 0 = never off."""
    route_completion: float
    speed_change_mps: float
    """Of the hardest contact; 0 = none."""
    mean_jerk_mps3: float
    jerk_95_mps3: float
    displacement_error: float
    """Mean distance to the log, m."""


def score_planner(record: Record) -> PlannerScores:
    """All scores of an episode.

    Args:
        record: Record of the episode; a short episode is scored up to the end.
    """
    missing, kinematics, (angle, limit, junction) = missing_scores(record), _kinematics(record), _lane_headings(record)
    time_s = _compute_times_to_collision(record, junction)
    steps = {"off_road_m": off_road(record), "lane_angle": angle, "limit_mps": limit, "time_to_collision_s": time_s}
    components = _score_components(record, steps, kinematics)
    early = record.first(PDMS_STEPS)
    early_steps = {name: values[: PDMS_STEPS + 1] for name, values in steps.items()}
    early_components = _score_components(early, early_steps, _kinematics(early))
    multiplied = ("no_at_fault_collision", "drivable_area", "making_progress", "driving_direction")
    nuplan = math.prod(components[name] for name in multiplied if math.isfinite(components[name]))
    # NAVSIM: a collision with a standing object costs half, and the driving direction has weight 0
    area = early_components["drivable_area"]
    pdms = early_components["no_at_fault_collision"] * (1.0 if math.isnan(area) else area)
    jerk = kinematics["jerk"]
    collisions, faults = record.collisions, [collision.at_fault for collision in record.collisions]
    route_length_m = float(record.route.progress(record.route.points[-1:])[0]) if len(record.route) else math.nan
    scores = PlannerScores(
        nuplan_style=nuplan * _weighted(components, WEIGHTS),
        pdms_style=pdms * _weighted(early_components, PDMS_WEIGHTS),
        **components,
        collision_rate=float(bool(collisions)),
        at_fault_collision_rate=float(any(faults)),
        hit_rate=float(not all(faults)),
        red_light_rate=float(passes_red_light(record.scene, record.agent_motion[:, :2])),
        least_ttc_s=float(steps["time_to_collision_s"].min()),
        off_road_m=max(0.0, float(steps["off_road_m"].max())),
        route_completion=_gained(record.route, record.agent_motion) / route_length_m if route_length_m else math.nan,
        speed_change_mps=max((collision.speed_change_mps for collision in collisions), default=0.0),
        mean_jerk_mps3=float(jerk.mean()) if len(jerk) else math.nan,
        jerk_95_mps3=float(np.quantile(jerk, 0.95)) if len(jerk) else math.nan,
        displacement_error=_displacement(record),
    )
    return replace(scores, **{name: math.nan for name in asdict(scores).keys() & missing})


def missing_scores(record: Record) -> dict[str, str]:
    """Scores that cannot be measured in a record's scenario, and why."""
    reasons, log_steps = {}, record.scene.scenario.num_steps - HISTORY_STEPS
    if record.steps > FUTURE_STEPS:
        reasons["others_realism"] = f"the metric compares {FUTURE_STEPS * STEP_S:g} s"
    elif record.is_open:
        reasons["others_realism"] = "agents leave and enter, which the metric does not compare"
    if record.steps > FUTURE_STEPS and record.has_left_map:
        reasons[f"scores beyond {record.steps * STEP_S:.1f} s"] = "the map ends there"
    if not record.scene.scenario.has_future:
        reason = "the log's future is withheld, as in a test split"
        reasons |= dict.fromkeys(("progress", "making_progress", "displacement_error"), reason)
    elif record.steps > max(FUTURE_STEPS, log_steps):
        names = ["progress", "making_progress", "displacement_error"]
        names += ["red_light_rate"] * (len(record.scene.scenario.lights.step) > 0)
        reasons |= dict.fromkeys(names, f"the log ends after {log_steps * STEP_S:.1f} s")
    elif not len(record.logged_route):
        reasons |= dict.fromkeys(("progress", "making_progress"), "there is no lane to measure progress along")
    if lane_search(record.scene.scenario) is None:
        reasons |= dict.fromkeys(("driving_direction", "speed_limit", "others_wrong_way_rate"), "the map has no lanes")
    if not len(record.route):
        reasons["route_completion"] = "there is no route"
    if road_edges(record.scene.scenario) is None:
        reasons |= dict.fromkeys(("drivable_area", "off_road_m", "others_offroad_rate"), "the map has no road edges")
    return reasons


Measures = dict[str, Float[np.ndarray, "_"]]
"""Numbers of each step by name, which several scores share."""


def _score_components(record: Record, steps: Measures, kinematics: Measures) -> dict[str, float]:
    """The eight parts of the score."""
    missing = missing_scores(record)
    ratio = math.nan if "progress" in missing else _progress_ratio(record)
    components = {
        "no_at_fault_collision": _collision_score(record),
        "drivable_area": float((steps["off_road_m"] < OUTSIDE_M).all()),
        "making_progress": math.nan if math.isnan(ratio) else float(ratio >= MAKING_PROGRESS),
        "driving_direction": _direction_score(record, steps["lane_angle"]),
        "progress": ratio,
        "time_to_collision": float(steps["time_to_collision_s"].min() >= TTC_LEAST_S),
        "speed_limit": _speed_score(record, steps["limit_mps"]),
        "comfort": _comfort(kinematics),
    }
    return {name: math.nan if name in missing else value for name, value in components.items()}


def _weighted(components: dict[str, float], weights: dict[str, float]) -> float:
    """Weighted mean of the parts that there are."""
    measured = [name for name in weights if math.isfinite(components[name])]
    return sum(weights[name] * components[name] for name in measured) / sum(weights[name] for name in measured)


def _collision_score(record: Record) -> float:
    """Product over vulnerable road users, vehicles and objects: 0 after a collision at fault, with objects 0.5."""
    agents = [collision.agent for collision in record.collisions if collision.at_fault]
    object_types = record.scene.object_type[agents].tolist()
    vulnerable = sum(object_type in VULNERABLE for object_type in object_types)
    vehicles = sum(object_type == ObjectType.VEHICLE for object_type in object_types)
    objects = len(object_types) - vulnerable - vehicles
    return max(0.0, 1.0 - vulnerable) * max(0.0, 1.0 - vehicles) * max(0.0, 1.0 - objects / 2)


def off_road(record: Record) -> Float[np.ndarray, "T1"]:
    """Signed distance of the corner farthest off the road at each step; without road edges -inf.

    The agent keeps the height of the current step, as in the metric, unless the scene has levels.
    """
    scene, edges = record.scene, road_edges(record.scene.scenario)
    if edges is None:
        return np.full(record.steps + 1, -np.inf)
    motion = record.agent_motion
    corners = clockwise_corners(motion[:, :2], motion[:, 2], scene.size[record.agent])  # [T + 1, 4, 2]
    z = np.repeat(record.ground[record.agent][:, None, None], 4, 1)
    points = torch.from_numpy(np.concatenate([corners + scene.scenario.origin, z], -1)).float()
    # the corners of a few steps lie close together
    groups = points.reshape(-1, 4 * math.gcd(len(points), 9), 3)
    distance = compute_point_distance_to_road_edge(groups, edges, max_pairs=MAX_PAIRS)
    return distance.view(-1, 4).amax(-1).double().numpy()


def _gained(route: Route, motion: Float[np.ndarray, "T1 5"]) -> float:
    """Meters along a route between the first and the last step."""
    first, last = route.progress(motion[[0, -1], :2])
    return float(last - first)


def _progress_ratio(record: Record) -> float:
    ego = _gained(record.logged_route, record.agent_motion)
    logged = record.scene.logged[record.agent, CURRENT_STEP : CURRENT_STEP + record.steps + 1]
    if ego < -PROGRESS_M:
        return 0.0
    return min(1.0, max(ego, PROGRESS_M) / max(_gained(record.logged_route, logged), PROGRESS_M))


def _lane_headings(record: Record) -> tuple[Float[np.ndarray, "T1"], Float[np.ndarray, "T1"], Bool[np.ndarray, "T1"]]:
    """Angle from the agent's heading to the best lane at each step, speed limit, and True in a junction.

    NaN, 0 and False where there is no lane. Best is, among the lanes around the agent's center, the lane with the
    smallest angle.
    """
    search = lane_search(record.scene.scenario)
    angle, limit = np.full(record.steps + 1, math.nan), np.zeros(record.steps + 1)
    junction = np.zeros(record.steps + 1, bool)
    if search is None:
        return angle, limit, junction
    lane_points = search.find_points(record.agent_motion[:, :2], LANE_M, record.ground[record.agent])
    for step, points in enumerate(lane_points):
        if points:
            turn = np.abs(wrapped(search.heading[points] - record.agent_motion[step, 2]))
            best = points[int(turn.argmin())]
            angle[step] = turn.min()
            limit[step] = record.scene.graph.speed_limit_mps[search.lane[best]]
            junction[step] = search.is_junction[search.lane[best]]
    return angle, limit, junction


def _direction_score(record: Record, angle: Float[np.ndarray, "T1"]) -> float:
    step = np.linalg.norm(np.diff(record.agent_motion[:, :2], axis=0), axis=1)
    max_against = measure_wrong_way(step, np.nan_to_num(angle[1:]) > np.pi / 2)
    return 1.0 if max_against < WRONG_WAY_M[0] else 0.5 if max_against < WRONG_WAY_M[1] else 0.0


def measure_wrong_way(step_m: Float[np.ndarray, "T"], is_against: Bool[np.ndarray, "T"]) -> float:
    """Most meters driven against the lane within a second.

    Args:
        step_m: Way of each step of 0.1 s.
        is_against: True = the step goes against the lane.
    """
    window = np.ones(min(WRONG_WAY_STEPS, len(step_m)))
    return float(np.convolve(np.where(is_against, step_m, 0.0), window, "valid").max()) if len(window) else 0.0


def _speed_score(record: Record, limit: Float[np.ndarray, "T1"]) -> float:
    speed = np.linalg.norm(record.agent_motion[:, 3:], axis=1)
    over = np.where(limit > 0, np.maximum(speed - limit, 0.0), 0.0)[1:]
    return max(0.0, 1.0 - float(over.mean()) / OVER_SPEED_MPS) if len(over) else 1.0


def _compute_times_to_collision(record: Record, junction: Bool[np.ndarray, "T1"]) -> Float[np.ndarray, "T1"]:
    """Time from each step until a box is met at constant speeds and headings, s; at most 3.

    Tracks ahead and crossing tracks count. Tracks beside the agent count only while the agent is not in a single lane,
    or is in a junction; tracks behind, and tracks already touched, never count.
    """
    agent_motion, motion = record.agent_motion, record.motion
    size = record.scene.size[:, :2]
    speed, other_speed = (np.linalg.norm(motion[..., 3:], axis=-1) for motion in (agent_motion, motion))
    offset = motion[..., :2] - agent_motion[:, :2]  # [A, T + 1, 2]
    bearing = np.abs(wrapped(np.arctan2(offset[..., 1], offset[..., 0]) - agent_motion[:, 2]))
    crossing = np.abs(np.sin(motion[..., 2] - agent_motion[:, 2])) > np.sin(CROSSING_RAD)
    is_in_lane = in_one_lane(record.scene, agent_motion, size[record.agent], record.ground[record.agent])
    counts_lateral = ~is_in_lane | junction
    counts = record.is_observed & (bearing < BEHIND_RAD) & ((bearing < AHEAD_RAD) | crossing | counts_lateral)
    counts[record.agent] = False
    counts &= speed > TTC_MOVING_MPS
    for collision in record.collisions:
        counts[collision.agent, collision.step :] = False
    diagonal = np.linalg.norm(size, axis=1)
    reach = TTC_HORIZON_S * (speed + other_speed) + (diagonal[:, None] + diagonal[record.agent]) / 2
    agents, steps = np.nonzero(counts & (np.linalg.norm(offset, axis=-1) <= reach))
    time = STEP_S * np.arange(round(TTC_HORIZON_S / STEP_S) + 1)
    ego, track = agent_motion[steps], motion[agents, steps]  # [P, 5] each
    gap = track[:, None, :2] - ego[:, None, :2] + time[:, None] * (track[:, None, 3:] - ego[:, None, 3:])  # [P, 31, 2]
    meets = boxes_overlap(gap, ego[:, None, 2], track[:, None, 2], size[record.agent], size[agents, None])
    if record.scene.levels is not None:  # heights at constant speeds and headings
        z, height = [], record.scene.size[:, 2]
        for rows in (np.full_like(agents, record.agent), agents):
            states = record.motion[rows, steps]
            line = states[:, None, :2] + time[:, None] * states[:, None, 3:]
            z.append(record.scene.levels.follow_lines(line, record.ground[rows, steps]) + height[rows, None] / 2)
        meets &= heights_overlap(z[1] - z[0], height[record.agent, None], height[agents, None])
    # tracks that overlap at the start of the episode, such as a stroller and its pusher, are in no danger of it
    overlapping = np.isin(agents, agents[(steps == 0) & meets[:, 0]])
    meets &= ~overlapping[:, None]
    times = np.full(record.steps + 1, TTC_HORIZON_S)
    np.minimum.at(times, steps, np.where(meets.any(1), time[meets.argmax(1)], TTC_HORIZON_S))
    return times


def _kinematics(record: Record) -> Measures:
    """Smoothed derivatives by the names of `COMFORT`."""
    motion = record.agent_motion
    if len(motion) < 5:  # too short for any derivative
        return dict.fromkeys(COMFORT, np.zeros(0))
    # odd windows that fit a short record
    short, long = (min(window, len(motion) - 1 + len(motion) % 2) for window in (SMOOTH_STEPS, SMOOTH_JERK_STEPS))
    cos, sin = np.cos(motion[:, 2]), np.sin(motion[:, 2])
    acceleration = _smooth(motion[:, 3:], short, order=2, derivative=1)
    longitudinal = acceleration[:, 0] * cos + acceleration[:, 1] * sin
    heading = np.unwrap(motion[:, 2])
    jerk = _smooth(acceleration, long, order=2, derivative=1)
    return {
        "longitudinal": longitudinal,
        "lateral": acceleration[:, 1] * cos - acceleration[:, 0] * sin,
        "yaw_rate": _smooth(heading, long, order=2, derivative=1),
        "yaw_acceleration": _smooth(heading, long, order=3, derivative=2),
        "longitudinal_jerk": _smooth(longitudinal, long, order=2, derivative=1),
        "jerk": np.linalg.norm(jerk, axis=1),
    }


def _smooth(
    values: Float[np.ndarray, "t *c"], window: int, *, order: int, derivative: int
) -> Float[np.ndarray, "t *c"]:
    """Derivative of values over the steps by the Savitzky-Golay filter."""
    if len(values) > TOTAL_STEPS:  # a matrix of so many steps squared would not pay
        return np.asarray(savgol_filter(values, window, order, deriv=derivative, delta=STEP_S, axis=0))
    return _build_filter(len(values), window, order, derivative) @ values


@lru_cache(maxsize=32)
def _build_filter(count: int, window: int, order: int, derivative: int) -> Float[np.ndarray, "t t"]:
    """The filter as a matrix: it is linear, and to fit its ends takes longer than to apply it."""
    return np.asarray(savgol_filter(np.eye(count), window, order, deriv=derivative, delta=STEP_S, axis=0))


def _comfort(kinematics: Measures) -> float:
    if not len(kinematics["jerk"]):
        return math.nan
    is_inside = ((low <= kinematics[name]) & (kinematics[name] <= high) for name, (low, high) in COMFORT.items())
    return float(all(inside.all() for inside in is_inside))


@cached_on_scenario
def find_signals(scenario: Scenario, num_steps: int) -> Signals | None:
    """Traffic lights of a scenario, with the lanes that they are on; None without any.

    Args:
        scenario: Scenario with the map and the logged lights.
        num_steps: Number of steps of the log's time; lights that are not logged are not red.
    """
    return build_signals(scenario.map_features, scenario.lights, torch.device("cpu"), num_steps)


def passes_red_light(scene: Scene, driven: Float[np.ndarray, "T1 2"]) -> bool:
    """True for a way that passes the stop point of a red light on its lane.

    Args:
        scene: Scene with the map and the lights of the episode; without lights nothing is passed.
        driven: Positions [T + 1, 2] of the agent from the current step on, map frame, m.
    """
    scenario, num_steps = scene.scenario, len(driven) - 1
    signals = find_signals(scenario, scene.num_steps)
    if signals is None or not num_steps:
        return False
    if scene.lights is not build_env_scene(scenario, scene.num_steps).lights:  # as SUMO showed them
        lights = scene.lights.log(scenario.lights)
        signals = build_signals(scenario.map_features, lights, torch.device("cpu"), scene.num_steps)
        assert signals is not None
    x, y = torch.from_numpy(driven + scenario.origin).float().T[:, None, None]
    valid = torch.ones(1, 1, num_steps, dtype=torch.bool)
    passed = compute_traffic_light_violation(x, y, valid, signals, first_step=CURRENT_STEP, max_pairs=MAX_PAIRS)
    return bool(passed.any())


def _displacement(record: Record) -> float:
    steps = slice(CURRENT_STEP + 1, CURRENT_STEP + 1 + record.steps)
    is_logged = record.scene.valid[record.agent, steps]
    if not is_logged.any():
        return math.nan
    offset = record.agent_motion[1:, :2] - record.scene.logged[record.agent, steps, :2]
    return float(np.linalg.norm(offset[is_logged], axis=1).mean())


INFEASIBLE_ACCELERATION_MPS2 = 8.0
"""Change of speed over half a second."""


@dataclass(frozen=True)
class TrafficScores:
    """Events of the other agents in an episode; rates are fractions of the other vehicles (contacts: of all)."""

    ego_contacts: float
    """Tracks in contact with the planner's agent."""
    risky_approach_rate: float
    """1 = the least time to collision fell below 1 s."""
    others_collision_rate: float
    others_offroad_rate: float
    others_wrong_way_rate: float
    others_acceleration_rate: float
    others_steering_rate: float
    blamed_others_rate: float
    """Of the contacts with the planner's agent, the fraction that was not its fault; NaN without a contact."""


def score_traffic(record: Record, least_ttc_s: float) -> TrafficScores:
    """Events of the other agents in an episode.

    Args:
        record: Record of the episode; a short episode is scored up to the end.
        least_ttc_s: Least time to collision of the planner's agent, as `PlannerScores` has it, s.
    """
    scene, motion = record.scene, record.motion
    # rows into which nobody has entered are no agents
    is_traffic = (np.arange(len(scene.object_id)) != record.agent) & record.is_observed.any(1)
    is_vehicle = is_traffic & (scene.object_type == ObjectType.VEHICLE)
    has_edges, has_lanes = (find(scene.scenario) is not None for find in (road_edges, lane_search))
    # 1. contacts among the others; those that begin with an overlap do not count
    length, width = scene.size[:, 0].astype(np.float32), scene.size[:, 1].astype(np.float32)
    overlaps = compute_overlap(
        motion[None, ..., :2].astype(np.float32), motion[None, ..., 2].astype(np.float32), length, width,
        (record.is_observed & is_traffic[:, None])[None], ignore_from=0,
        z=None if scene.levels is None else record.z[None], height=scene.size[:, 2],
    )[0].any(1)  # fmt: skip
    # 2. kinematics over half a second whose states are all known
    speed = np.linalg.norm(np.diff(motion[..., :2], axis=1), axis=-1) / STEP_S  # [A, T]
    speeds = _runs(speed, SPAN_STEPS + 1)
    change = np.abs(speeds[..., -1] - speeds[..., 0]) / (SPAN_STEPS * STEP_S)
    jolt = (change > INFEASIBLE_ACCELERATION_MPS2) & _runs(record.is_observed, SPAN_STEPS + 2).all(-1)
    driven = _runs(speed, SPAN_STEPS).sum(-1) * STEP_S
    headings = _runs(motion[..., 2], SPAN_STEPS + 1)
    turn = np.abs(wrapped(headings[..., -1] - headings[..., 0]))
    fast = (driven > SLOW_MPS * SPAN_STEPS * STEP_S) & _runs(record.is_observed, SPAN_STEPS + 1).all(-1)
    tight = np.where(fast, turn / np.maximum(driven, 1e-3), 0.0) > INFEASIBLE_CURVATURE
    return TrafficScores(
        ego_contacts=float(len(record.collisions)),
        risky_approach_rate=float(least_ttc_s < RISKY_TTC_S),
        others_collision_rate=_rate(overlaps, is_traffic),
        others_offroad_rate=_rate(_leaves_road(record, is_vehicle), is_vehicle & has_edges),
        others_wrong_way_rate=_rate(_drives_against(record, is_vehicle), is_vehicle & has_lanes),
        others_acceleration_rate=_rate(np.any(jolt, axis=1), is_vehicle),
        others_steering_rate=_rate(np.any(tight, axis=1), is_vehicle),
        blamed_others_rate=blamed_others_rate(record.collisions),
    )


def blamed_others_rate(collisions: Sequence[Collision]) -> float:
    """Fraction of contacts without fault of the planner's agent, in one episode or several; NaN without contacts."""
    return sum(not collision.at_fault for collision in collisions) / len(collisions) if collisions else np.nan


def _rate(event: Bool[np.ndarray, "A"], among: Bool[np.ndarray, "A"]) -> float:
    return float(event[among].mean()) if among.any() else np.nan


def _runs(values: Shaped[np.ndarray, "A t"], length: int) -> Shaped[np.ndarray, "A r n"]:
    """All runs of n consecutive steps; none where there are fewer steps."""
    if values.shape[1] < length:
        return np.zeros((len(values), 0, length), values.dtype)
    return np.lib.stride_tricks.sliding_window_view(values, length, axis=1)


def _leaves_road(record: Record, vehicles: Bool[np.ndarray, "A"]) -> Bool[np.ndarray, "A"]:
    """True = a vehicle's corner leaves the road during the episode; off the road from the start does not count."""
    edges, scene, leaves = road_edges(record.scene.scenario), record.scene, np.zeros(len(vehicles), bool)
    if edges is None:
        return leaves
    x, y = np.moveaxis(record.motion[..., :2] + scene.scenario.origin, -1, 0)
    pose = np.stack([x, y, record.z, record.motion[..., 2]])  # [4, A, T + 1]

    # those that stand do not leave the road
    agents = np.flatnonzero(vehicles & (pose != pose[..., :1]).any((0, 2)))
    if len(agents):
        states = Trajectories(*torch.from_numpy(pose[:, agents]).float()[:, None])
        size = torch.from_numpy(scene.size[agents, None]).float()
        off = compute_distance_to_road_edge(states, size, edges, max_pairs=MAX_PAIRS)[0].numpy() >= OUTSIDE_M
        is_observed = record.is_observed[agents]
        begins_off = np.take_along_axis(off, is_observed.argmax(1)[:, None], 1)[:, 0]
        leaves[agents] = ~begins_off & (off & is_observed).any(1)
    return leaves


def _drives_against(record: Record, vehicles: Bool[np.ndarray, "A"]) -> Bool[np.ndarray, "A"]:
    """True = drives 2 m or more within a second against every lane around the agent."""
    search, is_against = lane_search(record.scene.scenario), np.zeros(len(vehicles), bool)
    if search is None:
        return is_against
    # a replayed agent jumps over the gaps of its log
    is_step_observed = record.is_observed[:, 1:] & record.is_observed[:, :-1]
    step = np.where(is_step_observed, np.linalg.norm(np.diff(record.motion[..., :2], axis=1), axis=-1), 0.0)
    moving = np.flatnonzero(vehicles & (step.sum(1) >= WRONG_WAY_M[0]))
    for agent in moving:
        lane_points = search.find_points(record.motion[agent, 1:, :2], LANE_M, record.ground[agent, 1:])
        heading = record.motion[agent, 1:, 2]
        against = [
            bool(points) and bool((np.cos(search.heading[points] - direction) < 0).all())
            for points, direction in zip(lane_points, heading)
        ]
        is_against[agent] = measure_wrong_way(step[agent], np.array(against)) >= WRONG_WAY_M[0]
    return is_against


class _WithoutEgo(Scenario):
    """A scenario in which the ego is not evaluated."""

    @cached_property
    def evaluated_indices(self) -> Int64[np.ndarray, "E"]:
        """Tracks to predict, by ascending object id."""
        rows = np.unique(self.tracks_to_predict.astype(np.int64))
        rows = rows[self.tracks.valid[rows, CURRENT_STEP] & (rows != self.ego_index)]
        return rows[np.argsort(self.tracks.object_id[rows], kind="stable")]


@cached_on_scenario
def _leave_out_ego(scenario: Scenario) -> _WithoutEgo:
    return _WithoutEgo(**{field.name: getattr(scenario, field.name) for field in fields(Scenario)})


def compute_traffic_realism(records: Sequence[Record]) -> float:
    """Realism meta-metric of the agents to predict, the ego left out, over rollouts of a scenario.

    NaN where realism cannot be measured: no future, no road edges, an episode that ended early, or no other agent to
    predict.

    Args:
        records: Records of the same scenario, at least one, a rollout each.
    """
    scene = records[0].scene
    scenario = _leave_out_ego(scene.scenario)
    has_all_steps = all(record.steps == FUTURE_STEPS and not record.is_open for record in records)
    if not (scenario.has_evaluated_future and has_all_steps) or road_edges(scene.scenario) is None:
        return float("nan")
    motion = torch.from_numpy(np.stack([record.motion[:, 1:] for record in records]))  # [N, A, 80, 5]
    world = (motion[..., :2] + torch.from_numpy(scene.scenario.origin)).float()
    z = torch.from_numpy(scene.z).float()[None, :, None].expand(world.shape[:-1])
    states = SimulatedStates(scene.object_id, world[..., 0], world[..., 1], z, motion[..., 2].float())
    return float(score(scenario, states, METRIC_2025).meta_metric)
