"""Verbs that make and change models: tokens, pretrain, finetune."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
from rich.console import Console
from rich.table import Table
from tyro.conf import Positional

from rlftsim.cli.data import data_folder, open_split
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.progress import print_wide
from rlftsim.recipes.card import model_card
from rlftsim.recipes.configure import Override, configure
from rlftsim.recipes.models import load_policy
from rlftsim.recipes.smart import RECIPES
from rlftsim.tokens.clustering import CoverageReport, build_vocabulary, reconstruction_error
from rlftsim.tokens.vocabulary import Vocabulary
from rlftsim.training.finetune import finetune
from rlftsim.training.pretrain import pretrain

RecipeName = Literal["smart-tiny", "smart-mini", "smart-nano", "smart-demo"]


@dataclass(frozen=True)
class Tokens:
    """Build a vocabulary of motion and map tokens from a data set, and say how well it covers the data."""

    data: str
    """Folder of a data set, or "synthetic"."""
    out: Path
    """File to write, e.g. vocabulary.safetensors."""
    recipe: RecipeName = "smart-tiny"
    split: str = "training"
    set: list[Override] = field(default_factory=list)
    """Other values for fields of the recipe, e.g. tokens.num_tokens=1024."""

    def run(self) -> int:
        """Build, report, write."""
        recipe = configure(RECIPES[self.recipe](), self.set, sections=("tokens",))
        scenarios = open_split(self.data, self.split)
        say = Console(stderr=True)
        origin = f"{' '.join(sys.argv[1:])}; {len(scenarios)} scenarios; seed {recipe.tokens.seed}"
        vocabulary, reports = build_vocabulary(
            scenarios, recipe.tokens, origin=origin, progress=lambda what: say.print(f"clustering {what}")
        )
        vocabulary.save(self.out)
        print_wide(_coverage_table(reports, reconstruction_error(scenarios, vocabulary)))
        print(
            f"{self.out}: {vocabulary.num_tokens} motion tokens a class, {len(vocabulary.map_prototypes)} map pieces."
        )
        return 0


def _coverage_table(reports: tuple[CoverageReport, ...], errors: tuple[tuple[str, int, float, float], ...]) -> Table:
    table = Table(title="How well the tokens stand for the data", title_justify="left")
    for heading in (
        "class",
        "motions",
        "tokens",
        "disk [cm]",
        "error mean · 95 % [cm]",
        "rolling error mean · 95 % [cm]",
        "fastest [m/s]",
    ):
        table.add_column(heading, justify="left" if heading == "class" else "right")
    for report, (_, _, mean, p95) in zip(reports, errors):
        table.add_row(
            report.class_name, str(report.num_segments), str(report.num_tokens), f"{100 * report.radius_m:.1f}",
            f"{100 * report.mean_error_m:.1f} · {100 * report.p95_error_m:.1f}", f"{100 * mean:.1f} · {100 * p95:.1f}",
            f"{report.max_speed_mps:.1f}",
        )  # fmt: skip
    return table


@dataclass(frozen=True)
class Pretrain:
    """Train a model to predict the next motion token of every agent.

    Interrupted in any way, the same command goes on where it was. The result is in OUT/model.
    """

    recipe: Positional[RecipeName]
    data: str
    """Folder of a data set, or "synthetic"."""
    out: Path
    """Folder of the run: configuration, metrics, checkpoints, model."""
    vocabulary: Path
    """File that `rlftsim tokens` wrote."""
    split: str = "training"
    set: list[Override] = field(default_factory=list)
    """Other values for fields of the recipe, e.g. pretrain.epochs=2 model.dim=64."""

    def run(self) -> int:
        """Build the model and train it."""
        recipe = configure(RECIPES[self.recipe](), self.set, sections=("model", "pretrain"))
        scenarios = open_split(self.data, self.split)
        torch.manual_seed(recipe.pretrain.seed)
        policy = SmartPolicy(recipe.model, Vocabulary.load(self.vocabulary))
        card = model_card("pre-trained", data_folder(self.data), len(scenarios))
        print(f"model: {pretrain(policy, scenarios, self.out, recipe.pretrain, card=card)}")
        return 0


@dataclass(frozen=True)
class Finetune:
    """Fine-tune a model closed-loop with a realism reward (RLFTSim).

    Interrupted in any way, the same command goes on where it was. The result is in OUT/model.
    """

    recipe: Positional[RecipeName]
    model: str
    """Model folder to start from; it is the reference, too."""
    data: str
    """Folder of a data set, or "synthetic"."""
    out: Path
    """Folder of the run: configuration, metrics, checkpoints, model."""
    split: str = "training"
    set: list[Override] = field(default_factory=list)
    """Other values for fields of the recipe, e.g. finetune.learning-rate=1e-5 finetune.reward=rloo."""

    def run(self) -> int:
        """Load the model and fine-tune it."""
        recipe = configure(RECIPES[self.recipe](), self.set, sections=("finetune",))
        scenarios = open_split(self.data, self.split)
        card = model_card(
            f"fine-tuned ({recipe.finetune.reward}) from {self.model}", data_folder(self.data), len(scenarios)
        )
        print(f"model: {finetune(load_policy(self.model), scenarios, self.out, recipe.finetune, card=card)}")
        return 0
