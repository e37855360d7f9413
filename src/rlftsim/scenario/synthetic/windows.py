"""Scenarios of 9.1 s or longer cut from minutes of traffic: choice of ego, visible agents, tracks to predict.

A street network and its traffic follow from a seed. A window of the traffic becomes a scenario only if bodies
accelerate and turn plausibly, keep apart, and stay on the road.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from rlftsim.geometry import boxes_overlap, clockwise_corners
from rlftsim.scenario.synthetic import sumo
from rlftsim.scenario.synthetic.bodies import Body, add_label_noise, read_pedestrians, read_signals, read_vehicles
from rlftsim.scenario.synthetic.crop import HEIGHT_GRID_PER_M, MapCropper, draw_ground, on_grid
from rlftsim.scenario.synthetic.map_features import build_network_map
from rlftsim.scenario.synthetic.network import read_network
from rlftsim.scenario.synthetic.parking import park_in_lots, park_in_strips
from rlftsim.scenario.synthetic.street_plan import draw_city_plan, draw_freeway_plan
from rlftsim.scenario.synthetic.sumo import write_demand
from rlftsim.scenario.types import (
    CURRENT_STEP,
    STEP_S,
    TOTAL_STEPS,
    LightState,
    LightStates,
    MapFeatures,
    ObjectType,
    Scenario,
    Tracks,
)

MAX_ACCELERATION_MPS2 = 15.0
MAX_SLIP_RAD = 0.4
MAX_HEADING_STEP_RAD = 0.3
MAX_OVERLAP_S = 0.3
MAX_OFF_ROAD_M = 0.5
MIN_MOVING_AGENTS = 4

Size = tuple[float, float, float]
"""Length, width and height in meters."""


def moves_plausibly(position: Float[np.ndarray, "n 2"], heading: Float[np.ndarray, "n"], is_vehicle: bool) -> bool:
    """True for a path within the limits of acceleration, for vehicles also within those of slip and turning per step.

    Args:
        position: Centers at consecutive steps, without label noise, m.
        heading: Directions of the body at the same steps, rad.
        is_vehicle: False = a pedestrian, which may step sideways and turn on the spot.
    """
    if len(position) < 3:
        return True
    acceleration = np.linalg.norm(np.diff(position, 2, axis=0), axis=1) / STEP_S**2  # [n-2]
    if acceleration.max() > MAX_ACCELERATION_MPS2:
        return False
    if not is_vehicle:
        return True
    if np.abs(np.diff(np.unwrap(heading))).max() > MAX_HEADING_STEP_RAD:
        return False
    # slip: angle between the direction of motion and the heading, which a slow body does not have
    velocity = np.gradient(position, STEP_S, axis=0)
    fast = np.linalg.norm(velocity, axis=1) > 1.0
    slip = np.arctan2(velocity[:, 1], velocity[:, 0]) - heading
    slip = np.abs(np.arctan2(np.sin(slip), np.cos(slip)))
    return not np.any(slip[fast] > MAX_SLIP_RAD)


def compute_overlap_s(
    position: Float[np.ndarray, "v n 2"],
    heading: Float[np.ndarray, "v n"],
    sizes: list[Size],
    valid: Bool[np.ndarray, "v n"],
) -> float:
    """Longest time in seconds that any two vehicles share area while both are valid.

    Args:
        position: Centers of v vehicles over n steps, m.
        heading: Directions of the vehicles, rad.
        sizes: Length, width and height of each vehicle, m.
        valid: True at the steps at which a vehicle is observed.
    """
    longest = 0
    reach = np.array([np.hypot(size[0], size[1]) / 2 for size in sizes])
    for i in range(len(sizes) - 1):
        # circles around the boxes first: few pairs come close
        gap_m = np.linalg.norm(position[i + 1 :] - position[i], axis=-1) - reach[i] - reach[i + 1 :, None]
        for j in np.flatnonzero(((gap_m < 0) & valid[i + 1 :] & valid[i]).any(axis=1)) + i + 1:
            steps = np.flatnonzero(valid[i] & valid[j])
            gap = position[j, steps] - position[i, steps]
            hits = boxes_overlap(gap, heading[i, steps], heading[j, steps], np.array(sizes[i]), np.array(sizes[j]))
            longest = max(longest, int(hits.sum()))
    return longest * STEP_S


def compute_off_road_m(
    drivable: Any, position: Float[np.ndarray, "n 2"], heading: Float[np.ndarray, "n"], size: Size
) -> float:
    """Largest distance of a corner from the drivable area in meters, at every third step; 0 if all are inside.

    Args:
        drivable: Drivable area as a shapely geometry, plan coordinates, m.
        position: Centers of a body over n steps, m.
        heading: Directions of the body at the same steps, rad.
        size: Length, width and height of the body, m; the height is ignored.
    """
    import shapely

    corners = clockwise_corners(position[::3], heading[::3], np.array(size)).reshape(-1, 2)
    return float(shapely.distance(shapely.points(corners), drivable).max(initial=0.0))


FIRST_START = 20
"""Smoothing over time bends the very first steps of a recording."""
GAP_STEPS = 9
"""Steps between windows that follow one another."""
EGO_TO_END_M = 95.0
EGO_TO_EGO_M = 70.0
MAP_BEYOND_RANGE_M = 20.0
ROAMING_MPS = 10.0
"""Map and lights of a window longer than 9.1 s reach so much farther per second: an ego may drive elsewhere."""
PREDICT_WITHIN_M = 70.0
MAX_PREDICTED_PEDESTRIANS = 2
POSITION_GRID_PER_M = 512
HEADING_GRID_PER_RAD = 4096
VELOCITY_GRID_PER_MPS = 256
SIZE_GRID_PER_M = 128
_STOP = (LightState.STOP, LightState.ARROW_STOP)
_LIGHT_STATES = {
    "G": (LightState.GO, LightState.ARROW_GO),
    "g": (LightState.GO, LightState.GO),
    **dict.fromkeys("yY", (LightState.CAUTION, LightState.ARROW_CAUTION)),
}
"""WOMD's states, without and with an arrow, for the letters of SUMO; all others mean stop."""


