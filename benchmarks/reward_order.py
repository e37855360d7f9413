"""The paper's order of rewards where noise is small: calibrations by each reward, all at the same measured KL.

python benchmarks/reward_order.py OUT [--model demo-base] [--seeds 2]
python benchmarks/reward_order.py OUT --compare OUT/exam/EXAM/evaluations

Every reward sees the same rollouts of the training split, 16 of each scenario, a draw of them for each seed, and fits
the same features under the same constraints; a row is fitted without constraints, too. The models, in OUT/REWARD-SEED,
then sit an exam, by the command that is printed in the end; `--compare` holds the rewards against the base and MLOO
against each other, seed by seed, with intervals over street networks and seeds. Credits of every reward are clipped alike and go to agents;
"mloo_by_rollout" gives each agent the reward of its rollout, as the paper does.
"""

import argparse
import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rlftsim.evaluation.results import Evaluation
from rlftsim.jobs.progress import progress_bar
from rlftsim.policies.calibrated.policy import CalibratedTokenPolicy
from rlftsim.policies.registry import load_policy
from rlftsim.realism import score_rollouts
from rlftsim.rewards import compute_rewards, leave_one_out, parse_reward
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.noise import derive_seed
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.open import open_dataset
from rlftsim.statistics import cluster_bootstrap
from rlftsim.training.calibrate import Recorder, natural_direction
from rlftsim.training.config import CONSTRAINED_MEANS, FEATURES, CalibrateConfig
from rlftsim.training.constraints import constraint_by_name
from rlftsim.training.data import batch_with_futures

REWARDS = ("mloo", "rloo", "minade_rloo", "collision_offroad", "collision_offroad_ade")
BY_ROLLOUT = "mloo_by_rollout"
FREE = ("mloo", "rloo")
"""Rewards that are fitted without constraints, too."""
NUM_ROLLOUTS = 16
KL = 0.004
"""Measured on `NUM_MEASURED` scenarios, nats per decision."""
NUM_MEASURED, NUM_ROLLOUTS_MEASURED = 24, 8


