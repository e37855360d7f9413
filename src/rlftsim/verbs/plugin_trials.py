"""Trials of features and constraints of other packages, on two small scenarios, for `rlftsim plugins`."""

from typing import Any

from rlftsim.policies.calibrated.policy import CalibratedTokenPolicy
from rlftsim.policies.registry import load_policy
from rlftsim.realism import score_rollouts
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.training.constraints import constraint_by_name
from rlftsim.verbs.check_reward import find_small_scenarios


def try_constraint(name: str) -> None:
    """Ask a constraint for its shares in rollouts of two small scenarios, as runs do.

    Args:
        name: Name of a registered constraint.
    """
    batch = collate(find_small_scenarios())
    rollouts = simulate(load_policy("demo-base", "cpu"), batch, num_rollouts=2, seed=0)
    constraint_by_name(name).split(batch, rollouts, score_rollouts(batch, rollouts, "2025")[1])


def try_feature(name: str) -> None:
    """Let a feature weigh in a second of two small scenarios, as in rollouts of calibration.

    Args:
        name: Name of a registered feature.
    """
    policy: Any = CalibratedTokenPolicy(load_policy("demo-base", "cpu"), [name], eta=[1.0])
    simulate(policy, collate(find_small_scenarios()), num_rollouts=1, seed=0, num_steps=10)
