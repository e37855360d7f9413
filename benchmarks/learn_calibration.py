"""Whether plain weights learn what a calibration adds: the base is pulled to the calibrated model, for all tokens at once.

python benchmarks/learn_calibration.py synthetic runs/calibrated runs/learned [--num-updates 120]

A calibrated model is the base times exp(advantage of the fitted critic / beta). So the KL divergence from it, whose
gradient sums over all tokens of a decision, is learning from that critic without any noise of sampled tokens.
"""

import argparse
from dataclasses import replace
from statistics import fmean

import torch

from rlftsim.jobs.progress import progress_bar
from rlftsim.policies.calibrated.policy import CalibratedTokenPolicy
from rlftsim.policies.registry import load_policy
from rlftsim.recipes.registry import recipe_by_name
from rlftsim.scenario.batch import collate
from rlftsim.scenario.open import open_dataset
from rlftsim.training.config import DeviceConfig, KlConfig
from rlftsim.training.parallel import start_fabric
from rlftsim.training.reward import prepare, update_policy

PULL = KlConfig(initial_beta=1e3, min_beta=1e3)
"""So strong that the reward does not count."""


def main() -> None:
    """Print the KL divergence of each pass over the scenarios, and save the model."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data")
    parser.add_argument("model", help="calibrated model")
    parser.add_argument("out", help="folder of the model that learned")
    parser.add_argument("--num-updates", type=int, default=120)
    parser.add_argument("--learning-rate", type=float, default=1e-4)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    scenarios = open_dataset(arguments.data, "training")
    config = replace(
        recipe_by_name("smart-demo").finetune,
        num_rollouts=3,
        num_scored=None,
        constraints=(),
        kl=PULL,
        learning_rate=arguments.learning_rate,
    )
    fabric = start_fabric(DeviceConfig(accelerator="cpu", processes=1))
    trained, calibrated = (load_policy(arguments.model) for _ in range(2))
    assert isinstance(trained, CalibratedTokenPolicy)
    assert isinstance(calibrated, CalibratedTokenPolicy)
    learner = prepare(trained.base, config, fabric.device)
    learner.reference = calibrated.requires_grad_(False)
    order = torch.Generator().manual_seed(0)
    index: list[int] = []
    divergence: list[float] = []
    with progress_bar(arguments.out, arguments.num_updates) as advance:
        for _ in range(arguments.num_updates):
            if len(index) < config.batch_size:
                index = torch.randperm(len(scenarios), generator=order).tolist()
            batch, index = index[: config.batch_size], index[config.batch_size :]
            values = update_policy(learner, collate([scenarios[k] for k in batch]), config, fabric)
            divergence.append(values["kl"])
            advance()
    per_pass = len(scenarios) // config.batch_size
    for start in range(0, len(divergence), per_pass):
        print(
            f"KL of pass {start // per_pass + 1}: {fmean(divergence[start : start + per_pass]):.4f} nats per decision"
        )
    learner.result.eval().save_pretrained(arguments.out)


if __name__ == "__main__":
    main()
