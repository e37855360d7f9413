"""Positions, velocities, headings and heights of logged tracks held against each other, and against the map.

The four are redundant, so a log in another frame, unit or time base contradicts itself. A single track may, because
detections are noisy; a scenario does where more than half of the moving tracks do.
"""

import math
from collections.abc import Collection, Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int64
from scipy.spatial import KDTree

from rlftsim.scenario.polylines import find_runs
from rlftsim.scenario.types import STEP_S, MapFeatures, ObjectType, Tracks

MIN_STEPS = 10
"""Steps that a track must move to be judged; of these more than half must agree."""
MOVING_MPS = 1.0
SPEED_TOLERANCE_MPS, SPEED_TOLERANCE = 1.0, 0.3
"""Largest difference between a velocity and the change of position, or this fraction of the faster one. Beyond are 0 of
187 moving tracks of WOMD, 0 of 2 657 synthetic ones and 7 of 32 of Argoverse 2, whose positions are noisy."""
TYPES_WITH_FRONT = (ObjectType.VEHICLE, ObjectType.CYCLIST)
DRIVING_MPS = 3.0
"""Vehicles and cyclists that are faster face the way they move; slower ones may back up, and pedestrians step aside."""
MOVERS, DRIVERS = "moving tracks", f"vehicles and cyclists faster than {DRIVING_MPS:g} m/s"
MAX_ASKEW_DEG = 20.0
"""Between heading and motion, median over a track. Of 4 589 real tracks faster than 2 m/s 3 are beyond, of 2 374
synthetic ones none; the median track of each of their scenarios is at most 8.1 degrees off. Of 515 paths that
`demo-base` simulates the worst is 6.3 off."""
MIN_COSINE = math.cos(math.radians(MAX_ASKEW_DEG))
BACKING_S = 1.0
"""Longest time for which a vehicle or cyclist faster than 3 m/s backs up; 2 of 4 913 real ones do so for longer."""
MAX_JUMP_M, MAX_CLIMB_M = 5.0, 2.0
"""In 0.1 s; no track of 573 real and synthetic scenarios climbs or falls by more than 0.8."""
MAX_SAMPLES = 100
"""Points between two of a feature; a longer gap is a mistake."""
MAP_RADIUS_M, MAX_RISE_M = 10.0, 5.0
"""A track is off the map's heights where all its points within 10 m are more than 5 m above or below; in the same
scenarios none is off by more than 4.1."""


