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
    num_steps = (valid * torch.arange(valid.shape[2], device=valid.device)).amax(-1)
    step = CURRENT_STEP + num_steps
    return LoggedEndpoints(
        position=_select_step(batch.position, step),
        heading=_select_step(batch.heading[..., None], step)[..., 0],
        horizon_s=num_steps * STEP_S,
        mask=batch.agent_mask & (num_steps > 0),
    )


def logged_goals(batch: ScenarioBatch, agent_mask: Bool[Tensor, "B A"] | None = None) -> Goals:
    """Each agent's last logged position as a goal, for a single rollout (`Goals.repeat` expands the goals to N).

    Args:
        batch: Scenarios with logged futures; agents without a future get no goal.
        agent_mask: True = the agent gets a goal; None = every agent with a logged future does.
    """
    ends = logged_endpoints(batch)
    return Goals.of_scenarios(ends.position, ends.mask if agent_mask is None else ends.mask & agent_mask, batch.frame)


def _select_step(values: Float[Tensor, "B A S k"], step: Int64[Tensor, "B A"]) -> Float[Tensor, "B A k"]:
    index = step[..., None, None].expand(-1, -1, 1, values.shape[-1])  # [B, A, 1, k]
    return values.gather(2, index)[:, :, 0]
