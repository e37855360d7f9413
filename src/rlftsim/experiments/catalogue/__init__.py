"""The experiments: a file each, and its name here. A new one needs nothing else (docs/experiments.md)."""

from typing import Any

from rlftsim.errors import ConfigError
from rlftsim.experiments.catalogue import (
    benchmark,
    credit,
    finetune_curve,
    goal_conditioning,
    kinematic_controllability,
    maneuver_controllability,
    oracle,
    paired_ttest,
    qualitative,
    reward_ablation,
    variance_scaling,
)
from rlftsim.experiments.findings import Experiment

EXPERIMENTS: dict[str, Experiment[Any]] = {
    "benchmark": benchmark.EXPERIMENT,
    "reward-ablation": reward_ablation.EXPERIMENT,
    "paired-ttest": paired_ttest.EXPERIMENT,
    "variance-scaling": variance_scaling.EXPERIMENT,
    "finetune-curve": finetune_curve.EXPERIMENT,
    "oracle": oracle.EXPERIMENT,
    "credit": credit.EXPERIMENT,
    "qualitative": qualitative.EXPERIMENT,
    "goal-conditioning": goal_conditioning.EXPERIMENT,
    "kinematic-controllability": kinematic_controllability.EXPERIMENT,
    "maneuver-controllability": maneuver_controllability.EXPERIMENT,
}


def experiment_by_name(name: str) -> Experiment[Any]:
    """The experiment of a name.

    Raises:
        ConfigError: there is none; lists those there are.
    """
    if name not in EXPERIMENTS:
        raise ConfigError(f"no experiment {name!r}: there are {', '.join(EXPERIMENTS)}.")
    return EXPERIMENTS[name]
