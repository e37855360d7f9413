"""Simulated futures (rollouts) of a batch of scenarios, in memory and as files.

`write_rollouts` writes an npz per scenario, in the layout that `rlftsim score` and other tools read: scenario_id,
object_ids [A] int64, x y z heading [N, A, 80] float32, world frame.

Frame: map (centered, meters). N rollouts, L decisions, T simulated steps of 0.1 s. A policy's decisions have event
axes `*event` (none for SMART's token ids, one of size 2 for two-dimensional actions).
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

import rlftsim
from rlftsim.errors import ConfigError, DataError
from rlftsim.goals.types import Goals, shown_id
from rlftsim.jobs.files import write_atomically
from rlftsim.scenario.batch import Frame, ScenarioBatch, compute_origin
from rlftsim.scenario.types import CURRENT_STEP, Scenario, render_html

FARTHEST_STEP_M = 30.0
"""No agent moves so far in 0.1 s: one that is imposed farther away is somebody else, and has no past."""


@dataclass(frozen=True, eq=False)
class AgentStates:
    """States imposed on agents from outside.

    Where `valid` is False the policy moves the agent and the other fields are not used.
    """

    position: Float[Tensor, "B N A t 2"]
    heading: Float[Tensor, "B N A t"]
    valid: Bool[Tensor, "B N A t"]

    def steps(self, start: int, stop: int) -> "AgentStates":
        """The states of steps [start, stop).

        Args:
            start: First step of 0.1 s, counted from 0 at the first simulated step.
            stop: Step after the last, on the same count.
        """
        return AgentStates(*(values[:, :, :, start:stop] for values in vars(self).values()))

    def overlay(self, states: "AgentStates | None") -> "AgentStates":
        """The states, replaced where other states are imposed.

        Args:
            states: States of the same agents and steps, also of a single rollout for all of them; None = none.

        Raises:
            ConfigError: States of other agents or steps.
        """
        if states is None:
            return self
        if states.valid.shape[2:] != self.valid.shape[2:]:
            raise ConfigError(
                f"force imposes states {list(states.valid.shape)}, agents and steps are {list(self.valid.shape)}: with "
                "entries the batch has visitors (open_world.add_visitors)."
            )
        position = torch.where(states.valid[..., None], states.position, self.position)
        return AgentStates(position, torch.where(states.valid, states.heading, self.heading), self.valid | states.valid)

    def rollouts(self, selected: slice) -> "AgentStates":
        """The states of some of the rollouts."""
        return AgentStates(*(values[:, selected] for values in vars(self).values()))


@dataclass(frozen=True, eq=False)
class RolloutProvenance:
    """Origin of rollouts: the simulated scenarios, and the settings that give the same rollouts again."""

    scenarios: tuple[Scenario, ...]
    frame: Frame
    """Frame of the rollouts' positions."""
    policy: str
    """Class of the policy."""
    policy_fingerprint: str
    """Hash of the policy's weights and settings."""
    seed: int
    temperature: float = 1.0
    top_k: int | None = None
    rlftsim_version: str = rlftsim.__version__

    @property
    def scenario_ids(self) -> tuple[str, ...]:
        """Ids of the scenarios, in the order of the rollouts' axis B."""
        return tuple(scenario.scenario_id for scenario in self.scenarios)

    def check_same_agents(self, row: int, scenario: Scenario) -> None:
        """Check that a scenario simulates the agents of the scenario that was simulated, around the same origin.

        The logged futures and the maps may differ.

        Args:
            row: Index of the simulated scenario on axis B.
            scenario: Scenario to be looked at or scored with the rollouts.

        Raises:
            DataError: The scenario has other agents, a different order of agents, or an origin elsewhere.
        """
        simulated = self.scenarios[row]
        ids, simulated_ids = (s.tracks.object_id[s.simulated_indices] for s in (scenario, simulated))
        if not np.array_equal(ids, simulated_ids):
            differ = np.setxor1d(ids, simulated_ids).tolist()
            cause = f"only one of them simulates agent {differ[0]}" if differ else "their agents are in another order"
        elif self.frame == "map" and not np.array_equal(scenario.origin, simulated.origin, equal_nan=True):
            cause = "the ego is elsewhere at the current step"
        else:
            return
        raise DataError(
            f"scenario {scenario.scenario_id} is not as it was simulated: {cause}: hand over the simulated one, or "
            "simulate this one."
        )