def describe_contradictions(
    tracks: Tracks, map_features: MapFeatures | None = None, guessed: Collection[str] = ()
) -> str:
    """Contradictions of most moving tracks, in words with the first such track; empty where no track does.

    Args:
        tracks: All tracks of a scenario, world frame; states that are not valid are left out.
        map_features: Map of the same frame, whose heights are held against those of tracks; None = there is none.
        guessed: What the source of the scenario makes up, as in `Scenario.guessed`; heights "z" are not judged then.
    """
    is_observed = tracks.valid[:, 1:] & tracks.valid[:, :-1]  # [O, S-1]
    with np.errstate(invalid="ignore", over="ignore"):  # states that are not valid may hold infinities
        x, y = np.ascontiguousarray(np.moveaxis(tracks.position[..., :2], -1, 0))  # each [O, S]
        vx, vy = np.ascontiguousarray(np.moveaxis(tracks.velocity, -1, 0))
        dx, dy = ((p[:, 1:] - p[:, :-1]) / np.float32(STEP_S) for p in (x, y))
        mx, my = ((v[:, 1:] + v[:, :-1]) / np.float32(2) for v in (vx, vy))
        moved_mps, said_mps, off_mps = np.hypot(dx, dy), np.hypot(mx, my), np.hypot(dx - mx, dy - my)
        faster = np.maximum(moved_mps, said_mps)
        is_off = off_mps > np.maximum(SPEED_TOLERANCE_MPS, SPEED_TOLERANCE * faster)
        heading = tracks.heading[:, 1:]
        is_askew = dx * np.cos(heading) + dy * np.sin(heading) < MIN_COSINE * moved_mps
        climb_mps = np.abs(np.diff(tracks.position[..., 2])) / np.float32(STEP_S)
    has_front = np.isin(tracks.object_type, TYPES_WITH_FRONT)
    is_moving = is_observed & (2 * (is_observed & (faster > MOVING_MPS)).sum(1) > is_observed.sum(1))[:, None]
    is_driving = is_observed & (moved_mps > DRIVING_MPS) & has_front[:, None]
    texts = []
    contrary, num_judged = find_contrary(is_moving, is_off)
    if 2 * len(contrary) > num_judged:
        track = contrary[0]
        steps = is_moving[track] & is_off[track]
        position, velocity, off = (float(np.median(speed[track, steps])) for speed in (moved_mps, said_mps, off_mps))
        motion = f"moves at {position:.1f} m/s, its velocity is {velocity:.1f} m/s and {off:.1f} m/s off"
        conflict = "velocities contradict the change of positions in"
        texts.append(_describe(conflict, contrary, num_judged, MOVERS, tracks, motion))
    contrary, num_judged = find_contrary(is_driving, is_askew)
    if 2 * len(contrary) > num_judged:
        motion = f"faces more than {MAX_ASKEW_DEG:g} degrees away from it"
        texts.append(_describe("headings contradict the motion of", contrary, num_judged, DRIVERS, tracks, motion))
    elif 2 * len(backing := [track for track, _ in find_backing(tracks)]) > num_judged > 1:
        motion = f"backs up for more than {BACKING_S:g} s"
        texts.append(_describe("headings contradict the motion of", backing, num_judged, DRIVERS, tracks, motion))
    texts += _describe_jumps("positions", "moves", np.where(is_observed, moved_mps * STEP_S, 0.0), MAX_JUMP_M, tracks)
    if "z" in guessed:
        return "; ".join(texts)
    contrary, num_judged = find_contrary(is_driving, climb_mps > moved_mps)
    if 2 * len(contrary) > num_judged:
        median_mps = float(np.median(climb_mps[contrary[0], is_driving[contrary[0]]]))
        motion = f"climbs or falls at {median_mps:.1f} m/s, more than 45 degrees"
        texts.append(_describe("heights contradict the motion of", contrary, num_judged, DRIVERS, tracks, motion))
    climb_m = np.where(is_observed, climb_mps * STEP_S, 0.0)
    texts += _describe_jumps("heights (z)", "climbs or falls by", climb_m, MAX_CLIMB_M, tracks)
    texts += _describe_heights(tracks, map_features, is_moving)
    return "; ".join(texts)


def _describe(
    conflict: str,
    contrary: Sequence[int] | Int64[np.ndarray, "n"],
    num_judged: int,
    group: str,
    tracks: Tracks,
    cause: str,
) -> str:
    """Conflict of most tracks of a group, with what the first of them does."""
    return f"{conflict} {len(contrary)} of {num_judged} {group}: track {tracks.object_id[contrary[0]]} {cause}"


def find_backing(tracks: Tracks) -> list[tuple[int, int]]:
    """Vehicles and cyclists that drive against their heading for longer than `BACKING_S`, with the first step of it."""
    with np.errstate(invalid="ignore", over="ignore"):  # states that are not valid may hold infinities
        dx, dy = np.moveaxis(np.diff(tracks.position[..., :2], axis=1) / np.float32(STEP_S), -1, 0)  # each [O, S-1]
        heading = tracks.heading[:, 1:]
        is_backing = (dx * np.cos(heading) + dy * np.sin(heading) < 0) & (np.hypot(dx, dy) > DRIVING_MPS)
    is_backing &= tracks.valid[:, 1:] & tracks.valid[:, :-1] & np.isin(tracks.object_type, TYPES_WITH_FRONT)[:, None]
    longest = round(BACKING_S / STEP_S)
    runs = {track: find_runs(is_backing[track]) for track in np.flatnonzero(is_backing.sum(1) > longest).tolist()}
    starts = {track: [start for start, stop in run.tolist() if stop - start > longest] for track, run in runs.items()}
    return [(track, steps[0]) for track, steps in starts.items() if steps]


