"""README of a model folder: the origin of a model and the terms under which it may be used."""

import os
import sys
from collections.abc import Iterable
from pathlib import Path

from rlftsim.policies.checkpoint import read_card
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.sources import guessed_note
from rlftsim.training.run_folder import describe_environment


def model_card(training: str, data: Path, num_scenarios: int, start: str | os.PathLike | None = None) -> str:
    """Markdown card of a model trained on a data set.

    Args:
        training: Words for the kind of training, such as "pre-trained".
        data: folder of the data set; its license note is passed on.
        num_scenarios: number of training scenarios.
        start: model that training started from; its card is passed on, too.
    """
    environment, dataset = describe_environment(), ScenarioDataset(data)
    note = guessed_note(dataset.sources, dataset.guessed)
    guessed = f"* {note}\n" if note else ""
    card = f"""# Traffic model, {training}

* trained on {num_scenarios} scenarios of {data.name}
* terms of the data: {dataset.manifest.license_note}
{guessed}* command: rlftsim {" ".join(sys.argv[1:])}
* rlftsim {environment["packages"]["rlftsim"]}, commit {environment["commit"] or "unknown"}
"""
    return card if start is None else append_cards(card, [start])


def append_cards(card: str, models: Iterable[str | os.PathLike]) -> str:
    """A card followed by those of the models that a model was made from: the terms of their data hold for it, too.

    Args:
        card: Text of the new model's card, in Markdown.
        models: shipped models, model folders or runs.
    """
    cards = {str(model): read_card(model) for model in models}
    return "\n".join([card, *(f"## Made from {name}\n\n{text}\n" for name, text in cards.items() if text)])
