"""Goals of a file placed into scenarios: impossible goals are refused, doubtful goals get a warning."""

from collections.abc import Sequence

import numpy as np

from rlftsim.errors import DataError
from rlftsim.goals.attainment import NEAR_M
from rlftsim.goals.goals_file import GoalEntry
from rlftsim.goals.lane_paths import BRISK, HORIZON_S
from rlftsim.goals.types import Goals, goals_at, simulated_track
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import CURRENT_STEP, HISTORY_STEPS, ObjectType, Scenario

FASTEST_MPS = 60.0
"""A goal that takes a higher average speed is refused."""
TOP_MPS = {ObjectType.PEDESTRIAN: 2.5, ObjectType.CYCLIST: 8.0}
"""Speeds that few pedestrians and cyclists exceed; vehicles are bounded by acceleration."""
STANDING_MPS = 0.3


def find_track(entry: GoalEntry, scenario: Scenario) -> int:
    """Index of the track of the agent that an entry gives a goal.

    Args:
        entry: Goal of an agent in this scenario.
        scenario: Scenario of the entry, with the agent's current position.

    Raises:
        DataError: No such agent, or an agent that is not simulated, or a goal out of reach of any vehicle.
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
        entry: Goal of the agent, world frame.
        scenario: Scenario of the entry, with the agent's current position.
        track: Index of the agent's track in the scenario.
    """
    x, y = scenario.tracks.position[track, CURRENT_STEP, :2].astype(np.float64)
    return float(np.hypot(entry.x - x, entry.y - y))


def goal_warnings(entry: GoalEntry, scenario: Scenario) -> tuple[str, ...]:
    """Reasons to expect that a goal will not be followed as meant, a line each; empty for an ordinary goal.

    Args:
        entry: Goal of an agent in this scenario.
        scenario: Scenario of the entry, with the agent's history.

    Raises:
        DataError: The goal is impossible by the rules of `find_track`.
    """
    track = find_track(entry, scenario)
    tracks, distance = scenario.tracks, distance_m(entry, scenario, track)
    agent_type = ObjectType(int(tracks.object_type[track]))
    speeds = np.linalg.norm(tracks.velocity[track, :HISTORY_STEPS], axis=-1)  # [11], m/s
    speed = float(speeds[CURRENT_STEP])
    agent = f"{entry}: agent {entry.agent_id} ({agent_type.name.lower()}, {speed:.1f} m/s)"
    warnings = []
    if distance <= NEAR_M:
        warnings.append(
            f"{agent} is within {NEAR_M:g} m of its goal already: it counts as passed whatever the agent does."
        )
    # The whole history of 1.1 s counts, not the current step alone: an agent that has just stopped is not parked.
    elif speeds[tracks.valid[track, :HISTORY_STEPS]].max() < STANDING_MPS:
        warnings.append(
            f"{agent} stands still, perhaps parked, and its goal is {distance:.0f} m away: it may stay, or set off "
            "unlike any parked vehicle in the data."
        )
    # Mean speed under brisk constant acceleration; an agent that is faster already may stay so.
    top_speed = max(speed, TOP_MPS.get(agent_type, speed + BRISK.acceleration_mps2 * HORIZON_S / 2))
    if distance > top_speed * HORIZON_S + NEAR_M:
        warnings.append(
            f"{agent} would need {distance / HORIZON_S:.1f} m/s on average to get to its goal {distance:.0f} m away: "
            "it will most likely stop short of it."
        )
    return tuple(warnings)


def goals_of_batch(entries: Sequence[GoalEntry], batch: ScenarioBatch) -> Goals:
    """Goals that some entries give to the agents of a batch, for a single rollout, in the frame of the batch.

    Args:
        entries: Goals, at most one for each agent; goals in further scenarios are ignored.
        batch: Scenarios whose agents get the goals.

    Raises:
        DataError: An entry of a scenario in the batch is impossible by the rules of `find_track`.
    """
    points = {}
    for scenario in batch.scenarios:
        scenario_entries = [entry for entry in entries if entry.scenario_id == scenario.scenario_id]
        ids = [scenario.tracks.object_id[find_track(entry, scenario)] for entry in scenario_entries]
        positions = np.array([(entry.x, entry.y) for entry in scenario_entries], np.float64).reshape(-1, 2)
        points[scenario.scenario_id] = np.array(ids, np.int64), positions
    return goals_at(points, batch)
