"""Drivers of agents: a rule for each, the first match wins."""

from collections.abc import Mapping
from enum import IntEnum
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Int64

from rlftsim.envs.scene import Scene
from rlftsim.errors import ConfigError, in_short
from rlftsim.rollout.entries import EntryModel, load_entries
from rlftsim.rollout.open_world import check_decisions
from rlftsim.rollout.policy import Policy
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
    """The intelligent driver model along its logged path, for vehicles alone; other agents follow the policy."""
    SUMO = 5
    """The drivers who made a synthetic log, in the log's world run again; for all agents but the ego."""


Traffic = Literal["policy", "replay", "constant_velocity", "idm", "sumo"]
"""Drivers that a whole scene may have besides the planner."""
TRAFFIC = get_args(Traffic)
GROUPS = {"vehicles": ObjectType.VEHICLE, "pedestrians": ObjectType.PEDESTRIAN, "cyclists": ObjectType.CYCLIST}
Rules = Mapping[str | int, str]
"""Agents -> driver, the first match wins: "ego", "vehicles", "pedestrians", "cyclists", "tracks_to_predict", "*", or an
object id."""


def assign_drivers(scene: Scene, rules: Rules) -> Int64[np.ndarray, "A"]:
    """Driver of each agent of a scenario, as numbers of `Driver`.

    Args:
        scene: Scene whose simulated agents get a driver each.
        rules: Agents to driver, the first match wins; an agent that no rule names follows the policy.

    Raises:
        ConfigError: No such group, agent or driver, or SUMO for some agents but not for all but the ego.
    """
    drivers = np.full(len(scene.object_id), -1)
    for group, name in rules.items():
        if name not in ("planner", *TRAFFIC):
            raise ConfigError(f"driver {in_short(name)} of {group!r}: known are planner, {', '.join(TRAFFIC)}.")
        is_matched = _find_members(scene, group) & (drivers < 0)
        drivers[is_matched] = Driver[name.upper()]
        if name == "idm":
            drivers[is_matched & (scene.object_type != ObjectType.VEHICLE)] = Driver.POLICY
    drivers[drivers < 0] = Driver.POLICY
    if "sumo" in rules.values():
        sumo_drivers = np.delete(drivers, scene.ego)
        if drivers[scene.ego] != Driver.PLANNER or (sumo_drivers != Driver.SUMO).any():
            raise ConfigError(
                "SUMO drives all agents but the ego, which the planner drives: leave out other drivers, or take other "
                "traffic."
            )
    return drivers


def _find_members(scene: Scene, group: str | int) -> Bool[np.ndarray, "A"]:
    """True for the agents that the left side of a rule names."""
    if group == "*":
        return np.ones(len(scene.object_id), bool)
    if group == "ego":
        return np.arange(len(scene.object_id)) == scene.ego
    if group == "tracks_to_predict":
        return np.isin(scene.scenario.simulated_indices, scene.scenario.tracks_to_predict)
    if group in GROUPS:
        return scene.object_type == GROUPS[str(group)]
    if isinstance(group, int) and group in scene.object_id:
        return scene.object_id == group
    ids = ", ".join(map(str, scene.object_id[:12]))
    raise ConfigError(
        f"drivers of {group!r}: scenario {scene.scenario.scenario_id} has no such agents: name ego, tracks_to_predict, "
        f"{', '.join(GROUPS)}, '*' or one of {ids}."
    )


def load_open_traffic(entries: str | None, rules: Rules, policy: Policy | None) -> EntryModel | None:
    """Model of who enters the traffic; None = nobody enters or leaves.

    Args:
        entries: Name of the model, see `EnvConfig.entries`.
        rules: Agents to driver, the first match wins.
        policy: Traffic model; None where no agent follows one.

    Raises:
        ConfigError: Agents that do not follow the policy, groups of agents that a planner drives, decisions of another
            length than half a second, or no such model.
    """
    if entries is None:
        return None
    groups = {driver for who, driver in rules.items() if who in GROUPS or who == "*"}
    if policy is None or groups != {"policy"} or not {*rules.values()} <= {"planner", "policy"}:
        raise ConfigError(
            f"entries={entries} needs traffic that follows the policy, and a planner whose agents are named one by "
            "one: leave out other drivers, or entries."
        )
    check_decisions(policy.steps_per_decision)
    return load_entries(entries)
