"""Goals from the log: the last logged position of each agent (RLFTSim, section 4.2)."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.goals.types import Goals
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import CURRENT_STEP, FUTURE_STEPS, STEP_S


@dataclass(frozen=True, eq=False)
class LoggedEndpoints:
    """Each agent's last logged future state, undefined where `mask` is False. Frame: that of the batch."""

    position: Float[Tensor, "B A 2"]
    heading: Float[Tensor, "B A"]
    horizon_s: Float[Tensor, "B A"]
    """Time from the current step to the endpoint."""
    mask: Bool[Tensor, "B A"]
    """True = a simulated agent that is logged at some future step."""


def logged_endpoints(batch: ScenarioBatch) -> LoggedEndpoints:
    """Last logged states of the agents of a batch; without logged futures `mask` is False everywhere."""
    valid = batch.valid[:, :, CURRENT_STEP : CURRENT_STEP + 1 + FUTURE_STEPS]  # [B, A, 81] or shorter
    # [B, A], steps after the current one; 0 = never logged in the future
    last = (valid * torch.arange(valid.shape[2], device=valid.device)).amax(-1)
    step = CURRENT_STEP + last
    return LoggedEndpoints(
        position=_at(batch.position, step),
        heading=_at(batch.heading[..., None], step)[..., 0],
        horizon_s=last * STEP_S,
        mask=batch.agent_mask & (last > 0),
    )


def logged_goals(batch: ScenarioBatch, chosen: Bool[Tensor, "B A"] | None = None) -> Goals:
    """Each agent's last logged position as its goal, for a single rollout (`Goals.repeat` expands it to N).

    Args:
        batch: scenarios with futures.
        chosen: True = the agent gets a goal; None = every agent that has a logged future.
    """
    ends = logged_endpoints(batch)
    return Goals.of_scenarios(ends.position, ends.mask if chosen is None else ends.mask & chosen, batch.frame)


def _at(values: Float[Tensor, "B A S k"], step: Int64[Tensor, "B A"]) -> Float[Tensor, "B A k"]:
    index = step[..., None, None].expand(-1, -1, 1, values.shape[-1])  # [B, A, 1, k]
    return values.gather(2, index)[:, :, 0]
