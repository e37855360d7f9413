"""Features of rollouts and of the log: a typed set of quantities per step.

`ScenarioLog` has all that depends on the scenario alone, computed once per scenario and device.

Speeds, accelerations and displacement follow the official evaluator of 2025 (Waymo Open Sim Agents Challenge), in
float32 with a step of 0.1 s: central differences that ignore validity. A difference at step t needs t - 1 and t + 1 and
is NaN where either is missing: speeds lose a step at each end, accelerations two. The average displacement error (ADE)
is reported beside the meta-metric, without a weight there.
"""

from collections import deque
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Literal
from weakref import WeakValueDictionary

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from rlftsim.errors import ConfigError, DataError
from rlftsim.geometry import wrap_angle
from rlftsim.realism.agents import (
    LoggedAgents,
    SimulatedStates,
    Trajectories,
    build_logged_agents,
    join_agents,
    join_history,
    join_trajectories,
)
from rlftsim.realism.config import SIM_AGENTS, Challenge
from rlftsim.realism.interactive import PlanarAgents, compute_distance_to_nearest_object, compute_time_to_collision
from rlftsim.realism.map_based import RoadEdges, build_road_edges, compute_distance_to_road_edge, join_road_edges
from rlftsim.realism.rounding import compute_sqrt
from rlftsim.realism.traffic_lights import Signals, build_signals, compute_traffic_light_violation, join_signals
from rlftsim.scenario.types import CURRENT_STEP, STEP_S, TOTAL_STEPS, Scenario, cached_on_scenario


def compute_central_difference(values: Float[Tensor, "... T"]) -> Float[Tensor, "... T"]:
    """Half the difference between the next and the last step, per step; NaN at both ends."""
    difference = torch.full_like(values, float("nan"))
    difference[..., 1:-1] = (values[..., 2:] - values[..., :-2]) / 2
    return difference


def _compute_turn(angle: Float[Tensor, "... T"]) -> Float[Tensor, "... T"]:
    # The two-step difference is wrapped, not the one-step one, as officially: at most pi/2 per step is representable.
    return wrap_angle(2 * compute_central_difference(angle)) / 2


def compute_kinematics(
    position: tuple[Float[Tensor, "... T"], Float[Tensor, "... T"], Float[Tensor, "... T"]],
    heading: Float[Tensor, "... T"],
) -> dict[str, Float[Tensor, "... T"]]:
    """Linear and angular speed and acceleration of trajectories, m/s, m/s² (signed), rad/s, rad/s², by name.

    Args:
        position: x, y and z of the box center, m; the height counts, as officially.
        heading: Heading of the box, rad; differences are wrapped.
    """
    dx, dy, dz = (compute_central_difference(axis) for axis in position)
    linear_speed = compute_sqrt(dx * dx + dy * dy + dz * dz) / STEP_S
    turn = _compute_turn(heading)
    # Angular acceleration wraps the difference of the turns once more; it is not the difference of the angular speeds.
    return {
        "linear_speed": linear_speed,
        "linear_acceleration": compute_central_difference(linear_speed) / STEP_S,
        "angular_speed": turn / STEP_S,
        "angular_acceleration": _compute_turn(turn) / STEP_S**2,
    }


def compute_ground_speed(x: Float[Tensor, "... T"], y: Float[Tensor, "... T"]) -> Float[Tensor, "... T"]:
    """Speed in the plane, m/s, NaN at both ends; for time to collision, which ignores height.

    Args:
        x: First coordinate of the box center over time, m.
        y: Second coordinate of the box center over time, m.
    """
    dx, dy = compute_central_difference(x), compute_central_difference(y)
    return compute_sqrt(dx * dx + dy * dy) / STEP_S


def shrink_validity(valid: Bool[Tensor, "... T"]) -> Bool[Tensor, "... T"]:
    """True where both neighboring steps are valid, even if the step between is not; False at both ends.

    Applied to the future's validity once, the result is the mask of speeds; applied twice, that of accelerations.
    """
    shrunk = torch.zeros_like(valid)
    shrunk[..., 1:-1] = valid[..., 2:] & valid[..., :-2]
    return shrunk


def compute_displacement_error(
    rollout: Trajectories, log: Trajectories, valid: Bool[Tensor, "E S"]
) -> Float[Tensor, "N E"]:
    """Mean distance (3D, m) between rollout and log over the valid steps of the whole scenario.

    The history is the same on both sides: valid steps of the history count in the denominator only, so the value is
    about 80/91 of the error over the future (a rule of the official evaluator).

    Args:
        rollout: Simulated states [N, E, T] at the T future steps.
        log: Logged states [E, T] at the same steps.
        valid: Log validity at all S steps; the last T of the S steps are the future.
    """
    # Written out: the float32 sum of three squares in this order, without a reduction over a tiny axis.
    dx, dy, dz = rollout.x - log.x, rollout.y - log.y, rollout.z - log.z
    distance = compute_sqrt(dx * dx + dy * dy + dz * dz)  # [N, E, T]
    future_valid = valid[:, -distance.shape[-1] :]
    # where, not a product: an invalid logged state may be anything.
    return torch.where(future_valid, distance, 0.0).sum(-1) / valid.sum(-1)


