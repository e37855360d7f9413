"""Goals of a file placed into scenarios: impossible ones are refused, doubtful ones get a warning."""

from collections.abc import Sequence

import numpy as np

from rlftsim.errors import DataError
from rlftsim.goals.attainment import NEAR_M
from rlftsim.goals.goals_file import GoalEntry
from rlftsim.goals.maneuvers.reach import BRISK, HORIZON_S
from rlftsim.goals.types import Goals, goals_at, simulated_track
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import CURRENT_STEP, HISTORY_STEPS, ObjectType, Scenario

FASTEST_MPS = 60.0
"""A goal that takes a higher average speed is refused."""
TOP_MPS = {ObjectType.PEDESTRIAN: 2.5, ObjectType.CYCLIST: 8.0}
"""Speeds that few of these exceed; vehicles are bounded by their acceleration."""
STANDING_MPS = 0.3


def track_of(entry: GoalEntry, scenario: Scenario) -> int:
    """Track of the agent that an entry gives a goal.

    Args:
        entry: a goal in this scenario.
        scenario: its scenario.

    Raises:
        DataError: there is no such agent, it is not simulated, or the goal is farther than anything drives.
    """
    track = simulated_track(scenario, entry.agent_id, str(entry))
    distance = distance_m(entry, scenario, track)
    if distance > FASTEST_MPS * HORIZON_S:
        x, y = scenario.tracks.position[track, CURRENT_STEP, :2]
        raise DataError(
            f"{entry}: ({entry.x:.1f}, {entry.y:.1f}) is {distance:.0f} m from agent {entry.agent_id} at "
            f"({x:.1f}, {y:.1f}), out of reach in {HORIZON_S:g} s: x and y are meters in the world frame of the log."
        )
    return track


def distance_m(entry: GoalEntry, scenario: Scenario, track: int) -> float:
    """Distance from an agent's current position to a goal, m.

    Args:
        entry: the goal.
        scenario: its scenario.
        track: index of the agent's track.
    """
    x, y = scenario.tracks.position[track, CURRENT_STEP, :2].astype(np.float64)
    return float(np.hypot(entry.x - x, entry.y - y))


def goal_warnings(entry: GoalEntry, scenario: Scenario) -> tuple[str, ...]:
    """Reasons to expect that a goal will not be followed as meant, a line each; empty for an ordinary goal.

    Args:
        entry: a goal in this scenario.
        scenario: its scenario.

    Raises:
        DataError: the goal is impossible, see `track_of`.
    """
    track = track_of(entry, scenario)
    tracks, distance = scenario.tracks, distance_m(entry, scenario, track)
    kind = ObjectType(int(tracks.object_type[track]))
    speeds = np.linalg.norm(tracks.velocity[track, :HISTORY_STEPS], axis=-1)  # [11], m/s
    speed = float(speeds[CURRENT_STEP])
    agent = f"{entry}: agent {entry.agent_id} ({kind.name.lower()}, {speed:.1f} m/s)"
    found = []
    if distance <= NEAR_M:
        found.append(
            f"{agent} is within {NEAR_M:g} m of its goal already: it counts as passed whatever the agent does."
        )
    # The whole history of 1.1 s counts, not the current step alone: an agent that has just stopped is not parked.
    elif speeds[tracks.valid[track, :HISTORY_STEPS]].max() < STANDING_MPS:
        found.append(
            f"{agent} stands still, perhaps parked, and its goal is {distance:.0f} m away: it may stay, or set off "
            "unlike any parked vehicle in the data."
        )
    # Mean speed under brisk constant acceleration; an agent that is faster already may stay so.
    top = max(speed, TOP_MPS.get(kind, speed + BRISK.acceleration_mps2 * HORIZON_S / 2))
    if distance > top * HORIZON_S + NEAR_M:
        found.append(
            f"{agent} would need {distance / HORIZON_S:.1f} m/s on average to get to its goal {distance:.0f} m away: "
            "it will most likely stop short of it."
        )
    return tuple(found)


def goals_of_batch(entries: Sequence[GoalEntry], batch: ScenarioBatch) -> Goals:
    """Goals that some entries give to the agents of a batch, for a single rollout, in the frame of the batch.

    Args:
        entries: goals, at most one for each agent; those of other scenarios are ignored.
        batch: the scenarios.

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
