"""What the index of a data set says about a scenario: counts and the manoeuvre of the ego."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from rlftsim.scenario.types import CURRENT_STEP, ObjectType, Scenario

_STATIONARY_SPEED_MPS = 2.0
_STATIONARY_DISTANCE_M = 5.0
_STRAIGHT_RAD = np.radians(30.0)
_UTURN_RAD = np.radians(135.0)


class Manoeuvre(StrEnum):
    """What the ego does from the current step to the end of its record."""

    STRAIGHT = "straight"
    LEFT = "left"
    RIGHT = "right"
    UTURN = "uturn"
    STATIONARY = "stationary"
    UNKNOWN = "unknown"
    """The future is withheld, or the ego is not valid in it."""


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
    ego_manoeuvre: str


def compute_index_row(scenario: Scenario, split: str) -> IndexRow:
    """Row of `scenario` in the index of a data set."""
    agent_types = scenario.tracks.object_type[scenario.simulated_indices]
    count = {kind: int((agent_types == kind).sum()) for kind in ObjectType}
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
        ego_manoeuvre=classify_ego_manoeuvre(scenario).value,
    )


def classify_ego_manoeuvre(scenario: Scenario) -> Manoeuvre:
    """What the ego's logged track does from the current step to its last valid one.

    Stationary: never faster than 2 m/s and it ends within 5 m. Else by the change of heading, turned continuously:
    below 30 degrees straight (lane changes too), from 135 degrees a U-turn, in between left (counter-clockwise) or
    right.
    """
    tracks, ego = scenario.tracks, scenario.ego_index
    steps = CURRENT_STEP + np.flatnonzero(tracks.valid[ego, CURRENT_STEP:])
    if not scenario.has_future or len(steps) < 2:
        return Manoeuvre.UNKNOWN
    distance_m = np.linalg.norm(tracks.position[ego, steps[-1], :2] - tracks.position[ego, steps[0], :2])
    top_speed_mps = np.linalg.norm(tracks.velocity[ego, steps], axis=-1).max()
    if top_speed_mps < _STATIONARY_SPEED_MPS and distance_m < _STATIONARY_DISTANCE_M:
        return Manoeuvre.STATIONARY
    heading = np.unwrap(tracks.heading[ego, steps].astype(np.float64))
    turn = heading[-1] - heading[0]
    if abs(turn) < _STRAIGHT_RAD:
        return Manoeuvre.STRAIGHT
    if abs(turn) >= _UTURN_RAD:
        return Manoeuvre.UTURN
    return Manoeuvre.LEFT if turn > 0 else Manoeuvre.RIGHT
