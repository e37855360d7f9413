"""Positions, heights, velocities and headings of logged tracks held against each other.

The four are redundant, so a log in another frame, unit or time base contradicts itself. A single track may, because
detections are noisy; a scenario does where more than half of the moving tracks do.
"""

import math

import numpy as np
from jaxtyping import Bool, Int64

from rlftsim.scenario.types import STEP_S, ObjectType, Tracks

MIN_STEPS = 10
"""Steps that a track must move to be judged; of these more than half must agree."""
MOVING_MPS = 1.0
SPEED_TOLERANCE_MPS, SPEED_TOLERANCE = 1.0, 0.3
"""Largest difference between a velocity and the change of position, or this fraction of the faster one. Beyond are 0 of
187 moving tracks of WOMD, 0 of 2 657 synthetic ones and 7 of 32 of Argoverse 2, whose positions are noisy."""
TYPES_WITH_FRONT = (ObjectType.VEHICLE, ObjectType.CYCLIST)
DRIVING_MPS = 3.0
"""Vehicles and cyclists that are faster face the way they move; slower ones may back up, and pedestrians step aside."""
MIN_COSINE = math.cos(math.pi / 4)


def describe_contradictions(tracks: Tracks) -> str:
    """Contradictions of most moving tracks, in words with the first such track; empty where no track does.

    Args:
        tracks: All tracks of a scenario, world frame; states that are not valid are left out.
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
        medians = (float(np.median(speed[track, steps])) for speed in (moved_mps, said_mps, off_mps))
        by_position, by_velocity, difference = medians
        texts.append(
            f"velocities contradict the change of positions in {len(contrary)} of {num_judged} moving tracks: track "
            f"{tracks.object_id[track]} moves at {by_position:.1f} m/s, its velocity is {by_velocity:.1f} m/s and "
            f"{difference:.1f} m/s off"
        )
    contrary, num_judged = find_contrary(is_driving, is_askew)
    if 2 * len(contrary) > num_judged:
        texts.append(
            f"headings contradict the motion of {len(contrary)} of {num_judged} vehicles and cyclists faster than "
            f"{DRIVING_MPS:g} m/s: track {tracks.object_id[contrary[0]]} faces more than 45 degrees away from it"
        )
    contrary, num_judged = find_contrary(is_driving, climb_mps > moved_mps)
    if 2 * len(contrary) > num_judged:
        track = contrary[0]
        texts.append(
            f"heights contradict the motion of {len(contrary)} of {num_judged} vehicles and cyclists faster than "
            f"{DRIVING_MPS:g} m/s: track {tracks.object_id[track]} climbs or falls at "
            f"{float(np.median(climb_mps[track, is_driving[track]])):.1f} m/s, more than 45 degrees"
        )
    return "; ".join(texts)


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
