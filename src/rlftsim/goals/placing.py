"""Goals of a file put into scenarios: who is asked, whether that can be, and what is doubtful about it."""

from collections.abc import Sequence

import numpy as np

from rlftsim.errors import DataError
from rlftsim.goals.attainment import NEAR_M
from rlftsim.goals.goals_file import GoalEntry
from rlftsim.goals.reach import BRISK, HORIZON_S
from rlftsim.goals.types import Goals, goals_at
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import CURRENT_STEP, HISTORY_STEPS, ObjectType, Scenario

FASTEST_MPS = 60.0
"""Nobody is faster on average."""
TOP_MPS = {ObjectType.PEDESTRIAN: 2.5, ObjectType.CYCLIST: 8.0}
"""Faster than that are few; vehicles are bounded by their acceleration."""
STANDING_MPS = 0.3
LISTED = 12


def track_of(entry: GoalEntry, scenario: Scenario) -> int:
    """Track of the agent that is asked.

    Raises:
        DataError: there is no such agent, nobody simulates it, or nobody gets there.
    """
    tracks = scenario.tracks
    found = np.flatnonzero(tracks.object_id == entry.agent_id)
    simulated = scenario.simulated_indices
    if not len(found):
        ids = sorted(tracks.object_id[simulated].tolist())
        listed = ", ".join(str(i) for i in ids[:LISTED]) + (", ..." if len(ids) > LISTED else "")
        raise DataError(
            f"{entry}: scenario {scenario.scenario_id} has no agent {entry.agent_id}: it simulates {len(ids)} agents: {listed}."
        )
    if found[0] not in simulated:
        raise DataError(
            f"{entry}: agent {entry.agent_id} is not there at the current step of scenario {scenario.scenario_id}, so nobody "
            "simulates it: ask another one."
        )
    away = distance_m(entry, scenario, int(found[0]))
    if away > FASTEST_MPS * HORIZON_S:
        x, y = tracks.position[found[0], CURRENT_STEP, :2]
        raise DataError(
            f"{entry}: ({entry.x:.1f}, {entry.y:.1f}) is {away:.0f} m from agent {entry.agent_id} at ({x:.1f}, {y:.1f}), nobody gets "
            f"there in {HORIZON_S:g} s: x and y are metres in the world frame of the record."
        )
    return int(found[0])


def distance_m(entry: GoalEntry, scenario: Scenario, track: int) -> float:
    """From where a track is at the current step to the goal."""
    x, y = scenario.tracks.position[track, CURRENT_STEP, :2].astype(np.float64)
    return float(np.hypot(entry.x - x, entry.y - y))


def doubts(entry: GoalEntry, scenario: Scenario) -> tuple[str, ...]:
    """What will most likely happen otherwise than it was asked for, a line each.

    Raises:
        DataError: the goal is impossible, see `track_of`.
    """
    track = track_of(entry, scenario)
    tracks, away = scenario.tracks, distance_m(entry, scenario, track)
    kind = ObjectType(int(tracks.object_type[track]))
    speeds = np.linalg.norm(tracks.velocity[track, :HISTORY_STEPS], axis=-1)
    speed, who = (
        float(speeds[CURRENT_STEP]),
        f"{entry}: agent {entry.agent_id} ({kind.name.lower()}, {speeds[-1]:.1f} m/s)",
    )
    found = []
    if away <= NEAR_M:
        found.append(f"{who} is within {NEAR_M:g} m of its goal already: the goal is passed whatever it does.")
    elif speeds[tracks.valid[track, :HISTORY_STEPS]].max() < STANDING_MPS:
        found.append(
            f"{who} stands still, perhaps parked, and is asked to go {away:.0f} m: it may stay, or set off in a way that nothing parked does."
        )
    top = max(speed, TOP_MPS.get(kind, speed + BRISK.acceleration_mps2 * HORIZON_S / 2))
    if away > top * HORIZON_S + NEAR_M:
        found.append(
            f"{who} would need {away / HORIZON_S:.1f} m/s on average to get to its goal {away:.0f} m away: it will most likely "
            "stay short of it."
        )
    return tuple(found)


def goals_of_batch(entries: Sequence[GoalEntry], batch: ScenarioBatch) -> Goals:
    """The goals that a batch's agents have among some entries, for a single rollout, in the frame of the batch.

    Raises:
        DataError: an entry of one of these scenarios is impossible, see `track_of`.
    """
    points = {}
    for scenario in batch.scenarios:
        own = [entry for entry in entries if entry.scenario_id == scenario.scenario_id]
        ids = [scenario.tracks.object_id[track_of(entry, scenario)] for entry in own]
        places = [(entry.x, entry.y) for entry in own]
        points[scenario.scenario_id] = np.array(ids, np.int64), np.array(places, np.float64).reshape(-1, 2)
    return goals_at(points, batch)