@dataclass(frozen=True)
class SumoSource:
    """All that SUMO needs to run a world again, besides `sumo.OPTIONS`."""

    network: str
    """XML of the compiled network."""
    routes: str
    """XML of types, trips and walks with routes."""
    seed: int


@dataclass(frozen=True, eq=False)
class World:
    """A simulated network with traffic, from which windows are cut."""

    name: str
    bodies: tuple[Body, ...]
    cropper: MapCropper
    signals: dict[str, tuple[str, ...]]
    """Letters of SUMO for all links of each junction, a text per step."""
    ends: Float[np.ndarray, "n 2"]
    """Positions of the network's ends."""
    num_steps: int
    source: SumoSource | None = None
    """None = boxes are smooth, made with the future, and the world is not run again."""


@dataclass(frozen=True, eq=False)
class Window:
    """A scenario and its origin in a world."""

    scenario: Scenario
    start: int
    """Step of the recording at which the scenario begins."""
    bodies: list[Body]
    """Bodies of the tracks."""


@dataclass(frozen=True, eq=False)
class _View:
    """Bodies seen in a window; arrays over its S steps, zero where a body does not exist."""

    bodies: list[Body]
    position: Float[np.ndarray, "o S 2"]
    heading: Float[np.ndarray, "o S"]
    velocity: Float[np.ndarray, "o S 2"]
    valid: Bool[np.ndarray, "o S"]

    @property
    def traveled_m(self) -> Float[np.ndarray, "o"]:
        """Distance driven while valid."""
        is_valid = self.valid[:, 1:] & self.valid[:, :-1]
        return (np.linalg.norm(np.diff(self.position, axis=1), axis=-1) * is_valid).sum(axis=1)


