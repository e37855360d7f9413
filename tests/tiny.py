"""A model so small that a training run takes seconds, for tests; also a command, so that a run can be killed.

python tests/tiny.py pretrain|catk|finetune|everything OUT [--processes 2] [--updates 8]
"""

import argparse
import copy
from dataclasses import replace
from pathlib import Path

import torch
from safetensors.torch import save_file

from rlftsim.policies.smart.config import SmartConfig
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.synthetic import pack_path
from rlftsim.tokens.clustering import TokensConfig, build_vocabulary
from rlftsim.training.config import (
    AlarmConfig,
    CatkConfig,
    DeviceConfig,
    FinetuneConfig,
    KlConfig,
    PretrainConfig,
    RoadConfig,
    ValidationConfig,
)
from rlftsim.training.parallel import is_first_process
from rlftsim.training.run import train_policy

NUM_SCENARIOS = 5
CPU = DeviceConfig(accelerator="cpu", threads=1)
MODEL = SmartConfig(
    dim=16, num_heads=2, head_dim=8, num_map_layers=1, num_decoder_layers=1, num_frequencies=4, history_tokens=3,
    max_map_neighbors=4, max_agent_map_neighbors=6, max_agent_neighbors=6,
)  # fmt: skip
WITHOUT_CHANCE = replace(MODEL, dropout=0.0, history_drop=0.0)
PRETRAIN = PretrainConfig(
    epochs=1.6, batch_size=1, learning_rate=1e-3, label_smoothing=0.0, checkpoint_every=2, device=CPU
)
CATK = CatkConfig(epochs=1.6, batch_size=1, learning_rate=1e-3, num_candidates=8, checkpoint_every=2, device=CPU)
ROAD = RoadConfig(epochs=1.6, batch_size=1, learning_rate=1e-3, num_candidates=8, checkpoint_every=2, device=CPU)
FINETUNE = FinetuneConfig(
    epochs=1.6,
    batch_size=1,
    num_rollouts=2,
    learning_rate=1e-3,
    warmup_updates=2,
    checkpoint_every=2,
    device=CPU,
    kl=KlConfig(reference_sync_every=2, reference_ema=0.25),
)
"""Eight updates on five scenarios, with a checkpoint after every second."""
OF_EVERYTHING = replace(
    FINETUNE,
    reward="mloo + 0.5*rloo + 0.1*collision_offroad_ade",
    credit="agent",
    micro_batch_size=2,
    alarms=AlarmConfig(first_updates=2, window=2),
)
"""The same with a sum of rewards, credit by agent, scenarios in pieces and alarms that look early."""

SETTINGS = {"pretrain": PRETRAIN, "catk": CATK, "road": ROAD, "finetune": FINETUNE, "everything": OF_EVERYTHING}
"""Settings by stage."""


def pack_scenarios(count=NUM_SCENARIOS):
    """Small scenarios of the embedded pack that have vehicles, pedestrians and cyclists."""
    data = ScenarioDataset(pack_path(), "training")
    columns = (data.index[name].to_pylist() for name in ("num_vehicles", "num_pedestrians", "num_cyclists"))
    mixed = sorted((sum(counts), i) for i, counts in enumerate(zip(*columns)) if all(counts))
    return [data[i] for _, i in mixed[:count]]


def small_vocabulary(scenarios):
    """48 motion tokens a class."""
    return build_vocabulary(scenarios, TokensConfig(num_tokens=48, num_map_prototypes=16))[0]


def tiny_policy(vocabulary, config=MODEL, seed=3):
    """Fresh weights, the same for the same seed; the head scaled up a little."""
    torch.manual_seed(seed)
    policy = SmartPolicy(config, vocabulary)
    with torch.no_grad():
        for name, weight in policy.named_parameters():
            if name.startswith("network.decoder.head") and weight.dim() == 2:
                weight.mul_(3.0)
    return policy


def gradients_of(policy):
    """What the last update left in the parameters."""
    return {name: p.grad.clone() for name, p in policy.named_parameters() if p.grad is not None}


def check_score_function(calibrated, batch, step=1e-2):
    """Distribution along rollouts and its score function, which is that of differences of eta."""
    rollouts = simulate(calibrated, batch, num_rollouts=2, seed=0)
    dist = calibrated.score(calibrated.encode(batch), rollouts)
    gradient = dist.score_function(rollouts.decision)
    for index in range(len(calibrated.features)):
        ends = []
        for sign in (1, -1):
            moved = copy.deepcopy(calibrated)
            with torch.no_grad():
                moved.eta[index] += sign * step
            ends.append(moved.score(moved.encode(batch), rollouts).log_prob(rollouts.decision))
        difference = (ends[0] - ends[1]) / (2 * step)
        torch.testing.assert_close(gradient[..., index], difference, atol=2e-3, rtol=1e-2)
    return dist, gradient


def train(stage, policy, scenarios, out, held_out=None, **changes):
    """Run a stage with other values for some of its fields."""
    return train_policy(policy, scenarios, out, replace(SETTINGS[stage], **changes), held_out=held_out)


def run(stage, out, *, updates=8, processes=1, batch_size=1, micro_batch_cost=None):
    """Train on the pack's scenarios and write the gradients of the last update. Validates where there is a budget."""
    scenarios = pack_scenarios()
    policy = tiny_policy(small_vocabulary(scenarios), WITHOUT_CHANCE if batch_size > 1 else MODEL)
    changes = {
        "device": replace(CPU, processes=processes), "batch_size": batch_size,
        "epochs": updates * batch_size / NUM_SCENARIOS, "gradient_clip": 1e9 if batch_size > 1 else 1.0,
    }  # fmt: skip
    if micro_batch_cost:
        validation = ValidationConfig(every=1, num_scenarios=3, num_rollouts=2)
        changes |= {"micro_batch_cost": micro_batch_cost, "validation": validation}
    train(stage, policy, scenarios, out, scenarios, **changes)
    if is_first_process():
        save_file(gradients_of(policy), out / "gradients.safetensors")
    return policy


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("stage", choices=("pretrain", "catk", "finetune", "everything"))
    parser.add_argument("out", type=Path)
    parser.add_argument("--updates", type=int, default=8)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--batch-size", type=int, default=1)
    parser.add_argument("--micro-batch-cost", type=float)
    options = parser.parse_args()
    run(
        options.stage, options.out,
        updates=options.updates, processes=options.processes, batch_size=options.batch_size,
        micro_batch_cost=options.micro_batch_cost,
    )  # fmt: skip


if __name__ == "__main__":
    main()
