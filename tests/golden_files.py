"""Golden numbers of the public code, as files of the official material."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch


@dataclass(frozen=True)
class Golden:
    """The golden files of one model."""

    folder: Path

    def arrays(self, name: str) -> dict[str, np.ndarray]:
        with np.load(self.folder / f"{name}.npz") as file:
            return dict(file)

    def unit(self, group: str) -> dict[str, torch.Tensor]:
        """Arrays of a group of `unit`, by their names in it."""
        return {k.split("/", 1)[1]: torch.from_numpy(v) for k, v in self.arrays("unit").items() if k.startswith(group)}

    def scalars(self, name: str) -> dict:
        return json.loads((self.folder / "scalars.json").read_text())[name]
