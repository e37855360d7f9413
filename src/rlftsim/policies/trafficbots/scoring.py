"""Features that decide the actions, at all decisions of finished rollouts, in a few parallel passes.

The network has no state: a decision depends on the last 11 steps alone, so that all decisions of a rollout
can be computed at once. Shapes: B scenarios, N rollouts, A agents, T decisions, W = 11 steps of a window.
"""

from typing import cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from rlftsim.policies.trafficbots.config import WINDOW
from rlftsim.policies.trafficbots.network import AgentConditioning, AgentContext, TrafficBotsNetwork, Windows
from rlftsim.policies.trafficbots.scene import Scene


def compute_features(
    network: TrafficBotsNetwork,
    history: Windows,
    active: Bool[Tensor, "B N A T"],
    scene: Scene,
    agent_context: AgentContext,
    conditioning: AgentConditioning,
    *,
    steps_per_pass: int,
) -> Float[Tensor, "B T N A D"]:
    """Features of agents at T decisions; differentiable.

    Args:
        network: Network with the weights.
        history: Agents [B, N, A, W - 1 + T] from the first step of the first decision's window on.
        active: True = the agent has not reached the destination yet at this decision.
        scene: Scene with map, lights, sizes and classes.
        agent_context: Map, and lights at the same T decisions.
        conditioning: Personality and destination of each agent.
        steps_per_pass: Number of decisions in memory at once with gradient; changes memory and time only.
    """
    num_decisions = active.shape[-1]
    # [B, N, A, T, ..., W] -> [B, T, N, A, W, ...]
    windows = history.apply(lambda v: v.unfold(3, WINDOW, 1).movedim(3, 1).movedim(-1, 4))
    is_active = active.movedim(3, 1)
    features = []
    for start in range(0, num_decisions, steps_per_pass):
        steps = slice(start, start + steps_per_pass)
        context = agent_context.select_steps(steps)
        inputs = (windows.apply(lambda v: v[:, steps]), scene, context, conditioning, is_active[:, steps])  # noqa: B023
        if torch.is_grad_enabled() and num_decisions > steps_per_pass:
            # Each pass is computed again in the backward pass, so that memory holds a single pass.
            result = checkpoint(network.features, *inputs, use_reentrant=False, preserve_rng_state=False)
        else:
            result = network.features(*inputs)
        features.append(cast(Tensor, result))
    return torch.cat(features, 1)
