"""How much an estimator of the reward's gradient says per second: signal and noise, at the model itself.

python benchmarks/gradient_signal.py DATA MODEL [--recipe smart-demo] [--num-scenarios 48]

Split training. Signal: squared length of the mean gradient over scenarios, less what chance adds; noise: the squared
standard error of that mean. Both in units of each weight's own deviation over scenarios. A ratio of 1: so many rollouts
point as much to the right as to anywhere. The estimators take turns scenario by scenario, on one core.
"""

import argparse
import time
from dataclasses import replace

import torch
from torch import Tensor

from rlftsim.jobs.progress import progress_bar
from rlftsim.policies.registry import load_policy
from rlftsim.policies.trafficbots.policy import TrafficBotsPolicy
from rlftsim.policies.trafficbots.scene import VEHICLE
from rlftsim.recipes.registry import recipe_by_name
from rlftsim.scenario.batch import collate
from rlftsim.scenario.open import open_dataset
from rlftsim.training.config import DeviceConfig, FinetuneConfig
from rlftsim.training.parallel import start_fabric
from rlftsim.training.reward import prepare, update_policy

MEASURED = dict(batch_size=1, micro_batch_size=1, constraints=(), learning_rate=1e-30, weight_decay=0.0)
PAPER = dict(credit="rollout", num_rollouts=8, num_scored=None, credit_clip=None, imitation_weight=0.0)
BY_AGENT = dict(PAPER, credit="agent", credit_mixing=0.1)


def main() -> None:
    """A line for each estimator."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data")
    parser.add_argument("model")
    parser.add_argument("--recipe", default="smart-demo")
    parser.add_argument("--num-scenarios", type=int, default=48)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    scenarios = open_dataset(arguments.data, "training")
    count = min(arguments.num_scenarios, len(scenarios))
    recipe = replace(recipe_by_name(arguments.recipe).finetune, **MEASURED)
    estimators = {
        "reward of the rollout, 8 rollouts (the paper's)": replace(recipe, **PAPER, log_prob_reduction="mean"),
        "reward of the agent, 8 rollouts": replace(recipe, **BY_AGENT, log_prob_reduction="mean"),
        "the same with imitation 0.002": replace(
            recipe, **{**BY_AGENT, "imitation_weight": 0.002}, log_prob_reduction="mean"
        ),
        f"{arguments.recipe}": replace(recipe, imitation_weight=0.0),
    }
    measured = {name: ([], []) for name in estimators}
    with progress_bar(arguments.model, count) as advance:
        for index in range(count):
            for name, config in estimators.items():
                gradient, seconds = measure_gradient(arguments.model, scenarios[index], config)
                measured[name][0].append(gradient)
                measured[name][1].append(seconds)
            advance()
    for name, (gradients, seconds) in measured.items():
        signal, noise, error = signal_and_noise(torch.stack(gradients))
        rate = 1000 * signal / noise / sum(seconds)
        rollouts = count * estimators[name].num_rollouts
        print(
            f"{name}: signal / noise {signal / noise:.3f} ± {error / noise:.3f} of {rollouts} rollouts; "
            f"{1000 * sum(seconds) / rollouts:.0f} ms a rollout; {rate:.2f} per 1000 s of CPU"
        )


def measure_gradient(model: str, scenario: object, config: FinetuneConfig) -> tuple[Tensor, float]:
    """Gradient [weights] of one scenario's rollouts, and the CPU seconds; the model stays as it is.

    Args:
        model: Path or name of the model; of TrafficBots only the layers of the vehicles' acceleration count.
        scenario: Scenario with its future.
        config: Settings of the estimator.
    """
    fabric = start_fabric(DeviceConfig(accelerator="cpu", processes=1))
    policy = load_policy(model)
    learner = prepare(policy, config, fabric.device)
    if isinstance(policy, TrafficBotsPolicy):
        policy.requires_grad_(False)  # what is not measured costs no backward pass
        policy.network.actions.acceleration[VEHICLE].requires_grad_(True)
    start = time.process_time()
    update_policy(learner, collate([scenario]), config, fabric)
    seconds = time.process_time() - start
    return torch.cat([p.grad.flatten() for p in policy.parameters() if p.grad is not None]), seconds


def signal_and_noise(samples: Tensor) -> tuple[float, float, float]:
    """Squared length of the mean without what chance adds, squared standard error of the mean, and error of the first.

    Args:
        samples: [scenarios, weights].
    """
    units = (samples / samples.std(0).clamp(min=1e-30)).double()
    count = len(units)
    products = units @ units.T  # of scenarios
    squares, total = float(products.diagonal().sum()), float(products.sum())
    signal = (total - squares) / (count * (count - 1))
    noise = (squares - total / count) / (count * (count - 1))
    apart = (products - signal).fill_diagonal_(0.0)
    return signal, noise, float((2 * apart.square().sum()).sqrt()) / (count * (count - 1))


if __name__ == "__main__":
    main()