MissingMap = Literal["error", "neutral"]

INVALID_ROAD_EDGE_M = -1e10
"""Distance to the road edge of invalid agents, as officially; also of all agents in a scenario without road edges."""
CACHED_LOGS = 64
"""Logs that stay in memory. Real ones take 0.25 to 0.8 MB, so those of a whole data set must not."""


@dataclass(frozen=True)
class ComputeConfig:
    """Bound on the memory of one computation. Changes no result."""

    max_pairs: int | None = None
    """Pairs (of agents, of a point and a road edge, ...) computed at once, about 40 bytes each; None: 2^17 on a CPU,
    whose cache holds so many, and 2^24 elsewhere."""

    def __post_init__(self) -> None:
        if self.max_pairs is not None and self.max_pairs < 1:
            raise ConfigError(f"max_pairs must be at least 1, got {self.max_pairs}.")

    def pairs_on(self, device: torch.device) -> int:
        """Pairs computed at once on a device."""
        return self.max_pairs or (1 << 17 if device.type == "cpu" else 1 << 24)


DEFAULT_COMPUTE = ComputeConfig()


@dataclass(frozen=True, eq=False)
class Features:
    """Features of the evaluated agents at the simulated steps, N rollouts (1 for the log); m, s, rad.

    Kinematic values are NaN at the last step (speeds) or last two (accelerations), of generated scenes at the first,
    too.
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
    """Mean 3D distance to the log, see `compute_displacement_error`; 0 for generated agents, which are nobody's."""
    valid: Bool[Tensor, "N E T"]
    """The log's own validity; True everywhere for rollouts."""
    repeat: int = 1
    """Number of identical rollouts behind each row."""

    @property
    def collision(self) -> Bool[Tensor, "N E T"]:
        """True where an agent overlaps a second agent."""
        return self.distance_to_nearest_object < 0

    @property
    def offroad(self) -> Bool[Tensor, "N E T"]:
        """True where a corner of an agent is off the road."""
        return self.distance_to_road_edge > 0

    @property
    def speed_valid(self) -> Bool[Tensor, "N E T"]:
        """Mask of speeds: both neighboring future steps are valid."""
        return shrink_validity(self.valid)

    @property
    def acceleration_valid(self) -> Bool[Tensor, "N E T"]:
        """Mask of accelerations: the mask of speeds, shrunk likewise."""
        return shrink_validity(self.speed_valid)


@dataclass(frozen=True, eq=False)
class Surroundings:
    """All that rollouts are measured against, of a scenario, or of several side by side, on a device."""

    agents: LoggedAgents
    road_edges: RoadEdges | None
    signals: Signals | None


@dataclass(frozen=True, eq=False)
class ScenarioLog(Surroundings):
    """Logged side of a scenario in the metric, on a device; holds no reference to the scenario."""

    scenario_id: str
    features: Features
    """Features of the log, N = 1."""

    @property
    def logs(self) -> "tuple[ScenarioLog, ...]":
        """The log itself, as the only entry."""
        return (self,)

    @property
    def leaves_road(self) -> Bool[Tensor, "E"]:
        """True = an evaluated agent that leaves the road at some logged step."""
        return (self.features.offroad & self.agents.future_valid).any(-1)[0]


@dataclass(frozen=True, eq=False)
class JoinedLogs(Surroundings):
    """The logs of several scenarios side by side: a device measures their rollouts in one go."""

    logs: tuple[ScenarioLog, ...]

    @classmethod
    def from_logs(cls, logs: Sequence[ScenarioLog]) -> "JoinedLogs":
        """Logs on the same device, side by side."""
        return cls(
            join_agents([log.agents for log in logs]),
            join_road_edges([log.road_edges for log in logs]),
            join_signals([log.signals for log in logs]),
            tuple(logs),
        )

    @property
    def leaves_road(self) -> Bool[Tensor, "E"]:
        """True = an evaluated agent that leaves the road at some logged step."""
        return torch.cat([log.leaves_road for log in self.logs])


AnyLog = ScenarioLog | JoinedLogs


