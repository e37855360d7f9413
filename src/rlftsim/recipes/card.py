"""README of a model folder: the origin of a model and the terms under which it may be used."""

import sys
from pathlib import Path

from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.sources import guessed_note
from rlftsim.training.run_folder import describe_environment


def model_card(what: str, data: Path, num_scenarios: int) -> str:
    """Markdown card of a model trained on a data set.

    Args:
        what: how the model was trained, e.g. "pre-trained".
        data: folder of the data set; its license note is passed on.
        num_scenarios: number of training scenarios.
    """
    environment, dataset = describe_environment(), ScenarioDataset(data)
    note = guessed_note(dataset.sources, dataset.guessed)
    guessed = f"* {note}\n" if note else ""
    return f"""# Traffic model, {what}

* trained on {num_scenarios} scenarios of {data.name}
* terms of the data: {dataset.manifest.license_note}
{guessed}* command: rlftsim {" ".join(sys.argv[1:])}
* rlftsim {environment["packages"]["rlftsim"]}, commit {environment["commit"] or "unknown"}
"""
