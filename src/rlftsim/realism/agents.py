"""Simulated and evaluated agents of the metric: their states in rollouts and in the log. Frame: world.

Simulated agents are all tracks valid at the current step, in track order; no other agent exists for the metric.
Evaluated ones are the ego and the tracks to predict, by ascending object id. Sizes and types are those of the current
step for all steps, in the log too.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Int64
from torch import Tensor

from rlftsim.errors import DataError
from rlftsim.scenario.types import CURRENT_STEP, FUTURE_STEPS, TOTAL_STEPS, ObjectType, Scenario


@dataclass(frozen=True, eq=False)
class SimulatedStates:
    """Future states of one scenario's simulated agents in N rollouts, world frame, float32, one device.

    Every agent exists at all T = 80 steps. Agents may come in any order, named by `object_id`.
    """

    object_id: Int[np.ndarray, "A"]
    """On the host: matching agents must not wait for a device."""
    x: Float[Tensor, "N A T"]
    y: Float[Tensor, "N A T"]
    z: Float[Tensor, "N A T"]
    heading: Float[Tensor, "N A T"]
    repeat: int = 1
    """Number of identical rollouts that each one represents: 32 equal rollouts are scored at the cost of one."""

    def way_of(self, object_id: int) -> Float[Tensor, "N T 2"]:
        """Simulated positions of one agent, m."""
        row = int(np.flatnonzero(self.object_id == object_id)[0])
        return torch.stack([self.x[:, row], self.y[:, row]], -1)

    def __post_init__(self) -> None:
        object.__setattr__(self, "object_id", np.asarray(self.object_id, np.int64))
        expected = (*self.x.shape[:1], len(self.object_id), FUTURE_STEPS)
        for name in ("x", "y", "z", "heading"):
            values = getattr(self, name)
            if tuple(values.shape) != expected or values.dtype != torch.float32:
                raise DataError(
                    f"Simulated {name} must be float32 of shape [N, A = {len(self.object_id)}, T = {FUTURE_STEPS}], "
                    f"got {values.dtype} {list(values.shape)}: one row per object id, 80 steps at 10 Hz."
                )
        if self.repeat < 1 or expected[0] < 1:
            raise DataError(f"At least one rollout is needed, got {expected[0]} x repeat {self.repeat}.")

    @property
    def device(self) -> torch.device:
        """Device of the rollouts; the metric is computed there."""
        return self.x.device

    @property
    def num_rollouts(self) -> int:
        """Number of rollouts, N x repeat."""
        return self.x.shape[0] * self.repeat

    def check_finite(self, scenario_id: str | None = None) -> None:
        """Refuse rollouts with values that are not finite. It waits for the device, so callers choose when.

        The metric itself follows the official rules, which count NaN in a histogram's last bin.

        Args:
            scenario_id: for the message; None where the caller names the scenario.

        Raises:
            DataError: a value is NaN or infinite: names its rollout, object id and step.
        """
        finite = torch.stack([self.x, self.y, self.z, self.heading]).isfinite().all(0)
        if not finite.all():
            rollout, agent, step = (~finite).nonzero()[0].tolist()
            name = f"{self.object_id[agent]} of scenario {scenario_id}" if scenario_id else self.object_id[agent]
            raise DataError(
                f"Simulated state of object id {name} in rollout {rollout} at future step {step} is not finite: "
                "positions in meters and headings in radians must be numbers."
            )


@dataclass(frozen=True, eq=False)
class Trajectories:
    """States of agents over time, world frame, float32."""

    x: Float[Tensor, "... A T"]
    y: Float[Tensor, "... A T"]
    z: Float[Tensor, "... A T"]
    heading: Float[Tensor, "... A T"]

    def of_agents(self, index: Int64[Tensor, "E"]) -> "Trajectories":
        """Trajectories of the agents at `index`."""
        return Trajectories(*(values.index_select(-2, index) for values in self.fields))

    def from_step(self, first: int) -> "Trajectories":
        """The steps from `first` on; a negative `first` counts from the end."""
        return Trajectories(*(values[..., first:] for values in self.fields))

    @property
    def fields(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """x, y, z, heading."""
        return self.x, self.y, self.z, self.heading


@dataclass(frozen=True, eq=False)
class Layout:
    """Places of the agents of B scenarios that lie side by side, so that all are measured together.

    E evaluated agents in all, M at most in one scenario; K agents at most in one scenario.
    """

    scenario: Int64[Tensor, "E"]
    """Scenario of each evaluated agent."""
    first_agent: Int64[Tensor, "B"]
    """Place of each scenario's first agent among all."""
    evaluated: Int64[Tensor, "B M"]
    """Each scenario's evaluated agents, as places among the E; any where the mask is False."""
    evaluated_mask: Bool[Tensor, "B M"]
    others: Int64[Tensor, "E K"]
    """The agents of each evaluated agent's scenario, as places among all; any where the mask is False."""
    other_mask: Bool[Tensor, "E K"]
    """False for padding, and for the evaluated agent itself."""


