"""A scenario's row in the index of a data set: counts and the maneuver of the ego."""

from dataclasses import dataclass

import numpy as np

from rlftsim.scenario.maneuver import Maneuver, classify_turn
from rlftsim.scenario.types import CURRENT_STEP, ObjectType, Scenario

AGENT_COLUMNS = ("num_vehicles", "num_pedestrians", "num_cyclists", "num_others")
"""Counts that add up to a scenario's simulated agents."""
_STATIONARY_SPEED_MPS = 2.0
_STATIONARY_DISTANCE_M = 5.0


@dataclass(frozen=True)
class IndexRow:
    """One scenario's row of the index. Agents are the tracks valid at the current step."""

    scenario_id: str
    split: str
    num_steps: int
    num_vehicles: int
    num_pedestrians: int
    num_cyclists: int
    num_others: int
    num_evaluated: int
    num_map_features: int
    num_map_points: int
    num_light_states: int
    ego_maneuver: str
    source: str = Scenario.source
    guessed: str = ""
    """Words of `Scenario.guessed` in alphabetical order, with spaces between them."""


def compute_index_row(scenario: Scenario, split: str) -> IndexRow:
    """Row of a scenario in the index of a data set.

    Args:
        scenario: Scenario whose agents are counted at the current step.
        split: Name of the split that the scenario belongs to, such as "training".
    """
    agent_types = scenario.tracks.object_type[scenario.simulated_indices]
    count = {object_type: int((agent_types == object_type).sum()) for object_type in ObjectType}
    return IndexRow(
        scenario_id=scenario.scenario_id,
        split=split,
        num_steps=scenario.num_steps,
        num_vehicles=count[ObjectType.VEHICLE],
        num_pedestrians=count[ObjectType.PEDESTRIAN],
        num_cyclists=count[ObjectType.CYCLIST],
        num_others=count[ObjectType.OTHER] + count[ObjectType.UNSET],
        num_evaluated=len(scenario.evaluated_indices),
        num_map_features=len(scenario.map_features),
        num_map_points=len(scenario.map_features.points),
        num_light_states=len(scenario.lights.step),
        ego_maneuver=classify_ego_maneuver(scenario).value,
        source=scenario.source,
        guessed=" ".join(sorted(scenario.guessed)),
    )


def classify_ego_maneuver(scenario: Scenario) -> Maneuver:
    """Maneuver of the ego's logged track from the current step to its last valid step.

    Stationary: never faster than 2 m/s and it ends within 5 m. Else by the change of heading, turned continuously:
    below 30 degrees straight (lane changes too), from 135 degrees a U-turn, in between left (counter-clockwise) or
    right.
    """
    tracks, ego = scenario.tracks, scenario.ego_index
    steps = CURRENT_STEP + np.flatnonzero(tracks.valid[ego, CURRENT_STEP:])
    if not scenario.has_future or len(steps) < 2:
        return Maneuver.UNKNOWN
    distance_m = np.linalg.norm(tracks.position[ego, steps[-1], :2] - tracks.position[ego, steps[0], :2])
    # both conditions: a slow car in a queue gets away, and a fast one may come back to its start
    with np.errstate(over="ignore"):  # a velocity of 1e38 m/s is none, and its length is infinite
        top_speed_mps = np.linalg.norm(tracks.velocity[ego, steps], axis=-1).max()
    if top_speed_mps < _STATIONARY_SPEED_MPS and distance_m < _STATIONARY_DISTANCE_M:
        return Maneuver.STATIONARY
    # unwrapped, so that a turn through pi counts as the small turn it is
    heading = np.unwrap(tracks.heading[ego, steps].astype(np.float64))
    maneuver = classify_turn(float(heading[-1] - heading[0]))
    return Maneuver.UTURN if maneuver in (Maneuver.LEFT_UTURN, None) else maneuver
