"""How much rollouts say about the last layers of TrafficBots' vehicles: signal and noise of the reward's gradient.

python benchmarks/gradient_signal.py DATA MODEL [MODEL ...] [--num-scenarios 120]

Split training. The gradient of the MLOO objective, credit by agent, over 8 rollouts of each scenario, at the model
itself. Signal: squared length of its mean over scenarios, less what chance adds; noise: the squared standard error of
that mean. Both in units of each weight's own deviation over scenarios. A ratio of 1: that many rollouts point as much
to the right as to anywhere.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from rlftsim.jobs.progress import progress_bar
from rlftsim.policies.registry import load_policy
from rlftsim.policies.trafficbots.policy import TrafficBotsPolicy
from rlftsim.policies.trafficbots.scene import VEHICLE
from rlftsim.recipes.registry import recipe_by_name
from rlftsim.scenario.batch import collate
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.training.config import DeviceConfig
from rlftsim.training.parallel import start_fabric
from rlftsim.training.reward import prepare, update_policy


def main() -> None:
    """A line for each output of the layer."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("models", nargs="+")
    parser.add_argument("--num-scenarios", type=int, default=120)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    scenarios = ScenarioDataset(arguments.data, "training")
    for name in arguments.models:
        by_layer = gradients(name, scenarios, min(arguments.num_scenarios, len(scenarios)))
        for output, samples in by_layer.items():
            signal, noise, error = signal_and_noise(samples)
            ratio = signal / noise
            print(f"{name}, {output}: signal {signal:.4f} ± {error:.4f}, noise {noise:.4f}, ratio {ratio:.2f}")


def gradients(model: str, scenarios: ScenarioDataset, count: int) -> dict[str, Tensor]:
    """Gradient of each scenario's rollouts for the layers of acceleration and yaw rate; the model stays as it is.

    Args:
        model: path or name of a TrafficBots model.
        scenarios: with their futures.
        count: scenarios used, from the first.

    Returns:
        By output, [scenarios, weights].
    """
    config = replace(
        recipe_by_name("trafficbots-demo").finetune, batch_size=1, num_rollouts=8, rollouts_per_pass=8,
        trained="decoder", hold_speed=False, learning_rate=1e-30, weight_decay=0.0, gradient_clip=1e9,
    )  # fmt: skip
    fabric = start_fabric(DeviceConfig(accelerator="cpu", processes=1))
    policy = load_policy(model)
    assert isinstance(policy, TrafficBotsPolicy)
    learner = prepare(policy, config, fabric.device)
    head = policy.network.actions
    layers = {"acceleration": head.acceleration[VEHICLE], "yaw rate": head.yaw_rate[VEHICLE]}
    policy.requires_grad_(False)  # what is not measured costs no backward pass
    for layer in layers.values():
        layer.requires_grad_(True)
    found: dict[str, list[Tensor]] = {output: [] for output in layers}
    with progress_bar(model, count) as advance:
        for index in range(count):
            update_policy(learner, collate([scenarios[index]]), config, fabric)
            for output, layer in layers.items():
                parts = [p.grad.flatten() for p in layer.parameters() if p.grad is not None]  # weight and bias
                found[output].append(torch.cat(parts).double())
            advance()
    return {output: torch.stack(samples) for output, samples in found.items()}


def signal_and_noise(samples: Tensor) -> tuple[float, float, float]:
    """Squared length of the mean without what chance adds, squared standard error of the mean, and error of the first.

    Args:
        samples: [scenarios, weights].
    """
    units = samples / samples.std(0).clamp(min=1e-30)
    count, mean = len(units), units.mean(0)
    covariance = units.T.cov() / count  # of the mean
    noise = covariance.trace()
    error = (2 * covariance.square().sum() + 4 * mean @ covariance @ mean).sqrt()
    return float(mean @ mean - noise), float(noise), float(error)


if __name__ == "__main__":
    main()
