"""Simulated and evaluated agents of the metric: states in rollouts and in the log. Frame: world.

Simulated agents are all tracks valid at the current step, in track order; no other agent exists for the metric.
Evaluated agents are the ego and the tracks to predict, by ascending object id. Sizes and types are those of the current
step for all steps, in the log too. In generated scenes all simulated agents are evaluated, with the size of each step.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Int64
from torch import Tensor

from rlftsim.errors import DataError
from rlftsim.realism.config import SCENARIO_GEN, SIM_AGENTS, Challenge
from rlftsim.scenario.types import CURRENT_STEP, STEP_S, TOTAL_STEPS, ObjectType, Scenario

NUM_HISTORY_STEPS = 2
"""Logged steps that future features depend on: an acceleration at the first future step reads the two steps before."""


@dataclass(frozen=True, eq=False)
class SimulatedStates:
    """Future states of a scenario's simulated agents in N rollouts, world frame, float32, on a single device.

    Every agent exists at all T steps: 80 where they are scored, 91 of a generated scene. Agents may come in any order,
    named by `object_id`.
    """

    object_id: Int[np.ndarray, "A"]
    """On the host: matching agents must not wait for a device."""
    x: Float[Tensor, "N A T"]
    y: Float[Tensor, "N A T"]
    z: Float[Tensor, "N A T"]
    heading: Float[Tensor, "N A T"]
    repeat: int = 1
    """Number of identical rollouts behind each row: 32 equal rollouts are scored at the cost of a single rollout."""
    size: Float[Tensor, "N A T 3"] | None = None
    """Length, width, height of generated agents, m; None = agents go on from the log, with the sizes there."""
    valid: Bool[Tensor, "N A T"] | None = None
    """True = the agent is there, in a world that agents enter and leave, which is not scored; None = everybody is."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "object_id", np.asarray(self.object_id, np.int64))
        num_steps = self.x.shape[-1] if self.size is None else SCENARIO_GEN.num_steps
        expected_shape = (*self.x.shape[:1], len(self.object_id), num_steps)
        if self.size is not None and tuple(self.size.shape) != (*expected_shape, 3):
            raise DataError(f"Sizes of generated agents must be {[*expected_shape, 3]}, got {list(self.size.shape)}.")
        for name in ("x", "y", "z", "heading"):
            values = getattr(self, name)
            if tuple(values.shape) != expected_shape or values.dtype != torch.float32:
                raise DataError(
                    f"Simulated {name} must be a float32 tensor [N, A = {len(self.object_id)}, T = {num_steps}], got a "
                    f"{type(values).__name__} of {values.dtype} {list(values.shape)}: one row per object id, "
                    f"{num_steps} steps at 10 Hz."
                )
        if self.repeat < 1 or expected_shape[0] < 1:
            raise DataError(f"At least one rollout is needed, got {expected_shape[0]} x repeat {self.repeat}.")

    @property
    def presence(self) -> Bool[Tensor, "N A T"]:
        """True = the agent is there."""
        return torch.ones_like(self.x, dtype=torch.bool) if self.valid is None else self.valid

    @property
    def challenge(self) -> Challenge:
        """Challenge whose steps the states are of."""
        return SIM_AGENTS if self.size is None else SCENARIO_GEN

    @property
    def device(self) -> torch.device:
        """Device of the rollouts; the metric is computed there."""
        return self.x.device

    @property
    def num_rollouts(self) -> int:
        """Number of rollouts, N x repeat."""
        return self.x.shape[0] * self.repeat

    def find_rows(self, object_ids: Int[np.ndarray, "n"]) -> Int64[np.ndarray, "n"]:
        """Rows of agents that are all among the simulated ones."""
        order = np.argsort(self.object_id)
        return order[np.searchsorted(self.object_id[order], object_ids)]

    def simulated_path(self, object_id: int) -> Float[Tensor, "N T 2"]:
        """Simulated positions of an agent, m."""
        row = int(np.flatnonzero(self.object_id == object_id)[0])
        return torch.stack([self.x[:, row], self.y[:, row]], -1)

    def check_finite(self, scenario_id: str | None = None) -> None:
        """Refuse rollouts with values that are not finite. The check waits for the device, so callers choose when.

        The metric itself follows the official rules, which count NaN in a histogram's last bin.

        Args:
            scenario_id: Scenario that the message names; None where the caller adds the name.

        Raises:
            DataError: A value is NaN or infinite; the message names rollout, object id and step.
        """
        finite = torch.stack([self.x, self.y, self.z, self.heading]).isfinite().all(0)
        if not finite.all():
            rollout, agent, step = (~finite).nonzero()[0].tolist()
            name = f"{self.object_id[agent]} of scenario {scenario_id}" if scenario_id else self.object_id[agent]
            raise DataError(
                f"Simulated state of object id {name} in rollout {rollout} at future step {step} is not finite: "
                "positions in meters and headings in radians must be numbers."
            )


