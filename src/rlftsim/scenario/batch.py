"""Batches of scenarios: padded tensors of the simulated agents, in the map frame by default."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.errors import DataError
from rlftsim.scenario.types import CURRENT_STEP, HISTORY_STEPS, Scenario

Frame = Literal["map", "world"]


@dataclass(frozen=True, eq=False)
class ScenarioBatch:
    """B scenarios, whose simulated agents (valid at the current step, track order) are padded to A.

    Frame: map, i.e. world minus the scenario's origin (whole meters, exact in float32). Padding has `agent_mask`
    False and zeros elsewhere. S is the largest number of logged steps; a shorter log is invalid beyond the end.
    """

    scenarios: tuple[Scenario, ...]
    origin: Float[Tensor, "B 2"]
    """World coordinates of the batch frame's (0, 0), float64, meters. Zeros in the world frame."""
    object_id: Int64[Tensor, "B A"]
    object_type: Int64[Tensor, "B A"]
    agent_mask: Bool[Tensor, "B A"]
    """True = a simulated agent, False = padding."""
    evaluated_mask: Bool[Tensor, "B A"]
    position: Float[Tensor, "B A S 2"]
    z: Float[Tensor, "B A S"]
    heading: Float[Tensor, "B A S"]
    velocity: Float[Tensor, "B A S 2"]
    size: Float[Tensor, "B A 3"]
    """Length, width, height at the current step."""
    valid: Bool[Tensor, "B A S"]
    frame: Frame = "map"
    light_step: int = CURRENT_STEP
    """Step of the log whose traffic lights are seen; the last one where a log ends before."""

    @property
    def num_scenarios(self) -> int:
        """Number of scenarios B."""
        return len(self.scenarios)

    @property
    def device(self) -> torch.device:
        """Device of the tensors."""
        return self.position.device

    def to_world(self, position: Float[Tensor, "B N A T 2"]) -> Float[Tensor, "B N A T 2"]:
        """Positions of the map frame in the world frame, float32.

        Args:
            position: Positions of A agents in N rollouts of each scenario over T steps, map frame, m.
        """
        # added in float64, so that only the result is rounded
        return (position.double() + self.origin[:, None, None, None].to(position.device)).float()

    def history(self) -> "ScenarioBatch":
        """The same batch with tensors that end at the current step."""
        names = ("position", "z", "heading", "velocity", "valid")
        return replace(self, **{name: getattr(self, name)[:, :, :HISTORY_STEPS] for name in names})

    def to(self, device: torch.device | str) -> "ScenarioBatch":
        """The same batch on another device."""
        moved = {f.name: v.to(device) for f in fields(self) if isinstance(v := getattr(self, f.name), Tensor)}
        return replace(self, **moved)

    def split(self, size: int) -> tuple["ScenarioBatch", ...]:
        """Batches of at most `size` scenarios each, in order, with the same padding."""
        # every tensor has the scenarios along its first axis
        tensors = {f.name: v.split(size) for f in fields(self) if isinstance(v := getattr(self, f.name), Tensor)}
        return tuple(
            replace(self, scenarios=self.scenarios[i * size : (i + 1) * size], **dict(zip(tensors, chunks)))
            for i, chunks in enumerate(zip(*tensors.values()))
        )

    def __repr__(self) -> str:
        num_scenarios, num_agents, num_steps = self.valid.shape
        several = "s" if num_scenarios != 1 else ""
        size = f"{num_scenarios} scenario{several} × {num_agents} agents × {num_steps} steps"
        return f"ScenarioBatch({size}, {self.frame} frame, {self.device})"


def collate(scenarios: Sequence[Scenario], *, max_agents: int | None = None, frame: Frame = "map") -> ScenarioBatch:
    """Batch of scenarios, with the agents that are valid at the current step.

    Args:
        scenarios: Scenarios of the batch, at least 1; logs of different lengths are padded.
        max_agents: Number of agents A that every scenario is padded to; None = as many as the fullest scenario has.
        frame: "map" = centered on each scenario. "world" = as logged, kilometers from the origin, where float32 rounds
            to half a millimeter: for comparison with code that works there.

    Raises:
        DataError: No scenario, or a scenario with more agents than `max_agents`.
    """
    if not scenarios:
        raise DataError("cannot batch 0 scenarios: pass at least one.")
    counts = [len(s.simulated_indices) for s in scenarios]
    num_agents = max(counts) if max_agents is None else max_agents
    if max(counts) > num_agents:
        fullest = scenarios[counts.index(max(counts))]
        raise DataError(f"{fullest.scenario_id}: {max(counts)} agents do not fit max_agents={num_agents}: raise it.")
    # as long as the longest log; the 80 future steps of a test split are invalid
    num_steps = max(s.num_steps for s in scenarios)
    rows = [_agent_rows(s, num_agents, num_steps, compute_origin(s, frame)) for s in scenarios]
    stacked: dict[str, Any] = {name: torch.from_numpy(np.stack([row[name] for row in rows])) for name in rows[0]}
    return ScenarioBatch(scenarios=tuple(scenarios), **stacked, frame=frame)


def compute_origin(scenario: Scenario, frame: Frame) -> Float[np.ndarray, "2"]:
    """World coordinates of a frame's (0, 0), float64, meters.

    Args:
        scenario: Scenario whose `origin` is the center of the map frame.
        frame: Frame of the positions, "map" or "world"; the origin of "world" is (0, 0).
    """
    return scenario.origin if frame == "map" else np.zeros(2)


def _agent_rows(
    scenario: Scenario, num_agents: int, num_steps: int, origin: Float[np.ndarray, "2"]
) -> dict[str, np.ndarray]:
    """A scenario's agents as padded arrays, by field name of `ScenarioBatch`."""
    tracks, indices = scenario.tracks, scenario.simulated_indices
    valid = tracks.valid[indices]
    centered = tracks.position[indices]  # [A, S, 3] world
    centered[..., :2] -= origin
    heading, velocity = tracks.heading[indices], tracks.velocity[indices]
    # zeros in place of the log's values, which mean nothing where a state is not valid and may be NaN
    for values in (centered, heading, velocity):
        values[~valid] = 0
    return {
        "origin": origin,
        "object_id": _pad(tracks.object_id[indices], num_agents),
        "object_type": _pad(tracks.object_type[indices].astype(np.int64), num_agents),
        "agent_mask": _pad(np.ones(len(indices), bool), num_agents),
        "evaluated_mask": _pad(np.isin(indices, scenario.evaluated_indices), num_agents),
        "position": _pad(centered[..., :2], num_agents, num_steps),
        "z": _pad(centered[..., 2], num_agents, num_steps),
        "heading": _pad(heading, num_agents, num_steps),
        "velocity": _pad(velocity, num_agents, num_steps),
        "size": _pad(tracks.size[indices, CURRENT_STEP], num_agents),
        "valid": _pad(valid, num_agents, num_steps),
    }


def _pad(array: np.ndarray, *lengths: int) -> np.ndarray:
    """Zeros appended along the first axes, up to their new lengths."""
    padded = np.zeros((*lengths, *array.shape[len(lengths) :]), array.dtype)
    padded[tuple(slice(0, n) for n in array.shape)] = array
    return padded
