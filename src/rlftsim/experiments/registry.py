"""Experiments by name. A package of your own adds one, see `rlftsim.plugins`; `rlftsim experiment NAME` then runs it:

[project.entry-points."rlftsim.experiments"]
my-table = "my_package.my_table:EXPERIMENT"
"""

from typing import Any

from rlftsim.experiments.results import Experiment
from rlftsim.plugins import ExtensionPoint

PAPER = (
    *("benchmark", "reward-ablation", "paired-ttest", "variance-scaling", "finetune-curve", "oracle", "credit"),
    *("model-agnosticism", "kl-frontier"),
    *("qualitative", "goal-conditioning", "kinematic-controllability", "maneuver-controllability"),
)
"""Names of the paper's experiments."""
EXPERIMENTS = ExtensionPoint[Experiment[Any]](
    "experiment",
    "rlftsim.experiments",
    {name: f"rlftsim.experiments.paper.{name.replace('-', '_')}:EXPERIMENT" for name in PAPER},
)
