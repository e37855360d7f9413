"""The embedded data set: 200 synthetic scenarios, made by `generate` with the arguments in the manifest."""

from pathlib import Path


def pack_path() -> Path:
    """Folder of the embedded data set, with the splits "training" and "validation"; `ScenarioDataset` opens it."""
    return Path(__file__).parent / "pack"
