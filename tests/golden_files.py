"""Golden numbers of the public code, as files of the official material."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class Golden:
    """The golden files of one model."""

    folder: Path

    def arrays(self, name: str) -> dict[str, np.ndarray]:
        with np.load(self.folder / f"{name}.npz") as file:
            return dict(file)

    def scalars(self, name: str) -> dict:
        return json.loads((self.folder / "scalars.json").read_text())[name]
