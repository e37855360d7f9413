"""Goals that were met once: where the record left each agent."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.goals.types import Goals
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import CURRENT_STEP, FUTURE_STEPS, STEP_S


@dataclass(frozen=True, eq=False)
class RecordedEnds:
    """Each agent's last recorded state after the current step; nonsense where `mask` is False. Frame: that of the batch."""

    position: Float[Tensor, "B A 2"]
    heading: Float[Tensor, "B A"]
    horizon_s: Float[Tensor, "B A"]
    """Time from the current step."""
    mask: Bool[Tensor, "B A"]
    """True = a simulated agent that was recorded at some future step."""


def recorded_ends(batch: ScenarioBatch) -> RecordedEnds:
    """Where the record left the agents of a batch. Without recorded futures nobody has an end."""
    valid = batch.valid[:, :, CURRENT_STEP : CURRENT_STEP + 1 + FUTURE_STEPS]
    last = (valid * torch.arange(valid.shape[2], device=valid.device)).amax(-1)  # steps from the current one, 0 = never
    step = CURRENT_STEP + last
    return RecordedEnds(
        position=_at(batch.position, step),
        heading=_at(batch.heading[..., None], step)[..., 0],
        horizon_s=last * STEP_S,
        mask=batch.agent_mask & (last > 0),
    )


def recorded_goals(batch: ScenarioBatch, chosen: Bool[Tensor, "B A"] | None = None) -> Goals:
    """Each agent's last recorded position as its goal, for a single rollout (`Goals.repeat` makes it N).

    Args:
        batch: with futures.
        chosen: who gets a goal; None = everybody that has a recorded future.
    """
    ends = recorded_ends(batch)
    return Goals.of_scenarios(ends.position, ends.mask if chosen is None else ends.mask & chosen)


def _at(values: Float[Tensor, "B A S k"], step: Int64[Tensor, "B A"]) -> Float[Tensor, "B A k"]:
    index = step[..., None, None].expand(-1, -1, 1, values.shape[-1])
    return values.gather(2, index)[:, :, 0]
