"""Experiments by name. `rlftsim experiment NAME` also runs those of installed packages, see `rlftsim.plugins`:

[project.entry-points."rlftsim.experiments"]
my-table = "my_package.my_table:EXPERIMENT"
"""

from typing import Any

from rlftsim.errors import ConfigError
from rlftsim.experiments.results import Experiment
from rlftsim.plugins import ExtensionPoint

PAPER = (
    *("benchmark", "reward-ablation", "paired-ttest", "variance-scaling", "finetune-curve", "oracle"),
    *("model-agnosticism", "kl-frontier"),
    *("qualitative", "goal-conditioning", "kinematic-controllability", "maneuver-controllability"),
)
"""Names of the paper's experiments."""
EXPERIMENTS = ExtensionPoint[Experiment[Any]](
    "experiment",
    "rlftsim.experiments",
    {name: f"rlftsim.experiments.paper.{name.replace('-', '_')}:EXPERIMENT" for name in PAPER},
    use=lambda name: experiment_by_name(name),
)


def experiment_by_name(name: str) -> Experiment[Any]:
    """Experiment of a name, from this package or a plugin.

    Raises:
        ConfigError: Unknown name (the message has the nearest registered name), or not an experiment.
    """
    experiment = EXPERIMENTS.get(name)
    if not isinstance(experiment, Experiment):
        type_name = type(experiment).__name__
        raise ConfigError(
            f"experiment {name!r} is of type {type_name}: make it a rlftsim.experiments.results.Experiment."
        )
    return experiment
