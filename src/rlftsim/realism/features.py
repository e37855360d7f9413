"""What is measured of rollouts and of the log: one typed set of per-step features.

`ScenarioLog` holds everything that depends on the scenario alone; it is built once per scenario and device.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rlftsim.errors import ConfigError, DataError
from rlftsim.realism.agents import (
    LoggedAgents,
    SimulatedStates,
    Trajectories,
    build_logged_agents,
    join_history,
)
from rlftsim.realism.displacement import compute_displacement_error
from rlftsim.realism.interactive import (
    PlanarAgents,
    compute_distance_to_nearest_object,
    compute_time_to_collision,
)
from rlftsim.realism.kinematic import compute_ground_speed, compute_kinematics, shrink_validity
from rlftsim.realism.map_based import (
    RoadEdges,
    build_road_edges,
    compute_distance_to_road_edge,
)
from rlftsim.realism.traffic_lights import Signals, build_signals, compute_traffic_light_violation
from rlftsim.scenario.types import CURRENT_STEP, FUTURE_STEPS, HISTORY_STEPS, Scenario

MissingMap = Literal["error", "neutral"]

HISTORY_USED = 2
"""Logged steps that future features depend on: an acceleration at the first future step reaches two steps back."""
INVALID_ROAD_EDGE_M = -1e10
"""Distance to the road edge reported where an agent is invalid; also everywhere in a scenario without road edges."""


@dataclass(frozen=True)
class ComputeConfig:
    """How much is held in memory at once. Changes no result."""

    max_pairs: int | None = None
    """Pairs (of agents, of a point and a road edge, ...) measured at once, about 40 bytes each; None: 2^17 on a CPU,
    where they then stay in its cache, and 2^24 elsewhere."""

    def __post_init__(self) -> None:
        if self.max_pairs is not None and self.max_pairs < 1:
            raise ConfigError(f"max_pairs must be at least 1, got {self.max_pairs}.")

    def pairs_on(self, device: torch.device) -> int:
        """The bound for a device."""
        return self.max_pairs or (1 << 17 if device.type == "cpu" else 1 << 24)


DEFAULT_COMPUTE = ComputeConfig()


@dataclass(frozen=True, eq=False)
class Features:
    """Features of the evaluated agents at the 80 future steps, N rollouts (1 for the log); m, s, rad.

    Kinematic values are NaN at the last step (speeds) or last two (accelerations).
    """

    linear_speed: Float[Tensor, "N E T"]
    linear_acceleration: Float[Tensor, "N E T"]
    angular_speed: Float[Tensor, "N E T"]
    angular_acceleration: Float[Tensor, "N E T"]
    distance_to_nearest_object: Float[Tensor, "N E T"]
    """Negative for overlap."""
    time_to_collision: Float[Tensor, "N E T"]
    distance_to_road_edge: Float[Tensor, "N E T"]
    """Negative on the road."""
    traffic_light_violation: Bool[Tensor, "N E T"]
    displacement_error: Float[Tensor, "N E"]
    """Mean 3D distance to the log, see `compute_displacement_error`."""
    valid: Bool[Tensor, "N E T"]
    """The log's own validity; True everywhere for rollouts."""
    repeat: int = 1
    """Each rollout stands for this many identical ones."""

    @property
    def collision(self) -> Bool[Tensor, "N E T"]:
        """Whether an agent overlaps another one."""
        return self.distance_to_nearest_object < 0

    @property
    def offroad(self) -> Bool[Tensor, "N E T"]:
        """Whether a corner of an agent is off the road."""
        return self.distance_to_road_edge > 0

    @property
    def speed_valid(self) -> Bool[Tensor, "N E T"]:
        """Where speeds count: both neighbouring future steps are valid."""
        return shrink_validity(self.valid)

    @property
    def acceleration_valid(self) -> Bool[Tensor, "N E T"]:
        """Where accelerations count."""
        return shrink_validity(self.speed_valid)


@dataclass(frozen=True, eq=False)
class ScenarioLog:
    """What the metric needs of a scenario, on one device."""

    scenario_id: str
    agents: LoggedAgents
    road_edges: RoadEdges | None
    signals: Signals | None
    features: Features
    """Of the log, N = 1."""


def build_scenario_log(
    scenario: Scenario,
    device: torch.device | str = "cpu",
    *,
    missing_map: MissingMap = "error",
    compute: ComputeConfig = DEFAULT_COMPUTE,
) -> ScenarioLog:
    """Everything of the metric that depends on the scenario alone: agents, packed map, log features.

    Args:
        scenario: A scenario with its future.
        device: Where the tensors go.
        missing_map: Without road edges raise, as the official evaluator does, or count log and rollouts as on the road.
        compute: Memory bound.

    Raises:
        DataError: no recorded future, nobody to evaluate, or no road edges.
    """
    device = torch.device(device)
    agents = build_logged_agents(scenario, device)
    road_edges = build_road_edges(scenario.map_features, device)
    if road_edges is None and missing_map == "error":
        raise DataError(
            f"Scenario {scenario.scenario_id} has no road edge, so the distance to it is undefined: leave the scenario "
            'out, or pass missing_map="neutral" to count everybody as on the road.'
        )
    signals = build_signals(scenario.map_features, scenario.lights, device)
    log = Trajectories(*(values[None] for values in agents.trajectories.fields))
    with torch.no_grad():
        features = _measure(log, agents, road_edges, signals, is_log=True, max_pairs=compute.pairs_on(device))
    return ScenarioLog(scenario.scenario_id, agents, road_edges, signals, features)


