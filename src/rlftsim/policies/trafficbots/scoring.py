"""Features that decide the actions, at all decisions of known rollouts, in a few parallel passes.

The network has no state of its own: a decision depends on the last 11 steps alone, so that all decisions of a rollout
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


def features_over_time(
    network: TrafficBotsNetwork,
    history: Windows,
    active: Bool[Tensor, "B N A T"],
    scene: Scene,
    around: AgentContext,
    given: AgentConditioning,
    *,
    steps_per_pass: int,
) -> Float[Tensor, "B T N A D"]:
    """Features of agents at T decisions; differentiable.

    Args:
        network: the weights.
        history: agents [B, N, A, W - 1 + T] from the first step of the first decision's window on.
        active: True = the agent is on its way to its destination at this decision.
        scene: map, lights, sizes and classes.
        around: map, and lights at the same decisions.
        given: personality and destination of each agent.
        steps_per_pass: decisions in memory at once with gradient.
    """
    num_decisions = active.shape[-1]
    # [B, N, A, T, ..., W] -> [B, T, N, A, W, ...]
    valid = history.valid.unfold(3, WINDOW, 1).movedim(3, 1)
    pose = history.pose.unfold(3, WINDOW, 1).movedim(3, 1).transpose(-1, -2)
    motion = history.motion.unfold(3, WINDOW, 1).movedim(3, 1).transpose(-1, -2)
    is_active = active.movedim(3, 1)
    found = []
    for start in range(0, num_decisions, steps_per_pass):
        steps = slice(start, start + steps_per_pass)
        windows = Windows(valid[:, steps], pose[:, steps], motion[:, steps])
        around_then = around.steps(start, start + steps_per_pass)
        inputs = (windows, scene, around_then, given, is_active[:, steps])
        if torch.is_grad_enabled() and num_decisions > steps_per_pass:
            # Each pass is computed again in the backward pass, so that only one is in memory.
            one = checkpoint(network.features, *inputs, use_reentrant=False, preserve_rng_state=False)
        else:
            one = network.features(*inputs)
        found.append(cast(Tensor, one))
    return torch.cat(found, 1)
