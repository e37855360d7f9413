"""Confidence and accuracy of a model, and whether its cars keep their speed.

python benchmarks/confidence.py DATA MODEL [MODEL ...]

Split validation. Along logged tracks, vehicles: loss and entropy (nats a token), probability beyond the likeliest 20
and 50 tokens, and how much too short the next half second of a vehicle above 10 m/s is expected; then, by the way
that vehicles make in it, the way as expected and the probability of standing; then map use. Then 8 rollouts of
evaluated vehicles that begin above 10 m/s: mean speed in the first and in the eighth second, simulated / logged.
"""

import argparse
from pathlib import Path

import torch

from rlftsim.policies.registry import load_policy
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import ScenarioBatch, collate
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.tokens.vocabulary import STILL_TOKEN
from rlftsim.training.data import batch_with_futures, trained_agents
from rlftsim.training.monitoring import measure_map_use

FAST_MPS, STEP_S, TOKEN_S = 10.0, 0.1, 0.5
VEHICLE_CLASS, VEHICLE_TYPE = 0, 1
WAYS_M = ((5.0, 7.0), (7.0, 9.0), (9.0, 12.0), (12.0, 50.0))
"""Groups of ways of half a second."""


def main() -> None:
    """Two lines and a table a model."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("models", nargs="+")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    scenarios = ScenarioDataset(arguments.data, "validation")
    for name in arguments.models:
        policy = load_policy(name)
        assert isinstance(policy, SmartPolicy)
        policy.eval()
        rows = torch.cat([predictions(policy, scenarios, i) for i in range(len(scenarios))])
        speeds = torch.cat([fast_speeds(policy, collate([scenarios[i]])) for i in range(len(scenarios))])
        fast = rows[rows[:, 4] / TOKEN_S >= FAST_MPS]
        loss, entropy, beyond_20, beyond_50 = rows[:, :4].mean(0).tolist()
        too_short = (fast[:, 4] - fast[:, 5]).mean().item()
        print(
            f"{name}: loss {loss:.2f}, entropy {entropy:.2f}, beyond 20 {beyond_20:.1%}, beyond 50 {beyond_50:.1%}, "
            f"too short {too_short:.2f} m"
        )
        for low, high in WAYS_M:
            group = rows[(rows[:, 4] >= low) & (rows[:, 4] < high)]
            real, expected, stands = group[:, 4:].mean(0).tolist()
            print(f"  | {low:g} to {high:g} m | {len(group)} | {real:.2f} | {expected:.2f} | {stands:.1%} |")
        batches = (collate([scenarios[i]]) for i in range(len(scenarios)))
        _, turning = torch.stack([measure_map_use(policy, one) for one in batches]).sum(0)
        number, with_map, without = turning.tolist()
        print(f"  turning tokens: loss {with_map / number:.2f}, map use {(without - with_map) / number:.2f} nats")
        first, then, last, at_last = speeds.nanmean(0).tolist()
        print(f"  above {FAST_MPS:g} m/s: first second {first:.1f} / {then:.1f}, eighth {last:.1f} / {at_last:.1f} m/s")


@torch.no_grad()
def predictions(policy: SmartPolicy, scenarios: ScenarioDataset, index: int) -> torch.Tensor:
    """Loss, entropy, probability beyond 20 and 50, real and expected way forward [m], and probability of standing, of every
    vehicle's tokens."""
    batch = batch_with_futures(scenarios, [index], context_radius_m=150.0)
    prediction = policy.teacher_forced(batch, trained_agents(batch, 0, radius_m=100.0, limit=None, seed=0))
    rows = prediction.target_mask & (prediction.class_id == VEHICLE_CLASS)
    log_probs, target = prediction.logits[rows].log_softmax(-1), prediction.target[rows]
    probs = log_probs.exp()
    ordered = probs.sort(descending=True).values
    way = policy.vocabulary.end_corners()[VEHICLE_CLASS].mean(1)[: probs.shape[-1], 0]
    beyond = [1 - ordered[:, :count].sum(-1) for count in (20, 50)]
    loss = -log_probs.gather(-1, target[:, None])[:, 0]
    return torch.stack(
        [loss, -(probs * log_probs).sum(-1), *beyond, way[target], probs @ way, probs[:, STILL_TOKEN]], -1
    )


def fast_speeds(policy: SmartPolicy, batch: ScenarioBatch) -> torch.Tensor:
    """Simulated and logged speeds [m/s] of evaluated vehicles above 10 m/s in the first and in the eighth second.

    NaN where nothing was logged.
    """
    fast = batch.velocity[0, :, 10].norm(dim=-1) >= FAST_MPS
    agents = batch.evaluated_mask[0] & (batch.object_type[0] == VEHICLE_TYPE) & fast
    rollouts = simulate(policy, batch, num_rollouts=8, seed=0)
    start = batch.position[0, agents, 10]
    driven = torch.cat([start.expand(8, -1, -1)[:, :, None], rollouts.position[0][:, agents]], 2)
    simulated = driven.diff(dim=2).norm(dim=-1).mean(0) / STEP_S
    logged = batch.position[0, agents, 10:].diff(dim=1).norm(dim=-1) / STEP_S
    valid = batch.valid[0, agents, 10:]
    known = valid[:, 1:] & valid[:, :-1]
    parts = [
        torch.where(known, v, torch.nan)[:, second].nanmean(1)
        for second in (slice(0, 10), slice(70, 80))
        for v in (simulated, logged)
    ]
    return torch.stack(parts, -1)


if __name__ == "__main__":
    main()
