"""Synthetic scenarios in the shape of WOMD: an embedded pack, and its generator, which runs SUMO as a subprocess."""

from pathlib import Path


def pack_path() -> Path:
    """Folder of the embedded data set: 200 scenarios, made by `generate` with the arguments in the manifest.

    The splits are "training" and "validation"; `ScenarioDataset` opens the folder.
    """
    return Path(__file__).parent / "pack"
