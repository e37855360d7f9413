"""Uniform noise that depends on seed, scenario and rollout alone, not on the batch, its slices or the device."""

import hashlib

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rlftsim.scenario.batch import ScenarioBatch


def derive_seed(*parts: object) -> int:
    """A 128-bit seed from anything printable, as in `derive_seed(run_seed, "rollouts", update)`."""
    text = "\x1f".join(str(part) for part in parts)
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=16).digest(), "little")


def draw_noise(
    batch: ScenarioBatch, rollout_ids: range, *, seed: int, purpose: str, per_agent: int
) -> Float[Tensor, "B N A k"]:
    """Uniform float32 numbers in [0, 1), `per_agent` for every agent of every rollout.

    Args:
        batch: supplies scenario ids, agent counts and the device.
        rollout_ids: numbers of the rollouts; `range(8, 16)` gives what a draw of 16 would give as its last 8.
        seed: same seed, same numbers.
        purpose: name of the stream; streams of different names are independent.
        per_agent: numbers per agent and rollout.
    """
    num_agents = batch.agent_mask.shape[1]
    # padding gets zeros, so that numbers of agents do not depend on it
    noise = np.zeros((batch.num_scenarios, len(rollout_ids), num_agents, per_agent), np.float32)
    if per_agent:
        for b, scenario in enumerate(batch.scenarios):
            count = len(scenario.simulated_indices)
            for n, rollout in enumerate(rollout_ids):
                # a generator of its own for each rollout: slices and batches of any composition give the same numbers
                key = derive_seed(seed, purpose, scenario.scenario_id, rollout)
                noise[b, n, :count] = np.random.Generator(np.random.Philox(key=key)).random(
                    (count, per_agent), dtype=np.float32
                )
    return torch.from_numpy(noise).to(batch.device)