@dataclass(frozen=True, eq=False)
class Rollouts:
    """N simulated futures of each of B scenarios, with decisions and log-probabilities."""

    position: Float[Tensor, "B N A T 2"]
    heading: Float[Tensor, "B N A T"]
    decision: Tensor
    """[B, N, A, L, *event]; as sampled, never recovered from poses."""
    decision_mask: Bool[Tensor, "B N A L"]
    """True = the policy decided. False for padding, for agents that decide nothing any more, such as those that have
    left the map, and where all steps of the decision were forced."""
    log_prob: Float[Tensor, "B N A L"]
    """Under the distribution that was sampled from, nats; 0 where the mask is False."""
    draws: Tensor | None = None
    """[B, N, ...] drawn once per rollout by the policy, opaque to all other code."""
    goals: Goals | None = None
    forced: AgentStates | None = None
    valid: Bool[Tensor, "B N A T"] | None = None
    """True = the agent is there, in a world that agents enter and leave; None = everybody is, all the time."""
    provenance: RolloutProvenance | None = None
    """Set by `rlftsim.simulate`; None for rollouts of the closed loop itself, as in training."""

    @property
    def num_rollouts(self) -> int:
        """Number of rollouts per scenario, N."""
        return self.position.shape[1]

    def select(self, selected: slice) -> "Rollouts":
        """Some of the rollouts of every scenario.

        Raises:
            ConfigError: `selected` is a number, which would drop the axis of rollouts.
        """
        if isinstance(selected, int | np.integer):
            single = f"slice({selected}, {selected + 1})" if selected != -1 else "slice(-1, None)"
            raise ConfigError(f"select takes a slice of the rollouts, got {selected}: write {single} for a single one.")
        values = {name: values[:, selected] for name, values in self._collect_tensors().items()}
        goals, forced = (states and states.rollouts(selected) for states in (self.goals, self.forced))
        return replace(self, **values, goals=goals, forced=forced)

    def take(self, index: Int64[Tensor, "B M"]) -> "Rollouts":
        """Rollouts of each scenario by number, in any order; all rollouts of a scenario have the same goals.

        Args:
            index: Numbers of the rollouts, which may be repeated.
        """
        row = torch.arange(len(index), device=index.device)[:, None]
        values = {name: values[row, index] for name, values in self._collect_tensors().items()}
        goals = self.goals and self.goals.rollouts(slice(1)).repeat(index.shape[1])
        return replace(self, **values, goals=goals, forced=None)

    def select_scenario(self, row: int, num_agents: int) -> "Rollouts":
        """Rollouts of a single scenario; without the steps that were forced.

        Args:
            row: Index of the scenario on axis B.
            num_agents: Agents to keep, the first ones, such as all but padding.
        """
        values = {name: values[row : row + 1] for name, values in self._collect_tensors().items()}
        values |= {name: tensor[:, :, :num_agents] for name, tensor in values.items() if name != "draws"}
        goals = self.goals and self.goals.select_scenario(row, num_agents)
        return replace(self, **values, goals=goals, forced=None)

    def _collect_tensors(self) -> dict[str, Tensor]:
        """Fields that are tensors, by name; all have the axes of scenarios and rollouts."""
        return {name: value for name, value in vars(self).items() if isinstance(value, Tensor)}

    # ---- agents by object id: rollouts that `rlftsim.simulate` returned ------------------------------------------

    def find_row(self, scenario_id: str | None = None) -> int:
        """Index of a scenario on axis B.

        Args:
            scenario_id: Id of a simulated scenario; None stands for the only scenario.

        Raises:
            ConfigError: There is no such scenario, several to choose from, or no provenance.
        """
        if self.provenance is None:
            raise ConfigError("these rollouts do not know their scenarios: simulate them with rlftsim.simulate.")
        ids = self.provenance.scenario_ids
        if scenario_id not in ids and not (scenario_id is None and len(ids) == 1):
            listed = ", ".join(ids[:12]) + (", ..." if len(ids) > 12 else "")
            cause = "a scenario_id is needed" if scenario_id is None else f"no scenario {scenario_id!r}"
            raise ConfigError(f"{cause}: these are rollouts of {listed}.")
        return 0 if scenario_id is None else ids.index(scenario_id)

    def object_ids(self, scenario_id: str | None = None) -> Int64[np.ndarray, "A"]:
        """Object ids of a scenario's simulated agents, in the order of axis A; a scenario's padding has none.

        Args:
            scenario_id: Id of a simulated scenario; None stands for the only scenario.

        Raises:
            ConfigError: There is no such scenario, several to choose from, or no provenance.
        """
        row = self.find_row(scenario_id)
        assert self.provenance is not None
        scenario = self.provenance.scenarios[row]
        return scenario.tracks.object_id[scenario.simulated_indices]

    def trajectory(self, object_id: int, scenario_id: str | None = None) -> Float[Tensor, "N T 3"]:
        """Poses of one agent in all rollouts: x, y in meters and heading in radians, world frame, float32.

        Args:
            object_id: Object id of a simulated agent, as in `object_ids`.
            scenario_id: Id of a simulated scenario; None stands for the only scenario.

        Raises:
            ConfigError: There is no such agent (the message lists the simulated agents) or no such scenario.
        """
        row, ids = self.find_row(scenario_id), self.object_ids(scenario_id)
        assert self.provenance is not None
        scenario = self.provenance.scenarios[row]
        if object_id not in ids:
            listed = ", ".join(map(str, sorted(ids.tolist())))
            raise ConfigError(
                f"scenario {scenario.scenario_id} simulates no agent {shown_id(object_id)}: there are {listed}."
            )
        agent = int(np.flatnonzero(ids == object_id)[0])
        # Added in float64, as `ScenarioBatch.to_world` does, so that only the result is rounded.
        origin = torch.from_numpy(compute_origin(scenario, self.provenance.frame)).to(self.position.device)
        position = (self.position[row, :, agent].double() + origin).float()  # [N, T, 2]
        return torch.cat([position, self.heading[row, :, agent, :, None].float()], -1)

    def __repr__(self) -> str:
        num_scenarios, *counts, _ = self.position.shape
        sizes = [f"{num_scenarios} scenario{'s' if num_scenarios != 1 else ''}"]
        sizes += [f"{count} {name}" for count, name in zip(counts, ("rollouts", "agents", "steps"))]
        seed = "" if self.provenance is None else f", seed {self.provenance.seed}"
        return f"Rollouts({' × '.join(sizes)}{seed})"

    def _repr_html_(self) -> str | None:
        return render_html(self)


