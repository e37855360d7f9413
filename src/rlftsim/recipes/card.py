"""README of a model folder: the origin of a model and the terms of use."""

import os
import sys
from collections.abc import Iterable
from pathlib import Path

from rlftsim.policies.checkpoint import read_card
from rlftsim.scenario.dataset import SYNTHETIC, ScenarioDataset
from rlftsim.scenario.sources import guessed_note
from rlftsim.scenario.synthetic import pack_path
from rlftsim.training.run_folder import describe_environment


def model_card(training: str, data: Path, num_scenarios: int, start: str | os.PathLike | None = None) -> str:
    """Markdown card of a model trained on a data set.

    Args:
        training: Words for the kind of training, such as "pre-trained".
        data: Folder of the data set; the license note is passed on.
        num_scenarios: Number of training scenarios.
        start: Model that training started from; the card is passed on, too.
    """
    environment, dataset = describe_environment(), ScenarioDataset(data)
    note = guessed_note(dataset.sources, dataset.guessed)
    guessed = f"* {note}\n" if note else ""
    card = f"""# Traffic model, {training}

* trained on {num_scenarios} scenarios of {SYNTHETIC if data == pack_path() else data.name}
* terms of the data: {dataset.manifest.license_note}
{guessed}* command: rlftsim {" ".join(sys.argv[1:])}
* rlftsim {environment["packages"]["rlftsim"]}, commit {environment["commit"] or "unknown"}
"""
    return card if start is None else append_cards(card, [start])


def append_cards(card: str, models: Iterable[str | os.PathLike]) -> str:
    """A card followed by the cards of the models that a model was made from: the terms of all data hold.

    Args:
        card: Text of the new model's card, in Markdown.
        models: Shipped models, model folders or runs.
    """
    cards = {str(model): read_card(model) for model in models}
    return "\n".join([card, *(f"## Made from {name}\n\n{text}\n" for name, text in cards.items() if text)])