def _look(bodies: list[Body], start: int, num_steps: int, ego: Body, range_m: float, rng: np.random.Generator) -> _View:
    """All bodies the ego sees at any step of the window; the ego comes last."""
    ego_slice = slice(start - ego.first_step, start - ego.first_step + num_steps)
    ego_path = ego.position[ego_slice]  # [S, 2]
    visible_bodies, arrays = [], []
    for body in [*(candidate for candidate in bodies if candidate is not ego), ego]:
        # 1. Steps [first, last) of the window in which the body exists, and the same steps of the body's own life.
        first = max(0, body.first_step - start)
        last = min(num_steps, body.first_step + body.num_steps - start)
        if last <= first:
            continue
        index = start + first - body.first_step
        span = slice(index, index + last - first)

        # 2. Steps at which the ego sees it.
        distance = np.linalg.norm(body.position[span] - ego_path[first:last], axis=1)
        if distance.min() > range_m:
            continue
        is_visible = np.ones(num_steps, bool)
        if body is not ego:
            is_visible = distance < range_m
            # now and then a spell behind something, the more likely the farther away
            if rng.random() < 0.5 * np.clip(distance.mean() / range_m, 0.0, 1.0):
                begin = int(rng.integers(-20, num_steps))
                is_visible[max(0, begin) : max(0, begin + int(rng.integers(5, 50)))] = False
        if not is_visible.any():
            continue

        # 3. Its states, where it exists; `valid` where it is seen.
        position, heading = np.zeros((num_steps, 2)), np.zeros(num_steps)
        velocity, valid = np.zeros((num_steps, 2)), np.zeros(num_steps, bool)
        position[first:last], heading[first:last] = body.position[span], body.heading[span]
        velocity[first:last], valid[first:last] = body.velocity[span], is_visible
        visible_bodies.append(body)
        arrays.append((position, heading, velocity, valid))
    return _View(visible_bodies, *(np.stack(column) for column in zip(*arrays, strict=True)))


def _passes_gates(view: _View, rng: np.random.Generator) -> bool:
    """True for a window with enough motion, in which all bodies move and keep apart like real road users."""
    moving = view.traveled_m > 1.0  # [o]
    if moving.sum() < MIN_MOVING_AGENTS:
        return False
    if not moving[-1] and rng.random() >= 0.15:  # few scenarios with an ego that stands
        return False
    for index in np.flatnonzero(moving):
        valid_steps = np.flatnonzero(view.valid[index])
        span = slice(valid_steps[0], valid_steps[-1] + 1)  # also where it is hidden for a while
        is_vehicle = view.bodies[index].object_type != ObjectType.PEDESTRIAN
        if not moves_plausibly(view.position[index, span], view.heading[index, span], is_vehicle):
            return False
    vehicles = [k for k, body in enumerate(view.bodies) if body.object_type == ObjectType.VEHICLE]
    sizes = [view.bodies[k].size for k in vehicles]
    overlap = compute_overlap_s(view.position[vehicles], view.heading[vehicles], sizes, view.valid[vehicles])
    return overlap <= MAX_OVERLAP_S


def _is_on_road(view: _View, index: int, drivable: Any) -> bool:
    """True for a vehicle that stays in the drivable area, and for bodies of other types."""
    body, valid = view.bodies[index], view.valid[index]
    if body.object_type != ObjectType.VEHICLE:
        return True
    distance = compute_off_road_m(drivable, view.position[index, valid], view.heading[index, valid], body.size)
    return distance <= MAX_OFF_ROAD_M


