"""Synthetic scenarios in the shape of WOMD: an embedded pack, and its generator, which runs SUMO as a subprocess."""

from pathlib import Path


def pack_path() -> Path:
    """Folder of the embedded data set, made by `generate` with the arguments in the manifest.

    Splits: "training" has 160 scenarios of 16 street networks, "validation" 40 of 4, on which choices were made, and
    "testing" 40 of 40, on which none was made. `ScenarioDataset` opens the folder.
    """
    return Path(__file__).parent / "pack"