def sum_over_agents(values: Float[Tensor, "..."], layout: Layout | None) -> Float[Tensor, "..."]:
    """Sums over evaluated agents: [..., E] to [...], or to [..., B] where they are those of several scenarios.

    Args:
        values: of each evaluated agent.
        layout: of several scenarios; None = all agents are of one.
    """
    if layout is None:
        return values.sum(-1)
    return torch.where(layout.evaluated_mask, values[..., layout.evaluated], 0.0).sum(-1)


def mean_over_agents(values: Float[Tensor, "..."], layout: Layout | None) -> Float[Tensor, "..."]:
    """Means over evaluated agents, as `sum_over_agents`."""
    return values.mean(-1) if layout is None else sum_over_agents(values, layout) / layout.evaluated_mask.sum(-1)


def to_agents(values: Float[Tensor, "..."], layout: Layout | None) -> Float[Tensor, "..."]:
    """A scenario's value for each of its evaluated agents: [...] to [..., 1], or [..., B] to [..., E].

    Args:
        values: of each scenario.
        layout: of several scenarios; None = there is one.
    """
    return values[..., None] if layout is None else values[..., layout.scenario]


@dataclass(frozen=True, eq=False)
class LoggedAgents:
    """The simulated agents of a scenario, or of several side by side, as logged, on a device."""

    object_id: Int64[np.ndarray, "A"]
    """Track order."""
    evaluated: Int64[Tensor, "E"]
    """Indices of the evaluated agents among the simulated ones, by ascending object id."""
    evaluated_object_id: Int64[np.ndarray, "E"]
    evaluated_object_type: Int64[np.ndarray, "E"]
    is_vehicle: Bool[Tensor, "E"]
    size: Float[Tensor, "A 3"]
    """Length, width, height at the current step."""
    trajectories: Trajectories
    """[A, 91]. Invalid states keep what the file stores, because speeds of neighboring steps read them."""
    valid: Bool[Tensor, "A 91"]
    layout: Layout | None = None
    """Of several scenarios; None = there is one."""

    @property
    def future_valid(self) -> Bool[Tensor, "E T"]:
        """Log validity of the evaluated agents at the future steps."""
        return self.valid.index_select(0, self.evaluated)[:, CURRENT_STEP + 1 :]


def build_logged_agents(scenario: Scenario, device: torch.device) -> LoggedAgents:
    """The simulated agents of a scenario.

    Args:
        scenario: with its future.
        device: where the tensors go.

    Raises:
        DataError: the scenario has no logged future or no evaluated agent.
    """
    if not scenario.has_future:
        raise DataError(
            f"Scenario {scenario.scenario_id} has {scenario.num_steps} logged steps: without its future (11 to 90, "
            "withheld in a test split) it cannot be scored. Use training or validation data."
        )
    tracks, simulated, evaluated = scenario.tracks, scenario.simulated_indices, scenario.evaluated_indices
    if len(evaluated) == 0:
        raise DataError(
            f"Scenario {scenario.scenario_id} has no evaluated agent that is valid at the current step: leave it out."
        )
    # x, y, z and heading in one array, so that one copy goes to the device: [4, A, 91].
    states = np.concatenate([tracks.position, tracks.heading[..., None]], axis=-1)[simulated, :TOTAL_STEPS]
    fields = torch.from_numpy(np.ascontiguousarray(np.moveaxis(states, -1, 0))).to(device)
    object_type = tracks.object_type[evaluated].astype(np.int64)
    return LoggedAgents(
        object_id=tracks.object_id[simulated].astype(np.int64),
        evaluated=torch.from_numpy(np.searchsorted(simulated, evaluated)).to(device),
        evaluated_object_id=tracks.object_id[evaluated].astype(np.int64),
        evaluated_object_type=object_type,
        is_vehicle=torch.from_numpy(object_type == ObjectType.VEHICLE).to(device),
        size=torch.from_numpy(tracks.size[simulated, CURRENT_STEP]).to(device),
        trajectories=Trajectories(*fields.unbind(0)),
        valid=torch.from_numpy(tracks.valid[simulated, :TOTAL_STEPS]).to(device),
    )


