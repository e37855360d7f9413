"""Variants of a scenario that policies must handle: moved, emptied, crowded, with agents that appear late."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rlftsim.geometry import wrapped
from rlftsim.scenario.types import CURRENT_STEP, HISTORY_STEPS, LightStates, MapFeatures, Scenario

EXACT_TURN_RAD = float(np.arctan2(4.0, 3.0))
"""53.13 degrees: sine 4/5 and cosine 3/5 are short fractions, so rotated grid points stay exact in float32."""
GRID_M = 5 / 4096


def move_scenario(scenario: Scenario, turn_rad: float, shift_m: tuple[float, float]) -> Scenario:
    """The same scenario turned counter-clockwise about its `origin`, then shifted.

    Args:
        scenario: Scenario to move; the log, the map and the lights move together.
        turn_rad: Angle of the turn, counter-clockwise.
        shift_m: Shift in x and y, world frame; whole meters keep float32 coordinates as exact as before.
    """
    # in float64, rounded once at the end
    center = np.append(scenario.origin, 0.0)
    cos, sin = np.cos(turn_rad), np.sin(turn_rad)
    matrix = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    shift = np.append(np.asarray(shift_m, np.float64), 0.0)

    def moved(points: np.ndarray) -> np.ndarray:
        return ((points.astype(np.float64) - center) @ matrix.T + center + shift).astype(np.float32)

    heading = wrapped(scenario.tracks.heading.astype(np.float64) + turn_rad).astype(np.float32)
    velocity = (scenario.tracks.velocity.astype(np.float64) @ matrix[:2, :2].T).astype(np.float32)
    return _move_points(scenario, moved, heading=heading, velocity=velocity)


def _move_points(scenario: Scenario, transform: Callable[[np.ndarray], np.ndarray], **tracks: np.ndarray) -> Scenario:
    """The scenario with all points transformed, and further fields of the tracks replaced."""
    features, lights = scenario.map_features, scenario.lights
    return replace(
        scenario,
        tracks=replace(scenario.tracks, position=transform(scenario.tracks.position), **tracks),
        map_features=replace(features, points=transform(features.points), polygon_rest=None),
        lights=replace(lights, stop_point=transform(lights.stop_point)),
    )


def without_future(scenario: Scenario) -> Scenario:
    """The same scenario as in a test split: tracks and lights end at the current step."""
    return scenario.window(0, HISTORY_STEPS)


def place_on_grid(scenario: Scenario) -> Scenario:
    """The same scenario at the world's origin, coordinates rounded to 5/4096 m (1.2 mm).

    Such coordinates stay exact in float32 when turned by 90 degrees or by `EXACT_TURN_RAD` and shifted by some hundreds
    of whole meters, so that scores of a policy differ by the policy's rounding alone.
    """
    central = move_scenario(scenario, 0.0, (-float(scenario.origin[0]), -float(scenario.origin[1])))

    # multiples of 5/4096 times 3/5 or 4/5 are multiples of 1/4096, which float32 has exactly below 4 km
    def rounded(points: np.ndarray) -> np.ndarray:
        return (np.round(points / GRID_M) * GRID_M).astype(np.float32)

    return _move_points(central, rounded)


def edge_scenes(scenario: Scenario) -> dict[str, Scenario]:
    """Edge cases made of a scenario, by name. All keep the ego."""
    ego_alone = _with_tracks(scenario, np.array([scenario.ego_index]))
    no_lights, no_map = LightStates.of([]), MapFeatures.of([])
    return {
        "one agent": ego_alone,
        "one agent, no map, no lights": replace(ego_alone, map_features=no_map, lights=no_lights),
        "no map": replace(scenario, map_features=no_map, lights=no_lights),
        "no lights": replace(scenario, lights=no_lights),
        "128 agents": _crowded(scenario, 128),
        "agents first seen at the current step": _with_late_agents(scenario, CURRENT_STEP),
        "agents first seen at step 7": _with_late_agents(scenario, 7),
        "an agent that is never valid": _with_absent_agent(scenario),
        "NaN wherever a state is not valid": _with_nan(scenario),
    }


def _with_tracks(scenario: Scenario, indices: np.ndarray) -> Scenario:
    """Some of the tracks, in the given order; only the ego is evaluated."""
    return replace(
        scenario,
        tracks=scenario.tracks.select(indices),
        ego_index=int(np.flatnonzero(indices == scenario.ego_index)[0]),
        tracks_to_predict=scenario.tracks_to_predict[:0],
        difficulty=scenario.difficulty[:0],
        objects_of_interest=scenario.objects_of_interest[:0],
    )


def _crowded(scenario: Scenario, num_agents: int) -> Scenario:
    """The ego and copies of all agents, shifted on a grid of 3.1 m x 3.3 m, `num_agents` in all."""
    indices = np.append(scenario.ego_index, np.resize(scenario.simulated_indices, num_agents - 1))
    crowd = _with_tracks(scenario, indices)
    # 11 columns; copies of different agents may overlap, which policies have to accept
    rows = np.arange(num_agents, dtype=np.float32)
    shift = np.stack([rows % 11 * 3.1, rows // 11 * 3.3, 0 * rows], -1)[:, None]
    ids = np.arange(1, num_agents + 1, dtype=np.int64)
    return replace(crowd, tracks=replace(crowd.tracks, object_id=ids, position=crowd.tracks.position + shift))


def _with_late_agents(scenario: Scenario, step: int) -> Scenario:
    """The scenario with all agents but the ego invalid before a step."""
    valid = scenario.tracks.valid.copy()
    valid[np.arange(len(valid)) != scenario.ego_index, :step] = False
    return replace(scenario, tracks=replace(scenario.tracks, valid=valid))


def _with_absent_agent(scenario: Scenario) -> Scenario:
    """The scenario with a further track, without a single valid step."""
    rows = np.append(np.arange(len(scenario.tracks.valid)), scenario.ego_index)
    tracks = _with_tracks(scenario, rows).tracks
    # a copy of the ego's track, with a new id
    valid, ids = tracks.valid.copy(), tracks.object_id.copy()
    valid[-1], ids[-1] = False, ids.max() + 1
    return replace(scenario, tracks=replace(tracks, valid=valid, object_id=ids))


def _with_nan(scenario: Scenario) -> Scenario:
    """The scenario with every second agent not valid at steps 3 and 4 of the history, and NaN in all such states."""
    tracks = scenario.tracks
    valid = tracks.valid.copy()
    valid[np.delete(np.arange(len(valid)), scenario.ego_index)[::2], 3:5] = False

    def emptied(values: np.ndarray) -> np.ndarray:
        return np.where(valid[(..., *[None] * (values.ndim - 2))], values, np.float32(np.nan))

    filled = {name: emptied(getattr(tracks, name)) for name in ("position", "heading", "velocity", "size")}
    return replace(scenario, tracks=replace(tracks, valid=valid, **filled))