class Trajectories(NamedTuple):
    """States of agents over time, world frame, float32."""

    x: Float[Tensor, "... A T"]
    y: Float[Tensor, "... A T"]
    z: Float[Tensor, "... A T"]
    heading: Float[Tensor, "... A T"]

    def select_agents(self, index: Int64[Tensor, "E"]) -> "Trajectories":
        """Trajectories of the agents at `index`."""
        return Trajectories(*(values.index_select(-2, index) for values in self))

    def from_step(self, first: int) -> "Trajectories":
        """The steps from `first` on; a negative `first` counts from the end."""
        return Trajectories(*(values[..., first:] for values in self))


@dataclass(frozen=True, eq=False)
class Layout:
    """Indices of the agents of B scenarios that lie side by side, so that all are measured together.

    E evaluated agents in all, at most M in a scenario; at most K agents in a scenario.
    """

    scenario: Int64[Tensor, "E"]
    """Scenario of each evaluated agent."""
    first_agent: Int64[Tensor, "B"]
    """Index of each scenario's first agent among all."""
    evaluated: Int64[Tensor, "B M"]
    """Each scenario's evaluated agents, as indices among the E; any where the mask is False."""
    evaluated_mask: Bool[Tensor, "B M"]
    neighbors: Int64[Tensor, "E K"]
    """The agents of each evaluated agent's scenario, as indices among all; any where the mask is False."""
    neighbor_mask: Bool[Tensor, "E K"]
    """False for padding, and for the evaluated agent itself."""