def choose_tracks_to_predict(view: _View, rng: np.random.Generator, drivable: Any) -> list[int]:
    """2 to 8 tracks, far-traveling ones first, pedestrians and cyclists preferred; in half of the sets a standing one.

    Args:
        view: Window whose last body is the ego.
        rng: Generator of all choices; the order of bodies decides the draws.
        drivable: Drivable area of the network as a shapely geometry.
    """
    # 1. Candidates: seen now and mostly in the 8 s of the metric, near the ego.
    future = slice(CURRENT_STEP + 1, TOTAL_STEPS)
    ego_position = view.position[-1, CURRENT_STEP]
    candidates = [
        k
        for k, body in enumerate(view.bodies[:-1])
        if body.is_evaluable
        and view.valid[k, CURRENT_STEP]
        and view.valid[k, future].mean() >= 0.7
        and np.linalg.norm(view.position[k, CURRENT_STEP] - ego_position) < PREDICT_WITHIN_M
        and not (body.object_type == ObjectType.VEHICLE and rng.random() < 0.1)
    ]
    # 2. Their order: by distance traveled with some noise.
    traveled = np.minimum(view.traveled_m, 40.0)
    is_vehicle = [body.object_type == ObjectType.VEHICLE for body in view.bodies]
    rank = {k: traveled[k] * (1.0 if is_vehicle[k] else 2.0) + rng.normal(0, 8.0) for k in candidates}
    num_tracks = int(rng.choice([2, 3, 4, 5, 6, 7, 8], p=[0.14, 0.18, 0.2, 0.16, 0.13, 0.1, 0.09]))
    moving = sorted((k for k in candidates if traveled[k] > 1.0), key=lambda k: -rank[k])
    standing = [k for k in candidates if traveled[k] <= 1.0]
    order = ([standing[0]] if standing and rng.random() < 0.5 else []) + moving + standing
    # 3. The first ones that are on the road, not too many pedestrians among them.
    tracks: list[int] = []
    pedestrians = 0
    for k in dict.fromkeys(order):
        is_pedestrian = view.bodies[k].object_type == ObjectType.PEDESTRIAN
        if len(tracks) == num_tracks or (is_pedestrian and pedestrians == MAX_PREDICTED_PEDESTRIANS):
            continue
        if _is_on_road(view, k, drivable):
            tracks.append(k)
            pedestrians += is_pedestrian
    return sorted(tracks)


def _observe_lights(
    world: World, features: MapFeatures, start: int, ego_path: Float[np.ndarray, "n 2"], range_m: float
) -> LightStates:
    """State of every light whose lane begins within the range, per step."""
    first_point = dict(zip(features.feature_id.tolist(), features.points[features.offsets[:-1]]))
    # 1. Lights that the ego ever comes near, and whose lane is not cut at its beginning.
    lights = []
    for junction, link, lane_id, direction in world.cropper.network_map.light_lanes:
        stop = world.cropper.network_map.features[lane_id - 1].points[0]
        stop_point = first_point.get(lane_id)
        if stop_point is None or np.linalg.norm(stop_point[:2] - stop) > 0.01:
            continue
        if np.linalg.norm(ego_path - stop, axis=1).min() < range_m:
            # a left turn that has a phase of its own is shown by arrows
            arrow = direction in "lL" and {"G", "g"} <= {state[link] for state in world.signals[junction]}
            lights.append((junction, link, lane_id, stop_point, arrow))
    # 2. Their states, step by step.
    rows = []
    for step in range(len(ego_path)):
        for junction, link, lane_id, stop, arrow in lights:
            letter = world.signals[junction][start + step][link]
            rows.append((step, lane_id, _LIGHT_STATES.get(letter, _STOP)[arrow], *stop))
    return LightStates.of(rows)


