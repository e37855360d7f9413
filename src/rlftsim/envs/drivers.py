"""Drivers of agents: a rule for each, the first match wins."""

from collections.abc import Mapping
from enum import IntEnum
from typing import Literal, get_args

import numpy as np
from jaxtyping import Int64

from rlftsim.envs.scene import Scene
from rlftsim.errors import ConfigError, in_short
from rlftsim.scenario.types import ObjectType


class Driver(IntEnum):
    """Source of an agent's motion."""

    PLANNER = 0
    """Actions from outside."""
    POLICY = 1
    """The traffic model."""
    REPLAY = 2
    """Its log: it holds its pose in a gap, and is gone after the last state."""
    CONSTANT_VELOCITY = 3
    IDM = 4
    """The intelligent driver model along the way of its log, for vehicles alone; all others follow the policy."""


Traffic = Literal["policy", "replay", "constant_velocity", "idm"]
"""Drivers that a whole scene may have besides the planner."""
TRAFFIC = get_args(Traffic)
GROUPS = {
    "vehicles": ObjectType.VEHICLE,
    "pedestrians": ObjectType.PEDESTRIAN,
    "cyclists": ObjectType.CYCLIST,
}
Rules = Mapping[str | int, str]
"""Agents -> driver, the first match wins: "ego", "vehicles", "pedestrians", "cyclists", "tracks_to_predict", "*", or an
object id."""


def drivers_of(scene: Scene, rules: Rules) -> Int64[np.ndarray, "A"]:
    """Driver of each agent of a scenario, as numbers of `Driver`.

    Args:
        scene: the scenario.
        rules: agents to driver; an agent that no rule names follows the policy.

    Raises:
        ConfigError: no such group, agent or driver.
    """
    found = np.full(len(scene.object_id), -1)
    for who, name in rules.items():
        if name not in ("planner", *TRAFFIC):
            raise ConfigError(f"driver {in_short(name)} of {who!r}: known are planner, {', '.join(TRAFFIC)}.")
        named = _members(scene, who) & (found < 0)
        found[named] = Driver[name.upper()]
        if name == "idm":
            found[named & (scene.object_type != ObjectType.VEHICLE)] = Driver.POLICY
    return np.where(found < 0, Driver.POLICY, found)


def _members(scene: Scene, who: str | int) -> np.ndarray:
    if who == "*":
        return np.ones(len(scene.object_id), bool)
    if who == "ego":
        return np.arange(len(scene.object_id)) == scene.ego
    if who == "tracks_to_predict":
        return np.isin(scene.scenario.simulated_indices, scene.scenario.tracks_to_predict)
    if who in GROUPS:
        return scene.object_type == GROUPS[str(who)]
    if isinstance(who, int) and scene.row_of(who) is not None:
        return scene.object_id == who
    listed = ", ".join(map(str, scene.object_id[:12]))
    raise ConfigError(
        f"drivers of {who!r}: scenario {scene.scenario.scenario_id} has no such agents: name ego, tracks_to_predict, "
        f"{', '.join(GROUPS)}, '*' or one of {listed}."
    )
