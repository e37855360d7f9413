"""README of a model folder: where a model comes from and under which terms it may be used."""

import sys
from pathlib import Path

from rlftsim.scenario.dataset import read_manifest
from rlftsim.training.run_folder import describe_environment


def model_card(what: str, data: Path, num_scenarios: int) -> str:
    """Card of a model trained on a data set.

    Args:
        what: how it came about, e.g. "pre-trained".
        data: folder of the data set; its licence note is passed on.
        num_scenarios: it was trained on.
    """
    environment = describe_environment()
    return f"""# SMART traffic model, {what}

* trained on {num_scenarios} scenarios of {data.name}
* terms of the data: {read_manifest(data).licence_note}
* command: rlftsim {" ".join(sys.argv[1:])}
* rlftsim {environment["packages"]["rlftsim"]}, commit {environment["commit"] or "unknown"}
"""