def _label(view: _View, world: World, rng: np.random.Generator) -> Tracks:
    """Noisy, rounded tracks with heights; zero where not valid."""
    position, heading, velocity = view.position.copy(), view.heading.copy(), view.velocity.copy()
    # label noise, less and less of it the slower a body is; parked cars have none
    for k, body in enumerate(view.bodies):
        if not body.is_parked:
            noise = float(rng.gamma(1.6, 0.0078))  # m along the heading: median 10 mm, with a long tail
            position[k], heading[k], velocity[k] = add_label_noise(rng, noise, position[k], heading[k], velocity[k])
    if world.source is not None:  # what a planner sees of the others as they go on has no label noise
        future = slice(CURRENT_STEP + 1, None)
        position[:, future], heading[:, future] = view.position[:, future], view.heading[:, future]
        velocity[:, future] = view.velocity[:, future]
    size = np.array([body.size for body in view.bodies])
    z = world.cropper.ground.height_at(position) + size[:, None, 2] / 2
    heading = np.arctan2(np.sin(heading), np.cos(heading))
    valid = view.valid
    xy = on_grid(position * valid[..., None], POSITION_GRID_PER_M)
    return Tracks(
        object_id=np.cumsum(rng.integers(1, 9, len(view.bodies))).astype(np.int64),
        object_type=np.array([body.object_type for body in view.bodies], np.int8),
        position=np.concatenate([xy, on_grid(z * valid, HEIGHT_GRID_PER_M)[..., None]], axis=-1),
        heading=on_grid(heading * valid, HEADING_GRID_PER_RAD),
        velocity=on_grid(velocity * valid[..., None], VELOCITY_GRID_PER_MPS),
        size=on_grid(size[:, None] * valid[..., None], SIZE_GRID_PER_M),
        valid=valid,
    )


def _choose_egos(world: World, start: int, num_steps: int, rng: np.random.Generator) -> list[Body]:
    """At most two egos of a window, far apart, so that the scenarios share little."""
    # 1. Cars that exist throughout the window and keep away from the network's ends; moving ones are preferred.
    candidates, weights = [], []
    for body in world.bodies:
        index = start - body.first_step
        if body.object_type != ObjectType.VEHICLE or not body.is_evaluable or body.is_parked:
            continue
        if index < 0 or index + num_steps > body.num_steps:
            continue
        path = body.position[index : index + num_steps]
        if np.linalg.norm(path[::10, None] - world.ends[None], axis=-1).min() > EGO_TO_END_M:
            candidates.append(body)
            weights.append(6.0 if np.linalg.norm(path[-1] - path[0]) > 1.0 else 1.0)
    if not candidates:
        return []

    # 2. The first in a random order, and the next one that is far from it.
    probabilities = np.array(weights) / np.sum(weights)
    order = rng.choice(len(candidates), len(candidates), replace=False, p=probabilities)
    first = candidates[order[0]]
    current_step = start + CURRENT_STEP
    for index in order[1:]:
        second = candidates[index]
        gap = second.position[current_step - second.first_step] - first.position[current_step - first.first_step]
        if np.linalg.norm(gap) > EGO_TO_EGO_M:
            return [first, second]
    return [first]


def cut_window(world: World, start: int, num_steps: int, ego: Body, rng: np.random.Generator) -> Window | None:
    """Scenario of a window from the ego's view; None if the window fails a gate.

    Args:
        world: Simulated network with bodies, lights and map.
        start: Step of the recording at which the window begins.
        num_steps: Length of the window in steps of 0.1 s, at least 91.
        ego: Body that exists throughout the window.
        rng: Generator of all choices; equal states give equal scenarios.
    """
    range_m = float(rng.uniform(65.0, 95.0))
    view = _look(list(world.bodies), start, num_steps, ego, range_m, rng)
    drivable = world.cropper.network_map.drivable
    if not _passes_gates(view, rng) or not _is_on_road(view, len(view.bodies) - 1, drivable):
        return None
    predicted = choose_tracks_to_predict(view, rng, drivable)
    if len(predicted) < 2:
        return None
    # the map reaches beyond the range of vision, so that agents at its rim stand on lanes
    ego_path = view.position[-1]
    reach_m = range_m + ROAMING_MPS * STEP_S * (num_steps - TOTAL_STEPS)
    features = world.cropper.crop(ego_path[::6], reach_m + MAP_BEYOND_RANGE_M)
    # an id that is stable, and unlike those of other worlds
    name = f"{world.name}/{start}/{world.bodies.index(ego)}"
    scenario = Scenario(
        scenario_id=hashlib.sha256(name.encode()).hexdigest()[:16],
        timestamps_s=np.round(np.arange(num_steps) * STEP_S, 1),
        tracks=_label(view, world, rng),
        map_features=features,
        lights=_observe_lights(world, features, start, ego_path, reach_m),
        ego_index=len(view.bodies) - 1,
        tracks_to_predict=np.array(predicted, np.int32),
        difficulty=np.ones(len(predicted), np.int8),
        objects_of_interest=np.zeros(0, np.int64),
        source="synthetic",
    )
    return Window(scenario, start, view.bodies)


