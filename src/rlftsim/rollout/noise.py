"""Uniform noise that depends on seed, scenario and rollout alone, not on batch, slices or device."""

import hashlib

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rlftsim.scenario.batch import ScenarioBatch


def derive_seed(*values: object) -> int:
    """A 128-bit seed from printable values, as in `derive_seed(run_seed, "rollouts", update)`."""
    text = "\x1f".join(map(str, values))
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=16).digest(), "little")


def name_decisions(block: int) -> str:
    """Stream of the noise of decisions, which is drawn for 8 s at once, so that it depends on no rollout's length.

    Args:
        block: Number of the 8 s, from 0.
    """
    return f"decide after block {block}" if block else "decide"


def draw_noise(
    batch: ScenarioBatch, rollout_ids: range, *, seed: int, purpose: str, per_agent: int
) -> Float[Tensor, "B N A k"]:
    """Uniform float32 numbers in [0, 1) for every agent of every rollout; zeros for padding.

    Args:
        batch: Scenarios whose ids and agent counts the noise depends on. The noise lies on the batch's device.
        rollout_ids: Ids of the N rollouts; `range(8, 16)` gives the last 8 of a draw of 16.
        seed: Seed of all streams; equal seeds give equal numbers.
        purpose: Name of the stream, such as "begin"; streams of different names are independent.
        per_agent: Numbers k per agent and rollout; 0 gives an empty tensor.
    """
    # padding gets zeros, so that numbers of agents do not depend on it
    noise = np.zeros((batch.num_scenarios, len(rollout_ids), batch.agent_mask.shape[1], per_agent), np.float32)
    if per_agent:
        for b, scenario in enumerate(batch.scenarios):
            shape = (len(scenario.simulated_indices), per_agent)
            for n, rollout in enumerate(rollout_ids):
                # a new generator for each rollout: slices and batches of any composition give the same numbers
                key = derive_seed(seed, purpose, scenario.scenario_id, rollout)
                noise[b, n, : shape[0]] = np.random.Generator(np.random.Philox(key=key)).random(shape, np.float32)
    return torch.from_numpy(noise).to(batch.device)
