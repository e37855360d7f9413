"""How evaluated agents miss their logged endpoints: short of them, or beside them.

python benchmarks/goal_misses.py DATA MODEL [MODEL ...] [--num-rollouts 8] [--goal-free]

Short: along the logged heading the agent never gets as far as the box around its goal (WOMD's tolerance). Beside: it
gets as far, and is never in the box. Fractions of the (agent, rollout) pairs of the split validation, by the length of
the agent's logged way; then passed and reached within 2 m, means over scenarios. Goal-conditioned models have the
logged endpoints as goals, unless --goal-free.
"""

import argparse
from pathlib import Path

import numpy as np
import torch

from rlftsim.goals.attainment import compute_tolerance, is_passed, is_reached, is_within, rate
from rlftsim.goals.types import logged_endpoints, logged_goals
from rlftsim.policies.registry import load_policy
from rlftsim.rollout.policy import Policy, is_goal_conditioned
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import ScenarioBatch, collate
from rlftsim.scenario.dataset import ScenarioDataset

GROUPS_M = ((0.0, np.inf), (0.0, 10.0), (10.0, 40.0), (40.0, np.inf))
"""Lengths of logged ways."""


def main() -> None:
    """Print a line for each model and group."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("models", nargs="+")
    parser.add_argument("--num-rollouts", type=int, default=8)
    parser.add_argument("--goal-free", action="store_true")
    arguments = parser.parse_args()
    scenarios = ScenarioDataset(arguments.data, "validation")
    for model in arguments.models:
        policy = load_policy(model)
        conditioned = is_goal_conditioned(policy) and not arguments.goal_free
        print(f"{model}, {'with goals' if conditioned else 'goal-free'}, {arguments.num_rollouts} rollouts")
        batches = [collate([scenarios[i]]) for i in range(len(scenarios))]
        parts, rates = zip(*(measure(policy, batch, arguments.num_rollouts, conditioned) for batch in batches))
        pairs = torch.cat(parts).numpy()
        for low, high in GROUPS_M:
            group = pairs[(pairs[:, 3] >= low) & (pairs[:, 3] < high)]
            fractions = zip(("pass", "short", "beside"), group.mean(0))
            text = " ".join(f"{name} {fraction:.1%}" for name, fraction in fractions)
            closest = f"closest {np.median(group[:, 4]):.1f} m"
            print(f"  logged {low:g} to {high:g} m ({len(group) / len(pairs):.0%}): {text}, {closest}")
        passed, reached = np.nanmean(rates, axis=0)
        print(f"  within 2 m: passed {passed:.2%}, reached {reached:.2%}")


def measure(
    policy: Policy, batch: ScenarioBatch, num_rollouts: int, conditioned: bool
) -> tuple[torch.Tensor, tuple[float, float]]:
    """Pass, short, beside, logged way [m], closest approach [m] for every pair of a scenario; rates passed and reached."""
    goals = logged_goals(batch, batch.evaluated_mask)
    rollouts = simulate(policy, batch, num_rollouts=num_rollouts, seed=0, goals=goals if conditioned else None)
    ends, agents = logged_endpoints(batch), goals.goal_mask[0, 0]
    goal, heading = ends.position[0, agents], ends.heading[0, agents, None]
    tolerance = compute_tolerance(batch.velocity[0, agents, 10].norm(dim=-1), ends.horizon_s[0, agents])[:, None]
    offset = rollouts.position[0][:, agents] - goal[:, None]  # [N, E, T, 2]
    met = is_within(offset, heading, tolerance).any(-1)
    ahead = torch.stack([heading.cos(), heading.sin()], -1)
    short = ~met & ((offset * ahead).sum(-1).amax(-1) < -tolerance[..., 0].T)
    way = (goal - batch.position[0, agents, 10]).norm(dim=-1).expand(met.shape)
    columns = (met, short, ~met & ~short, way, offset.norm(dim=-1).amin(-1))
    every = goals.repeat(num_rollouts)
    rates = (rate(meets(rollouts.position, every), every.goal_mask).mean() for meets in (is_passed, is_reached))
    return torch.stack([column.double() for column in columns], -1).flatten(0, 1), tuple(map(float, rates))


if __name__ == "__main__":
    main()