def cut_windows(world: World, rng: np.random.Generator, num_steps: int = TOTAL_STEPS) -> Iterator[Window]:
    """Windows of a world in random order, without windows that fail a gate.

    No two scenarios overlap in time and position.

    Args:
        world: Simulated network with bodies, lights and map.
        rng: Generator of all choices; equal states give equal scenarios.
        num_steps: Length of a window in steps of 0.1 s, at least 91.
    """
    every = num_steps + GAP_STEPS
    starts = rng.permutation(np.arange(FIRST_START, world.num_steps - num_steps, every))
    for start in starts.tolist():
        for ego in _choose_egos(world, start, num_steps, rng):
            window = cut_window(world, start, num_steps, ego, rng)
            if window is not None:
                yield window


LOTS_PER_STREET = {"city": 0.35, "quiet": 0.22, "freeway": 0.0}
_NUM_STEPS = round((sumo.SIMULATED_S - sumo.DISCARDED_S) / STEP_S)


def simulate_world(network_type: str, seed: tuple[int, ...], folder: Path, keeps_source: bool = False) -> World:
    """Draw a network, let SUMO fill it with traffic, and turn the output into bodies, lights and a map.

    Args:
        network_type: Type of the network, "city", "quiet" or "freeway".
        seed: Seed of all choices; the same seed and version of SUMO give the same world.
        folder: Existing folder for SUMO's files; the caller deletes the files.
        keeps_source: True = the world holds what SUMO needs to run it again, and boxes are made from the past alone.

    Raises:
        ConfigError: SUMO is not installed.
        RlftsimError: A program of SUMO failed.
    """
    # One generator for all steps: the order of steps is part of a seed's meaning.
    rng = np.random.default_rng(seed)

    # 1. Streets.
    plan = draw_freeway_plan(rng) if network_type == "freeway" else draw_city_plan(rng, quiet=network_type == "quiet")
    layout = "opposites" if rng.random() < 0.75 else "incoming"
    network_file = sumo.compile_network(plan, folder, layout)
    network = read_network(network_file, plan)

    # 2. Traffic. An additional file makes SUMO write every junction's signal states.
    types = write_demand(plan, rng, folder / "demand.xml")
    sumo_seed = int(rng.integers(1, 2**31 - 1))
    routes = sumo.route_demand(network_file, folder / "demand.xml", sumo_seed)
    signal_files = {junction: folder / f"signals_{junction}.xml" for junction in network.lights}
    events = [f'<timedEvent type="SaveTLSStates" source="{k}" dest="{path}"/>' for k, path in signal_files.items()]
    additional = folder / "additional.xml"
    additional.write_text("\n".join(["<additional>", *events, "</additional>"]))
    vehicles_file, persons_file = sumo.simulate(network_file, routes, additional, sumo_seed)

    # 3. Map and bodies.
    network_map = build_network_map(network)
    bodies = read_vehicles(vehicles_file, network, types, rng, keeps_source)
    bodies += read_pedestrians(persons_file, rng, keeps_source)
    bodies += park_in_strips(rng, network, _NUM_STEPS)
    bodies += park_in_lots(rng, network, network_map.drivable, _NUM_STEPS, LOTS_PER_STREET[network_type])
    cropper = MapCropper(network_map, draw_ground(rng))
    signals = {junction: read_signals(path) for junction, path in signal_files.items()}
    ends = np.stack([node.position for node in plan.fringe_nodes])
    # other boxes than those of the same seed without a source, so other ids
    name = "/".join(map(str, (*seed, "source")[: len(seed) + keeps_source]))
    source = SumoSource(network_file.read_text(), routes.read_text(), sumo_seed) if keeps_source else None
    return World(name, tuple(bodies), cropper, signals, ends, _NUM_STEPS, source)