def main() -> None:
    """Models of all rewards and seeds, and the command of the exam."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--model", default="demo-base")
    parser.add_argument("--data", default="synthetic")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--compare", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.compare:
        compare(arguments.out, arguments.compare, arguments.seeds, arguments.model)
        return
    scenarios = open_dataset(arguments.data, "training")
    policy = CalibratedTokenPolicy(load_policy(arguments.model), FEATURES).eval().requires_grad_(False)
    names: dict[str, list[str]] = {}
    for seed in range(arguments.seeds):
        credits, scores, fisher = collect(policy, scenarios, seed)
        for name, values in credits.items():
            if name in CONSTRAINTS:
                continue
            gradient = mean_gradient(clip(values), scores)
            for free in (False, True) if name in FREE else (False,):
                fixed = [] if free else [mean_gradient(credits[constraint], scores) for constraint in CONSTRAINED_MEANS]
                step = natural_direction(gradient, fisher, np.array(fixed).reshape(-1, len(FEATURES)), KL)
                for _ in range(2):  # the measured KL is nearly a multiple of the predicted one
                    kl = measure_kl(policy, scenarios, step, seed)
                    step *= math.sqrt(KL / kl)
                label = f"{name}_free" if free else name
                folder = arguments.out / f"{label}-{seed}"
                CalibratedTokenPolicy(policy.base, FEATURES, step.tolist()).save_pretrained(folder, card=f"# {label}\n")
                names.setdefault(label, []).append(str(folder))
                print(f"{label}, seed {seed}: KL {kl:.4f} before the last scaling", flush=True)
    models = " ".join(f"{label}={','.join(folders)}" for label, folders in names.items())
    print(f"rlftsim experiment exam --models {models} --base-model {arguments.model} --out {arguments.out}/exam")


def compare(models: Path, evaluations: Path, num_seeds: int, base: str) -> None:
    """Print the RMM of each reward minus the base's, and MLOO's minus that of each other reward."""
    read_all = map(Evaluation.read, evaluations.glob("*.parquet"))
    stored = {evaluation.provenance.policy_fingerprint: evaluation for evaluation in read_all}
    reference = stored[fingerprint_policy(load_policy(base))]
    clusters = reference.clusters

    def read(name: str) -> np.ndarray:
        """RMM [seeds, scenarios] of the models that sat the exam."""
        prints = [fingerprint_policy(load_policy(str(models / f"{name}-{seed}"))) for seed in range(num_seeds)]
        return np.array([stored[print_]["meta_metric"] for print_ in prints if print_ in stored])

    gains = {name: read(name) - reference["meta_metric"] for name in (*REWARDS, BY_ROLLOUT)}
    for name, gain in gains.items():
        print(f"{name}: {format_interval(gain, clusters)}", flush=True)
    for name in [*gains][1:]:
        count = min(len(gains["mloo"]), len(gains[name]))
        difference = gains["mloo"][:count] - gains[name][:count]
        print(f"mloo minus {name}: {format_interval(difference, clusters)}", flush=True)


def format_interval(values: np.ndarray, clusters: np.ndarray) -> str:
    """Mean with its 95 % interval over networks and seeds."""
    interval = cluster_bootstrap(values, clusters)
    return f"{interval.mean:+.4f} [{interval.interval[0]:+.4f}, {interval.interval[1]:+.4f}], {len(values)} seeds"


def collect(
    policy: CalibratedTokenPolicy, scenarios: object, seed: int
) -> tuple[dict[str, list[Tensor]], list[Tensor], np.ndarray]:
    """Credits [B, N, A] of rewards and constraints, score functions [B, N, A, K], both by batch, and the Fisher matrix.

    Args:
        policy: Calibrated policy with weights 0.
        scenarios: Scenarios with logged futures.
        seed: Seed of the rollouts.
    """
    credits: dict[str, list[Tensor]] = {}
    scores, num_decisions, fisher = [], 0, torch.zeros(len(FEATURES), len(FEATURES), dtype=torch.float64)
    with progress_bar(f"rollouts {seed}", len(scenarios)) as advance:
        for index in range(len(scenarios)):
            batch, recorder = batch_with_futures(scenarios, [index]), Recorder(start=None)
            rollouts = simulate(policy, batch, num_rollouts=NUM_ROLLOUTS, seed=derive_seed(seed), choose=recorder)
            realism, agents = score_rollouts(batch, rollouts, "2025")
            decides = rollouts.decision_mask.any(-1)
            for name in REWARDS:
                rewards = compute_rewards(parse_reward(name), realism, rollouts, batch, agents, credit_mixing=0.0)
                add(credits, name, leave_one_out(rewards.by_agent.double()), decides)
                if name == "mloo":
                    by_rollout = leave_one_out(rewards.total.double())[..., None].expand(decides.shape)
                    add(credits, BY_ROLLOUT, by_rollout, decides)
            for name in CONSTRAINED_MEANS:
                constraint = constraint_by_name(name)
                add(credits, name, constraint.credit(constraint.split(batch, rollouts, agents)), decides)
            scores.append(recorder.score.double())
            flat = scores[-1].flatten(0, 2)
            fisher += flat.T @ flat
            num_decisions += int(rollouts.decision_mask.sum())
            advance()
    return credits, scores, (fisher / num_decisions).numpy()


def add(credits: dict[str, list[Tensor]], name: str, values: Tensor, decides: Tensor) -> None:
    """Append the credits of a batch; agents without a decision get 0."""
    credits.setdefault(name, []).append(torch.where(decides, values.nan_to_num(), 0.0))


def clip(credits: list[Tensor]) -> list[Tensor]:
    """Credits within three standard deviations of those that are not 0, as calibration clips them."""
    earned = torch.cat([values[values != 0] for values in credits])
    limit = CalibrateConfig().clip * float(earned.square().mean().sqrt())
    return [values.clamp(-limit, limit) for values in credits]


def mean_gradient(credits: list[Tensor], scores: list[Tensor]) -> np.ndarray:
    """Mean over scenarios of the gradient by the weights [K]."""
    gradients = [torch.einsum("bna,bnak->k", *pair) for pair in zip(credits, scores)]
    return torch.stack(gradients).mean(0).numpy()


def measure_kl(policy: CalibratedTokenPolicy, scenarios: object, step: np.ndarray, seed: int) -> float:
    """Mean KL of the calibrated policy to its base along own rollouts, nats per decision."""
    calibrated = CalibratedTokenPolicy(policy.base, FEATURES, step.tolist()).eval()
    total, num_decisions = 0.0, 0
    for index in range(0, len(scenarios), max(len(scenarios) // NUM_MEASURED, 1)):
        batch: ScenarioBatch = batch_with_futures(scenarios, [index])
        recorder = Recorder(start=torch.zeros(len(FEATURES)))
        rollouts = simulate(
            calibrated, batch, num_rollouts=NUM_ROLLOUTS_MEASURED, seed=derive_seed(seed, "kl"), choose=recorder
        )
        total, num_decisions = total + float(recorder.kl.sum()), num_decisions + int(rollouts.decision_mask.sum())
    return total / num_decisions


if __name__ == "__main__":
    main()