def join_agents(parts: Sequence[LoggedAgents]) -> LoggedAgents:
    """The agents of several scenarios side by side."""
    device = parts[0].valid.device
    # On the host, whose arrays know the numbers of agents without waiting for the device.
    num_agents, num_evaluated = (
        np.array([len(ids) for ids in column])
        for column in zip(*((part.object_id, part.evaluated_object_id) for part in parts))
    )
    first_agent, first_evaluated = np.cumsum(num_agents) - num_agents, np.cumsum(num_evaluated) - num_evaluated
    scenario = np.repeat(np.arange(len(parts)), num_evaluated)  # [E]
    column, rank = np.arange(num_agents.max()), np.arange(num_evaluated.max())
    others = np.minimum(first_agent[scenario, None] + column, num_agents.sum() - 1)  # [E, K]
    members = np.minimum(first_evaluated[:, None] + rank, num_evaluated.sum() - 1)  # [B, M]
    is_other, is_member = column < num_agents[scenario, None], rank < num_evaluated[:, None]
    arrays = (scenario, first_agent, members, is_member, others, is_other)
    scenario, first_agent, members, is_member, others, is_other = (torch.from_numpy(a).to(device) for a in arrays)
    evaluated = torch.cat([part.evaluated for part in parts]) + first_agent[scenario]
    is_other = is_other & (others != evaluated[:, None])
    return LoggedAgents(
        object_id=np.concatenate([part.object_id for part in parts]),
        evaluated=evaluated,
        evaluated_object_id=np.concatenate([part.evaluated_object_id for part in parts]),
        evaluated_object_type=np.concatenate([part.evaluated_object_type for part in parts]),
        is_vehicle=torch.cat([part.is_vehicle for part in parts]),
        size=torch.cat([part.size for part in parts]),
        trajectories=join_trajectories([part.trajectories for part in parts]),
        valid=torch.cat([part.valid for part in parts]),
        layout=Layout(scenario, first_agent, members, is_member, others, is_other),
    )


def join_trajectories(parts: Sequence[Trajectories]) -> Trajectories:
    """Trajectories of several groups of agents side by side."""
    return Trajectories(*(torch.cat(values, -2) for values in zip(*(part.fields for part in parts))))


def _shorten(ids: Sequence[int]) -> str:
    listed = ", ".join(str(object_id) for object_id in ids[:8])
    return f"{listed}, ... ({len(ids)} in all)" if len(ids) > 8 else listed


def match_agents(expected: Int64[np.ndarray, "A"], given: Int64[np.ndarray, "G"], where: str) -> Int64[np.ndarray, "A"]:
    """Index into `given` of each expected object id.

    Args:
        expected: the scenario's simulated agents, in track order.
        given: the agents of the rollouts, in any order.
        where: name of the scenario, for the message.

    Raises:
        DataError: an agent is missing, unknown or listed twice; names the ids.
    """
    if np.array_equal(expected, given):
        return np.arange(len(expected))
    order = np.argsort(given, kind="stable")
    missing = sorted(set(expected.tolist()) - set(given.tolist()))
    unknown = sorted(set(given.tolist()) - set(expected.tolist()))
    if missing or unknown or len(given) != len(expected):
        unique, counts = np.unique(given, return_counts=True)
        repeated = unique[counts > 1].tolist()
        parts = [f"listed twice {_shorten(repeated)}"] if repeated else []
        parts += [f"missing {_shorten(missing)}"] if missing else []
        parts += [f"not simulated in this scenario {_shorten(unknown)}"] if unknown else []
        raise DataError(
            f"Rollouts of scenario {where} must hold every track valid at the current step and no other: "
            f"object ids {'; '.join(parts)}."
        )
    return order[np.searchsorted(given[order], expected)]


def join_history(agents: LoggedAgents, states: SimulatedStates, history_steps: int, where: str) -> Trajectories:
    """Rollouts in track order with logged history in front: [N, A, history_steps + 80].

    Args:
        agents: the scenario's agents.
        states: rollouts of exactly these agents.
        history_steps: number of logged steps, the current one the last of them.
        where: name of the scenario, for messages.

    Raises:
        DataError: the rollouts' agents are not the scenario's.
    """
    order = match_agents(agents.object_id, states.object_id, where)
    # Rollouts of our own policies come in track order already: no copy then.
    is_same = bool((order == np.arange(len(order))).all())
    index = None if is_same else torch.from_numpy(order).to(states.device)
    first = CURRENT_STEP + 1 - history_steps

    def prepend(log: Tensor, future: Tensor) -> Tensor:
        future = future if index is None else future.index_select(1, index)
        history = log[:, first : CURRENT_STEP + 1].expand(future.shape[0], -1, -1)
        return torch.cat([history, future], dim=-1)

    simulated = (states.x, states.y, states.z, states.heading)
    return Trajectories(*(prepend(log, future) for log, future in zip(agents.trajectories.fields, simulated)))
