"""How evaluated agents miss where their record ends: short of it, or beside it.

python benchmarks/goal_misses.py DATA MODEL [MODEL ...] [--num-rollouts 8] [--unasked]

Short: along the recorded heading the agent never gets as far as the box around its goal (WOMD's tolerance). Beside: it gets as far, and
is never in the box. Shares of (agent, rollout) pairs of the split validation, by how far the agent was recorded to go; then passed
and reached within 2 m, means over scenarios. Models that see goals are asked to go there, unless --unasked.
"""

import argparse
from pathlib import Path

import numpy as np
import torch

from rlftsim.goals.attainment import is_passed, is_reached, is_within, rate, tolerance_m
from rlftsim.goals.recorded import recorded_ends, recorded_goals
from rlftsim.recipes.models import load_policy
from rlftsim.rollout.policy import Policy, sees_goals
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import ScenarioBatch, collate
from rlftsim.scenario.dataset import ScenarioDataset

GROUPS_M = ((0.0, np.inf), (0.0, 10.0), (10.0, 40.0), (40.0, np.inf))
"""Recorded ways."""


def main() -> None:
    """Print a line for each model and group."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("models", nargs="+")
    parser.add_argument("--num-rollouts", type=int, default=8)
    parser.add_argument("--unasked", action="store_true")
    arguments = parser.parse_args()
    scenarios = ScenarioDataset(arguments.data, "validation")
    for model in arguments.models:
        policy = load_policy(model)
        asked = sees_goals(policy) and not arguments.unasked
        print(f"{model}, {'asked' if asked else 'asked nothing'}, {arguments.num_rollouts} rollouts")
        batches = [collate([scenarios[i]]) for i in range(len(scenarios))]
        parts, rates = zip(*(measure(policy, batch, arguments.num_rollouts, asked) for batch in batches))
        pairs = torch.cat(parts).numpy()
        for low, high in GROUPS_M:
            group = pairs[(pairs[:, 3] >= low) & (pairs[:, 3] < high)]
            shares = " ".join(f"{name} {share:.1%}" for name, share in zip(("pass", "short", "beside"), group.mean(0)))
            print(f"  recorded {low:g} to {high:g} m ({len(group) / len(pairs):.0%}): {shares}, closest {np.median(group[:, 4]):.1f} m")  # fmt: skip
        passed, reached = np.nanmean(rates, axis=0)
        print(f"  within 2 m: passed {passed:.2%}, reached {reached:.2%}")


def measure(policy: Policy, batch: ScenarioBatch, num_rollouts: int, asked: bool) -> tuple[torch.Tensor, tuple[float, float]]:  # fmt: skip
    """Of a scenario: pass, short, beside, recorded way [m], closest approach [m] for every pair; shares passed and reached."""
    goals = recorded_goals(batch, batch.evaluated_mask)
    rollouts = simulate(policy, batch, num_rollouts=num_rollouts, seed=0, goals=goals if asked else None)
    ends, who = recorded_ends(batch), goals.goal_mask[0, 0]
    goal, heading = ends.position[0, who], ends.heading[0, who, None]
    tolerance = tolerance_m(batch.velocity[0, who, 10].norm(dim=-1), ends.horizon_s[0, who])[:, None]
    offset = rollouts.position[0][:, who] - goal[:, None]  # [N, E, T, 2]
    met = is_within(offset, heading, tolerance).any(-1)
    ahead = torch.stack([heading.cos(), heading.sin()], -1)
    short = ~met & ((offset * ahead).sum(-1).amax(-1) < -tolerance[..., 0].T)
    way = (goal - batch.position[0, who, 10]).norm(dim=-1).expand(met.shape)
    columns = (met, short, ~met & ~short, way, offset.norm(dim=-1).amin(-1))
    every = goals.repeat(num_rollouts)
    shares = (rate(meets(rollouts.position, every), every.goal_mask).mean() for meets in (is_passed, is_reached))
    return torch.stack([column.double() for column in columns], -1).flatten(0, 1), tuple(map(float, shares))


if __name__ == "__main__":
    main()