def scenario_log(
    scenario: Scenario | ScenarioLog,
    device: torch.device | str = "cpu",
    *,
    missing_map: MissingMap = "error",
    compute: ComputeConfig = DEFAULT_COMPUTE,
    challenge: Challenge = SIM_AGENTS,
) -> ScenarioLog:
    """All that the metric computes from the scenario alone: agents, packed map, log features.

    The logs of the last 64 scenarios are cached. The cache does not keep the scenarios in memory.

    Args:
        scenario: Scenario with its logged future; a log is returned as given.
        device: Device of the tensors; rollouts must lie there to be scored.
        missing_map: Answer to a scenario without road edges: "error" raises, as the official evaluator does, "neutral"
            counts log and rollouts as on the road. Under "neutral" a log in which no future state of an evaluated agent
            is valid raises no error, either: the scores are NaN.
        compute: Bound on the memory of the computation; changes no result.
        challenge: Rules of the metric: evaluated agents and scored steps.

    Raises:
        DataError: No logged future, no evaluated agent, or no road edges.
    """
    if isinstance(scenario, ScenarioLog):
        return scenario
    device = torch.device(device)
    logs, key = _cached_logs(scenario), (device, missing_map, compute, challenge)
    log = logs.get(key)
    if log is None:
        log = logs[key] = _build_log(scenario, device, missing_map, compute.pairs_on(device), challenge)
    # Most recently used last; what falls out in front is forgotten by `_cached_logs`, too.
    if log in _recent_logs:
        _recent_logs.remove(log)
    _recent_logs.append(log)
    return log


_recent_logs: deque[ScenarioLog] = deque(maxlen=CACHED_LOGS)


@cached_on_scenario
def _cached_logs(scenario: Scenario) -> WeakValueDictionary[Hashable, ScenarioLog]:
    """Logs of a scenario that are still in memory, by device, answer to a missing map, and memory bound."""
    return WeakValueDictionary()


def _build_log(
    scenario: Scenario, device: torch.device, missing_map: MissingMap, max_pairs: int, challenge: Challenge
) -> ScenarioLog:
    agents = build_logged_agents(scenario, device, challenge)
    # Training goes on, where the reward counts as missing: its scores are NaN.
    if missing_map == "error" and not scenario.has_evaluated_future:
        raise DataError(
            f"Scenario {scenario.scenario_id} has no valid logged state of an evaluated agent after the current step: "
            "without its future it cannot be scored. Use training or validation data, or leave the scenario out."
        )
    road_edges = build_road_edges(scenario.map_features, device)
    if road_edges is None and missing_map == "error":
        raise DataError(
            f"Scenario {scenario.scenario_id} has no road edge, so the distance to it is undefined: leave the scenario "
            "out."
        )
    scene = Surroundings(agents, road_edges, build_signals(scenario.map_features, scenario.lights, device))
    # [1, A, 91]: to the features the log is a rollout whose history is all logged steps up to the current one.
    log = Trajectories(*(values[None] for values in agents.trajectories))
    with torch.no_grad():
        features = _measure(scene, log, agents.size[None], is_log=True, max_pairs=max_pairs)
    return ScenarioLog(**vars(scene), scenario_id=scenario.scenario_id, features=features)


@torch.no_grad()
def compute_features(
    log: AnyLog, states: SimulatedStates | Sequence[SimulatedStates], *, compute: ComputeConfig = DEFAULT_COMPUTE
) -> Features:
    """Features of rollouts, on the log's device, where the rollouts must be, too.

    Args:
        log: Logged side of the scenario, or of several: the evaluated agents of all are then side by side on axis E.
        states: N rollouts of the scenario, or of each scenario; N and repeat are the same for all.
        compute: Bound on the memory of the computation; changes no result.

    Raises:
        DataError: The agents of the rollouts are not the scenario's simulated agents, or rollouts of another challenge.
    """
    states = [states] if isinstance(states, SimulatedStates) else states
    histories = [join_history(scene.agents, s, scene.scenario_id) for scene, s in zip(log.logs, states)]
    trajectories, size = histories[0]  # [N, A, 82], [N, A, T, 3]
    if len(histories) > 1:
        trajectories = join_trajectories([history for history, _ in histories])
        size = torch.cat([sizes for _, sizes in histories], 1)
    features = _measure(log, trajectories, size, is_log=False, max_pairs=compute.pairs_on(states[0].device))
    return replace(features, repeat=states[0].repeat)