def write_rollouts(folder: Path, batch: ScenarioBatch, rollouts: Rollouts) -> list[Path]:
    """Write each scenario's rollouts to `folder/<scenario id>.npz`, each file whole or not at all.

    Args:
        folder: Folder of the files, created where it is missing.
        batch: Scenarios that the rollouts continue, in the same order, with ids, heights and the world frame.
        rollouts: Simulated futures in the map frame. The height of an agent stays that of the current step.

    Returns:
        The files, in the order of the batch.
    """
    world = batch.to_world(rollouts.position).cpu().numpy()
    headings, heights = rollouts.heading.float().cpu().numpy(), batch.z[:, :, CURRENT_STEP].cpu().numpy()
    files = [folder / f"{scenario.scenario_id}.npz" for scenario in batch.scenarios]
    for b, (file, scenario) in enumerate(zip(files, batch.scenarios)):
        indices = scenario.simulated_indices
        heading = headings[b, :, : len(indices)]  # [N, A, 80] without padding
        x, y = (world[b, :, : len(indices), :, axis] for axis in range(2))
        z = np.broadcast_to(heights[b, : len(indices), None], heading.shape)
        ids = {"scenario_id": np.array(scenario.scenario_id), "object_ids": scenario.tracks.object_id[indices]}
        presence = {} if rollouts.valid is None else {"valid": rollouts.valid[b, :, : len(indices)].cpu().numpy()}
        write_npz(file, **ids, **presence, x=x, y=y, z=z, heading=heading)
    return files


def write_npz(path: Path, **arrays: np.ndarray) -> None:
    """Write arrays by name to a packed npz, whole or not at all.

    Args:
        path: File to write, replaced if there is one.
        arrays: Array of each name.
    """

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:  # by name, numpy would append .npz
            np.savez_compressed(file, **arrays)  # pyright: ignore[reportArgumentType] (numpy's stub)

    write_atomically(path, write)