@lru_cache(maxsize=64)
def _cached_scenario_log(
    scenario: Scenario, device: torch.device, missing_map: MissingMap, compute: ComputeConfig
) -> ScenarioLog:
    return build_scenario_log(scenario, device, missing_map=missing_map, compute=compute)


def scenario_log(
    scenario: Scenario,
    device: torch.device | str = "cpu",
    *,
    missing_map: MissingMap = "error",
    compute: ComputeConfig = DEFAULT_COMPUTE,
) -> ScenarioLog:
    """`build_scenario_log`, remembered for the last 64 scenarios (by identity)."""
    return _cached_scenario_log(scenario, torch.device(device), missing_map, compute)


def compute_features(
    log: ScenarioLog, states: SimulatedStates, *, compute: ComputeConfig = DEFAULT_COMPUTE
) -> Features:
    """Features of rollouts, on their device, which must be the log's.

    Raises:
        DataError: the rollouts' agents are not the scenario's simulated agents.
    """
    with torch.no_grad():
        joined = join_history(log.agents, states, HISTORY_USED, log.scenario_id)
        max_pairs = compute.pairs_on(states.device)
        features = _measure(joined, log.agents, log.road_edges, log.signals, is_log=False, max_pairs=max_pairs)
    return Features(**{**vars(features), "repeat": states.repeat})


def _measure(
    trajectories: Trajectories,
    agents: LoggedAgents,
    road_edges: RoadEdges | None,
    signals: Signals | None,
    *,
    is_log: bool,
    max_pairs: int,
) -> Features:
    """Features of trajectories [N, A, history + 80], whose history ends with the current step."""
    evaluated = trajectories.of_agents(agents.evaluated)
    kinematics = compute_kinematics((evaluated.x, evaluated.y, evaluated.z), evaluated.heading)
    nearest, time_to_collision = _measure_interaction(trajectories, agents, is_log=is_log, max_pairs=max_pairs)
    future = evaluated.from_step(-FUTURE_STEPS)
    valid = agents.future_valid if is_log else torch.ones_like(agents.future_valid)
    valid = valid.expand(future.x.shape)
    return Features(
        **{name: values[..., -FUTURE_STEPS:] for name, values in kinematics._asdict().items()},
        distance_to_nearest_object=nearest,
        time_to_collision=time_to_collision,
        distance_to_road_edge=_measure_road_edge(future, agents, road_edges, valid, max_pairs),
        traffic_light_violation=_measure_lights(evaluated, signals, valid, max_pairs),
        displacement_error=_measure_displacement(future, agents),
        valid=valid,
    )


def _measure_interaction(
    trajectories: Trajectories, agents: LoggedAgents, *, is_log: bool, max_pairs: int
) -> tuple[Float[Tensor, "N E T"], Float[Tensor, "N E T"]]:
    """Distance to the nearest object and time to collision, a few rollouts at a time."""
    speed = compute_ground_speed(trajectories.x, trajectories.y)[..., -FUTURE_STEPS:]
    future = trajectories.from_step(-FUTURE_STEPS)
    num_agents, num_evaluated = len(agents.object_id), len(agents.evaluated)
    rollouts_at_once = max(1, max_pairs // (num_agents * num_evaluated * FUTURE_STEPS))
    log_valid = agents.valid[None, :, -FUTURE_STEPS:] if is_log else None
    length, width = agents.size[:, 0], agents.size[:, 1]
    nearest, seconds = [], []
    parts = zip(*(values.split(rollouts_at_once) for values in (future.x, future.y, future.heading, speed)))
    for x, y, heading, part_speed in parts:
        boxes = PlanarAgents(x, y, heading, length, width, agents.evaluated, log_valid)
        nearest.append(compute_distance_to_nearest_object(boxes))
        seconds.append(compute_time_to_collision(boxes, part_speed))
    return torch.cat(nearest), torch.cat(seconds)


def _measure_road_edge(
    future: Trajectories,
    agents: LoggedAgents,
    road_edges: RoadEdges | None,
    valid: Bool[Tensor, "N E T"],
    max_pairs: int,
) -> Float[Tensor, "N E T"]:
    if road_edges is None:
        return torch.full_like(future.x, INVALID_ROAD_EDGE_M)
    size = agents.size.index_select(0, agents.evaluated)
    # An invalid state may lie anywhere (mostly at the origin): it is not worth a search.
    current = agents.trajectories.of_agents(agents.evaluated)
    filled = Trajectories(
        *(
            torch.where(valid, values, here[:, CURRENT_STEP, None])
            for values, here in zip(future.fields, current.fields)
        )
    )
    distance = compute_distance_to_road_edge(filled, size, road_edges, max_pairs=max_pairs)
    return torch.where(valid, distance, INVALID_ROAD_EDGE_M)


def _measure_lights(
    evaluated: Trajectories, signals: Signals | None, valid: Bool[Tensor, "N E T"], max_pairs: int
) -> Bool[Tensor, "N E T"]:
    if signals is None:
        return torch.zeros_like(valid)
    with_current = evaluated.from_step(-FUTURE_STEPS - 1)
    return compute_traffic_light_violation(
        with_current.x, with_current.y, valid, signals, first_step=HISTORY_STEPS - 1, max_pairs=max_pairs
    )


def _measure_displacement(future: Trajectories, agents: LoggedAgents) -> Float[Tensor, "N E"]:
    logged = agents.trajectories.of_agents(agents.evaluated).from_step(-FUTURE_STEPS)
    return compute_displacement_error(
        torch.stack([future.x, future.y, future.z], dim=-1),
        torch.stack([logged.x, logged.y, logged.z], dim=-1),
        agents.valid.index_select(0, agents.evaluated),
    )