def _measure(
    scene: Surroundings, trajectories: Trajectories, size: Float[Tensor, "#N A #T 3"], *, is_log: bool, max_pairs: int
) -> Features:
    """Features of trajectories [N, A, history + T] with a history that ends with the current step, if any."""
    agents = scene.agents
    num_steps = agents.challenge.num_steps
    evaluated = trajectories.select_agents(agents.evaluated)  # [N, E, history + T]
    future = evaluated.from_step(-num_steps)  # [N, E, T]
    # Rollouts count as valid at every step, wherever the log is.
    valid = agents.future_valid if is_log else torch.ones_like(agents.future_valid)
    valid = valid.expand(future.x.shape)
    # 1. Kinematics need the history for their differences; the rest is cut to the future.
    kinematics = compute_kinematics((evaluated.x, evaluated.y, evaluated.z), evaluated.heading)
    # 2. Other agents.
    # The log of a scene counts as present where it is not: what the file stores there is in the way of the others.
    masks_log = is_log and not agents.challenge.makes_scenes
    nearest, time_to_collision = _compute_interaction(agents, trajectories, size, masks_log, max_pairs)
    # 3. Traffic lights: a crossing at the first future step compares with the current step. A scene's first step has
    #    no step before, and none is crossed there.
    with_current = evaluated.from_step(-num_steps - 1)
    violation = torch.zeros_like(valid)
    if scene.signals is not None:
        first_step = TOTAL_STEPS - with_current.x.shape[-1]
        violation = compute_traffic_light_violation(
            with_current.x, with_current.y, valid[..., 1 - with_current.x.shape[-1] :], scene.signals,
            first_step=first_step, max_pairs=max_pairs, scenario=agents.layout and agents.layout.scenario,
        )  # fmt: skip
        violation = F.pad(violation, (num_steps - violation.shape[-1], 0))
    # 4. Displacement from the log.
    if agents.challenge.makes_scenes:
        displacement = future.x.new_zeros(future.x.shape[:2])
    else:
        logged = agents.trajectories.select_agents(agents.evaluated).from_step(-num_steps)
        displacement = compute_displacement_error(future, logged, agents.valid.index_select(0, agents.evaluated))
    return Features(
        **{name: values[..., -num_steps:] for name, values in kinematics.items()},
        distance_to_nearest_object=nearest,
        time_to_collision=time_to_collision,
        distance_to_road_edge=_compute_road_edge(scene, future, size, valid, max_pairs),
        traffic_light_violation=violation,
        displacement_error=displacement,
        valid=valid,
        repeat=1,
    )


def _compute_interaction(
    agents: LoggedAgents, trajectories: Trajectories, size: Float[Tensor, "#N A #T 3"], masks_log: bool, max_pairs: int
) -> tuple[Float[Tensor, "N E T"], Float[Tensor, "N E T"]]:
    """Distance to the nearest object and time to collision, some rollouts at a time."""
    num_steps = agents.challenge.num_steps
    speed = compute_ground_speed(trajectories.x, trajectories.y)[..., -num_steps:]
    future = trajectories.from_step(-num_steps)
    neighbors, mask = (agents.layout.neighbors, agents.layout.neighbor_mask) if agents.layout else (None, None)
    num_neighbors = len(agents.object_id) if neighbors is None else neighbors.shape[1]
    chunk_size = max(1, max_pairs // (num_neighbors * len(agents.evaluated) * num_steps))
    log_valid = agents.valid[None, :, -num_steps:] if masks_log else None  # [1, A, T]
    size = size.expand(len(speed), -1, -1, -1)
    distances, seconds = [], []
    arrays = (future.x, future.y, future.heading, size, speed)
    for x, y, heading, box_size, chunk_speed in zip(*(values.split(chunk_size) for values in arrays)):
        length, width, _ = box_size.unbind(-1)
        boxes = PlanarAgents(x, y, heading, length, width, agents.evaluated, log_valid, neighbors, mask)
        distances.append(compute_distance_to_nearest_object(boxes))
        seconds.append(compute_time_to_collision(boxes, chunk_speed))
    return torch.cat(distances), torch.cat(seconds)


def _compute_road_edge(
    scene: Surroundings,
    future: Trajectories,
    size: Float[Tensor, "#N A #T 3"],
    valid: Bool[Tensor, "N E T"],
    max_pairs: int,
) -> Float[Tensor, "N E T"]:
    agents, edges = scene.agents, scene.road_edges
    if edges is None:
        return torch.full_like(future.x, INVALID_ROAD_EDGE_M)
    # Invalid states may lie anywhere (mostly at the origin), far from every edge, where the search is slow. They take
    # the current position instead; their distance is overwritten below.
    current = agents.trajectories.select_agents(agents.evaluated)
    states = Trajectories(*(torch.where(valid, x, log[:, CURRENT_STEP, None]) for x, log in zip(future, current)))
    scenario = agents.layout and agents.layout.scenario
    size = size.index_select(1, agents.evaluated)
    distance = compute_distance_to_road_edge(states, size, edges, max_pairs=max_pairs, scenario=scenario)
    if scenario is not None and edges.has_edges is not None:
        valid = valid & edges.has_edges[scenario, None]
    return torch.where(valid, distance, INVALID_ROAD_EDGE_M)