def sum_over_agents(values: Float[Tensor, "..."], layout: Layout | None) -> Float[Tensor, "..."]:
    """Sums over evaluated agents: [..., E] to [...], or to [..., B] for the agents of several scenarios.

    Args:
        values: Value of each evaluated agent, on the last axis [..., E].
        layout: Arrangement of the agents of several scenarios; None = all agents belong to the same scenario.
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
        values: Value of each scenario, on the last axis [..., B] if there are several.
        layout: Arrangement of the agents of several scenarios; None = there is a single scenario.
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
    size: Float[Tensor, "A #T 3"]
    """Length, width, height: at the current step, or at each step of a generated scene."""
    trajectories: Trajectories
    """[A, 91]. Invalid states keep what the file stores, because speeds of neighboring steps read them."""
    valid: Bool[Tensor, "A 91"]
    layout: Layout | None = None
    """Of several scenarios; None = there is one."""
    challenge: Challenge = SIM_AGENTS

    @property
    def future_valid(self) -> Bool[Tensor, "E T"]:
        """Log validity of the evaluated agents at the simulated steps."""
        return self.valid.index_select(0, self.evaluated)[:, self.challenge.first_step :]


def build_logged_agents(scenario: Scenario, device: torch.device, challenge: Challenge = SIM_AGENTS) -> LoggedAgents:
    """The simulated agents of a scenario.

    Args:
        scenario: Scenario with its logged future, 91 steps.
        device: Device of the returned tensors; rollouts must lie there to be scored.
        challenge: Rules that say which agents are evaluated, and from which step on.

    Raises:
        DataError: The scenario has no logged future or no evaluated agent.
    """
    if not scenario.has_future:
        raise DataError(
            f"Scenario {scenario.scenario_id} has {scenario.num_steps} logged steps: without its future (11 to 90, "
            "withheld in a test split) it cannot be scored. Use training or validation data."
        )
    tracks, simulated, evaluated = scenario.tracks, scenario.simulated_indices, scenario.evaluated_indices
    size_steps = slice(CURRENT_STEP, CURRENT_STEP + 1)
    if challenge.makes_scenes:
        evaluated, size_steps = simulated, slice(TOTAL_STEPS)
    if len(evaluated) == 0:
        raise DataError(
            f"Scenario {scenario.scenario_id} has no evaluated agent that is valid at the current step: leave it out."
        )
    # x, y, z and heading in one array, so that one copy goes to the device: [4, A, 91].
    states = np.concatenate([tracks.position, tracks.heading[..., None]], axis=-1)[simulated, :TOTAL_STEPS]
    trajectories = torch.from_numpy(np.ascontiguousarray(np.moveaxis(states, -1, 0))).to(device)
    object_type = tracks.object_type[evaluated].astype(np.int64)
    return LoggedAgents(
        object_id=tracks.object_id[simulated].astype(np.int64),
        evaluated=torch.from_numpy(np.searchsorted(simulated, evaluated)).to(device),
        evaluated_object_id=tracks.object_id[evaluated].astype(np.int64),
        evaluated_object_type=object_type,
        is_vehicle=torch.from_numpy(object_type == ObjectType.VEHICLE).to(device),
        size=torch.from_numpy(tracks.size[simulated, size_steps]).to(device),
        trajectories=Trajectories(*trajectories.unbind(0)),
        valid=torch.from_numpy(tracks.valid[simulated, :TOTAL_STEPS]).to(device),
        challenge=challenge,
    )


def join_agents(scenes: Sequence[LoggedAgents]) -> LoggedAgents:
    """The agents of several scenarios side by side."""
    device = scenes[0].valid.device
    # On the host, whose arrays know the numbers of agents without waiting for the device.
    num_agents = np.array([len(agents.object_id) for agents in scenes])
    num_evaluated = np.array([len(agents.evaluated_object_id) for agents in scenes])
    first_agent, first_evaluated = np.cumsum(num_agents) - num_agents, np.cumsum(num_evaluated) - num_evaluated
    scenario = np.repeat(np.arange(len(scenes)), num_evaluated)  # [E]
    column, rank = np.arange(num_agents.max()), np.arange(num_evaluated.max())
    neighbors = np.minimum(first_agent[scenario, None] + column, num_agents.sum() - 1)  # [E, K]
    members = np.minimum(first_evaluated[:, None] + rank, num_evaluated.sum() - 1)  # [B, M]
    is_neighbor, is_member = column < num_agents[scenario, None], rank < num_evaluated[:, None]
    arrays = (scenario, first_agent, members, is_member, neighbors, is_neighbor)
    layout = Layout(*(torch.from_numpy(array).to(device) for array in arrays))
    evaluated = torch.cat([agents.evaluated for agents in scenes]) + layout.first_agent[layout.scenario]
    layout = replace(layout, neighbor_mask=layout.neighbor_mask & (layout.neighbors != evaluated[:, None]))
    return LoggedAgents(
        object_id=np.concatenate([agents.object_id for agents in scenes]),
        evaluated=evaluated,
        evaluated_object_id=np.concatenate([agents.evaluated_object_id for agents in scenes]),
        evaluated_object_type=np.concatenate([agents.evaluated_object_type for agents in scenes]),
        is_vehicle=torch.cat([agents.is_vehicle for agents in scenes]),
        size=torch.cat([agents.size for agents in scenes]),
        trajectories=join_trajectories([agents.trajectories for agents in scenes]),
        valid=torch.cat([agents.valid for agents in scenes]),
        layout=layout,
    )


def join_trajectories(groups: Sequence[Trajectories]) -> Trajectories:
    """Trajectories of several groups of agents side by side."""
    return Trajectories(*(torch.cat(values, -2) for values in zip(*groups)))


def _shorten(ids: Sequence[int]) -> str:
    text = ", ".join(str(object_id) for object_id in ids[:8])
    return f"{text}, ... ({len(ids)} in all)" if len(ids) > 8 else text


def match_agents(
    logged_ids: Int64[np.ndarray, "A"], rollout_ids: Int64[np.ndarray, "G"], scenario_id: str
) -> Int64[np.ndarray, "A"]:
    """Index into `rollout_ids` of each logged object id.

    Args:
        logged_ids: Object ids of the scenario's simulated agents, in track order.
        rollout_ids: Object ids of the agents in the rollouts, in any order.
        scenario_id: Scenario that the message names.

    Raises:
        DataError: An agent is missing, unknown or listed twice; the message names the ids.
    """
    if np.array_equal(logged_ids, rollout_ids):
        return np.arange(len(logged_ids))
    order = np.argsort(rollout_ids, kind="stable")
    missing_ids = np.setdiff1d(logged_ids, rollout_ids).tolist()
    unlogged_ids = np.setdiff1d(rollout_ids, logged_ids).tolist()
    if missing_ids or unlogged_ids or len(rollout_ids) != len(logged_ids):
        unique, counts = np.unique(rollout_ids, return_counts=True)
        repeated_ids = unique[counts > 1].tolist()
        reasons = {"listed twice": repeated_ids, "missing": missing_ids, "not simulated in this scenario": unlogged_ids}
        raise DataError(
            f"Rollouts of scenario {scenario_id} must hold every track valid at the current step and no other: "
            f"object ids {'; '.join(f'{reason} {_shorten(ids)}' for reason, ids in reasons.items() if ids)}."
        )
    return order[np.searchsorted(rollout_ids[order], logged_ids)]


def check_closed(valid: object) -> None:
    """Check that all agents are there all the time.

    Args:
        valid: Steps at which agents are there; None = always.

    Raises:
        DataError: Agents leave and enter.
    """
    if valid is not None:
        raise DataError("agents leave and enter in these rollouts, which no metric is defined for: leave entries out.")


def join_history(
    agents: LoggedAgents, states: SimulatedStates, scenario_id: str
) -> tuple[Trajectories, Float[Tensor, "#N A #T 3"]]:
    """Rollouts in track order with two steps of logged history in front, [N, A, 82], and the sizes of the boxes.

    Generated scenes, [N, A, 91], have no history.

    Args:
        agents: Agents of the scenario as logged, whose order the result has.
        states: N rollouts of exactly these agents, in any order.
        scenario_id: Scenario that messages name.

    Raises:
        DataError: The agents of the rollouts are not those of the scenario, they leave and enter, or the steps are
            those of another challenge.
    """
    check_closed(states.valid)
    if states.challenge == agents.challenge and states.x.shape[-1] != agents.challenge.num_steps:
        raise DataError(
            f"scenario {scenario_id}: the metric compares {agents.challenge.num_steps} steps, these rollouts have "
            f"{states.x.shape[-1]}: simulate {agents.challenge.num_steps * STEP_S:g} seconds."
        )
    if states.challenge != agents.challenge:
        raise DataError(
            f"scenario {scenario_id}: {agents.challenge.title} scores {agents.challenge.num_steps} steps of an agent, "
            f"and these rollouts have the {states.challenge.num_steps} of {states.challenge.title}: name a metric of "
            "that challenge; `rlftsim evaluate` makes the rollouts that its metric wants."
        )
    order = match_agents(agents.object_id, states.object_id, scenario_id)
    # Rollouts of our own policies come in track order already: no copy then.
    is_ordered = bool((order == np.arange(len(order))).all())
    index = None if is_ordered else torch.from_numpy(order).to(states.device)
    last = agents.challenge.first_step
    first = max(last - NUM_HISTORY_STEPS, 0)

    def in_order(values: Tensor) -> Tensor:
        return values if index is None else values.index_select(1, index)

    def prepend(log: Tensor, future: Tensor) -> Tensor:
        history = log[:, first:last].expand(future.shape[0], -1, -1)
        return torch.cat([history, in_order(future)], dim=-1)

    simulated = (states.x, states.y, states.z, states.heading)
    trajectories = Trajectories(*(prepend(log, future) for log, future in zip(agents.trajectories, simulated)))
    return trajectories, agents.size[None] if states.size is None else in_order(states.size)
