"""How much rollouts say about the weights of a policy's last layers: signal and noise of the reward's gradient.

python benchmarks/gradient_signal.py DATA MODEL [MODEL ...] [--num-scenarios 120]

Split training. The gradient of the MLOO objective, credit by agent, over 8 rollouts of each scenario, at the model
itself. Signal: squared length of its mean over scenarios, less what chance adds; noise: the squared standard error of
that mean. Both in units of each weight's own deviation over scenarios. A ratio of 1: that many rollouts point as much
to the right as to anywhere. Rows: outputs of the layer, such as acceleration and yaw rate of TrafficBots.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor, nn

from rlftsim.policies.registry import load_policy
from rlftsim.progress import progress_bar
from rlftsim.recipes.registry import recipe_by_name
from rlftsim.scenario.batch import collate
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.training.finetune import prepare, update_policy
from rlftsim.training.parallel import DeviceConfig, start_fabric


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
        by_row = gradients(
            name, scenarios, min(arguments.num_scenarios, len(scenarios))
        )  # [scenarios, rows, weights of a row]
        for row in range(by_row.shape[1]):
            signal, noise, error = signal_and_noise(by_row[:, row])
            print(
                f"{name}, output {row}: signal {signal:.4f} ± {error:.4f}, noise {noise:.4f}, ratio {signal / noise:.2f}"
            )


def gradients(model: str, scenarios: ScenarioDataset, count: int) -> Tensor:
    """Gradient of each scenario's rollouts, by output of the layer; the model stays as it is.

    Args:
        model: path or name; its head is one linear layer.
        scenarios: with their futures.
        count: scenarios used, from the first.
    """
    config = replace(
        recipe_by_name("trafficbots-demo").finetune, batch_size=1, num_rollouts=8, rollouts_per_pass=8,
        trained="head", hold_speed=False, learning_rate=1e-30, weight_decay=0.0, gradient_clip=1e9,
    )  # fmt: skip
    fabric = start_fabric(DeviceConfig(accelerator="cpu", processes=1))
    policy = load_policy(model)
    assert isinstance(policy, nn.Module)
    learner = prepare(policy, config, fabric.device)
    found = []
    with progress_bar(model, count) as advance:
        for index in range(count):
            update_policy(learner, collate([scenarios[index]]), config, fabric)
            rows = [p.grad.reshape(len(p), -1) for p in learner.parameters if p.grad is not None]  # weight and bias
            found.append(torch.cat(rows, -1).double())
            advance()
    return torch.stack(found)


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