def _describe_jumps(
    name: str, motion: str, change_m: Float[np.ndarray, "O s"], limit_m: float, tracks: Tracks
) -> Iterator[str]:
    """Values that jump in most tracks; those of fewer are findings of `inspect.find_problems`.

    Args:
        name: Name of the values.
        motion: Verb of a track that jumps.
        change_m: Change from each step to the next; 0 where it was not observed.
        limit_m: Largest change that is no jump.
        tracks: All tracks of a scenario.
    """
    jumps = np.argwhere(change_m > limit_m)
    num_jumping, num_judged = len(set(jumps[:, 0])), int((tracks.valid[:, 1:] & tracks.valid[:, :-1]).any(1).sum())
    if 2 * num_jumping > num_judged > 1:
        track, step = jumps[0]
        yield (
            f"{name} jump in {num_jumping} of {num_judged} tracks: track {tracks.object_id[track]} {motion} "
            f"{change_m[track, step]:.1f} m from step {step} to {step + 1}"
        )


def _describe_heights(
    tracks: Tracks, map_features: MapFeatures | None, is_moving: Bool[np.ndarray, "O s"]
) -> Iterator[str]:
    """Heights of most moving tracks that are not the map's."""
    points = np.zeros((0, 3)) if map_features is None else _sample_points(map_features)
    position = tracks.position[:, 1:]
    is_judged = is_moving & np.isfinite(position).all(-1)
    if not len(points) or not is_judged.any():
        return
    # In units of both limits a point of the map that is near in height, too, is at most 1 away along each axis.
    unit = np.array([MAP_RADIUS_M, MAP_RADIUS_M, MAX_RISE_M])
    is_off = is_judged.copy()
    is_off[is_judged] = np.isinf(_search(points / unit, position[is_judged] / unit))
    if is_off.any():  # or nothing is near in the plane, either
        is_judged[is_off] = np.isfinite(_search(points[:, :2] / MAP_RADIUS_M, position[is_off][:, :2] / MAP_RADIUS_M))
        is_off &= is_judged
    contrary, num_judged = find_contrary(is_judged, is_off)
    if 2 * len(contrary) > num_judged:
        track = contrary[0]
        first = position[track, is_off[track].argmax()]
        height = points[KDTree(points[:, :2]).query(first[:2])[1], 2]
        position = f"is at {first[2]:.1f} m, the map there at {height:.1f} m"
        yield _describe("heights (z) contradict the map near", contrary, num_judged, MOVERS, tracks, position)


def _sample_points(map_features: MapFeatures) -> Float[np.ndarray, "n 3"]:
    """Points of the map, and further ones where two of a feature are more than 10 m apart."""
    points = map_features.points.astype(np.float64)
    ends = map_features.offsets[1:] - 1
    with np.errstate(invalid="ignore"):  # points that are not finite are left out at last
        steps = np.diff(points, axis=0, append=points[-1:])
        steps[ends[ends >= 0]] = 0.0
        length_m = np.hypot(steps[:, 0], steps[:, 1])
        count = np.nan_to_num(np.ceil(length_m / MAP_RADIUS_M)).clip(1, MAX_SAMPLES).astype(np.int64)
        index = np.repeat(np.arange(len(points)), count)
        first = np.repeat(np.cumsum(count) - count, count)
        points = points[index] + ((np.arange(len(index)) - first) / count[index])[:, None] * steps[index]
    return points[np.isfinite(points).all(1)]


def _search(points: Float[np.ndarray, "n c"], states: Float[np.ndarray, "m c"]) -> Float[np.ndarray, "m"]:
    """Largest offset along an axis to the nearest point; infinite where it is more than 1."""
    tree = KDTree(points, compact_nodes=False, balanced_tree=False)
    return np.asarray(tree.query(states, p=math.inf, distance_upper_bound=1.0)[0])


def find_contrary(
    is_judged: Bool[np.ndarray, "O s"], is_contrary: Bool[np.ndarray, "O s"]
) -> tuple[Int64[np.ndarray, "n"], int]:
    """Tracks that contradict themselves in most of the steps in which they are judged, and how many are judged.

    Args:
        is_judged: True = the track is judged at the step; fewer than `MIN_STEPS` steps are too few for a judgment.
        is_contrary: True = the track contradicts the log's other values at the step.
    """
    num_steps = is_judged.sum(1)
    is_enough = num_steps >= MIN_STEPS
    return np.flatnonzero(is_enough & (2 * (is_judged & is_contrary).sum(1) > num_steps)), int(is_enough.sum())
