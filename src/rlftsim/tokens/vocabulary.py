"""Vocabulary: templates of motions and of map pieces, and their file.

C = 3 classes (vehicle, pedestrian, cyclist), V motion tokens per class, six poses per token at 10 Hz (step 0 is the
start). Frame of a token: the agent at the start. A token's boxes have the size of the class, never of the agent.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.errors import DataError
from rlftsim.geometry import pose_of_corners
from rlftsim.jobs.arrays import read_tensors
from rlftsim.jobs.documents import parse_json
from rlftsim.jobs.files import save_tensors
from rlftsim.scenario.types import ObjectType

STEPS_PER_TOKEN = 5
STILL_TOKEN = 0
"""Token of every class that stands exactly still."""
CLASS_NAMES = ("vehicle", "pedestrian", "cyclist")
CLASS_BOXES_M = ((4.8, 2.0), (1.0, 1.0), (2.0, 1.0))
"""Length and width of each class's box, which tokens are matched with."""

PADDING_CLASS = len(CLASS_NAMES)
"""Class of rows that are no agent, where there are such rows."""

MAX_TOKENS = 1 << 16
"""Most motion tokens of a class, and most map pieces; published vocabularies have 2048."""
MAX_COORDINATE_M = 1000.0
"""Farthest point of a token, which lasts half a second, or of a map piece."""
_DTYPES = {"corners": torch.float32, "token_mask": torch.bool, "map_prototypes": torch.float32}

_CLASS_OF_TYPE = (0, 0, 1, 2, 0)
FORMAT = "rlftsim-vocabulary-1"


def class_of_type(object_type: Int64[Tensor, "..."]) -> Int64[Tensor, "..."]:
    """Class index of WOMD object types; other and unset types count as vehicles."""
    # The challenge simulates agents of every type. A box that can drive is the least wrong model of such agents.
    return _load_table(_CLASS_OF_TYPE, object_type.device)[object_type.clamp(0, ObjectType.OTHER)]


def box_of_class(class_id: Int64[Tensor, "..."]) -> tuple[Float[Tensor, "..."], Float[Tensor, "..."]]:
    """Length and width of the box of a class, which tokens are matched with, m."""
    table = _load_table(CLASS_BOXES_M, class_id.device)[class_id]
    return table[..., 0], table[..., 1]


@cache
def _load_table(table: tuple[Any, ...], device: torch.device) -> Tensor:
    """A table as a tensor, cached because the host waits for each copy to a device."""
    return torch.tensor(table, device=device)


@dataclass(frozen=True, eq=False)
class Vocabulary:
    """Motion tokens of each class and prototypes of map pieces."""

    fingerprint_name: ClassVar[str] = "rlftsim.tokens.vocabulary.Vocabulary"

    corners: Float[Tensor, "C V 6 4 2"]
    """Boxes at steps 0..5 in the frame of the start pose; rows past a class's own number of tokens are zero."""
    token_mask: Bool[Tensor, "C V"]
    """True = the token exists. `STILL_TOKEN` does in every class."""
    map_prototypes: Float[Tensor, "P n 2"]
    """Pieces of 5 m, a point every 0.5 m, start at the origin with heading 0. Three points make pieces of 8 m, see
    `map_tokens`."""
    origin: str = ""
    """Command, data and seed of the vocabulary."""

    def __deepcopy__(self, memo: object) -> "Vocabulary":
        """The same vocabulary, which never changes: caches keyed by the vocabulary stay valid for a policy's copy."""
        return self

    @property
    def num_tokens(self) -> int:
        """V."""
        return self.corners.shape[1]

    @cached_property
    def class_tokens(self) -> Bool[Tensor, "C1 V"]:
        """`token_mask` with an additional row for `PADDING_CLASS`, which has token 0 alone."""
        padding_mask = torch.zeros_like(self.token_mask[:1])
        padding_mask[:, 0] = True
        return torch.cat([self.token_mask, padding_mask])

    def end_corners(self) -> Float[Tensor, "C V 4 2"]:
        """Box at the end of each token."""
        return self.corners[:, :, STEPS_PER_TOKEN]

    @cached_property
    def poses(self) -> Float[Tensor, "C V 5 3"]:
        """x, y, heading at steps 1..5 of each token."""
        position, heading = pose_of_corners(self.corners[:, :, 1:])
        return torch.cat([position, heading[..., None]], -1)

    def to(self, device: torch.device | str) -> "Vocabulary":
        """The same vocabulary on a device."""
        return replace(self, **{name: getattr(self, name).to(device) for name in _DTYPES})

    def save(self, path: Path) -> None:
        """Write a safetensors file, atomically."""
        tensors = {name: getattr(self, name).contiguous() for name in _DTYPES}
        save_tensors(path, tensors, {"format": FORMAT, "origin": json.dumps(self.origin)})

    @classmethod
    def load(cls, path: Path) -> "Vocabulary":
        """Vocabulary from a file written by `save`.

        Raises:
            DataError: The file is missing, damaged or not a vocabulary.
        """
        build = "damaged vocabulary, build it again with `rlftsim tokens`"
        try:
            tensors, metadata = read_tensors(path, build)
        except FileNotFoundError:
            raise DataError(f"{path}: no such vocabulary: build one with `rlftsim tokens`.") from None
        if metadata.get("format") != FORMAT:
            raise DataError(f"{path}: not a vocabulary of this version: build one with `rlftsim tokens`.")
        origin = parse_json(metadata.get("origin", ""), build, source=f"{path}: origin", expected=str)
        try:
            check_tables(tensors)
        except DataError as error:
            raise DataError(f"{path}: {error}: {build}.") from None
        return cls(**tensors, origin=origin)


def check_tables(tables: Mapping[str, Tensor]) -> None:
    """Check that tensors are the tables of a vocabulary, as `Vocabulary` declares them.

    Args:
        tables: Tensors by the names of the fields.

    Raises:
        DataError: A table is missing, unknown, of another dtype or shape, too large or not finite; or a class lacks
            the token that stands still. The message begins with the table.
    """
    if tables.keys() != _DTYPES.keys():
        differing = ", ".join(repr(name[:40]) for name in sorted(tables.keys() ^ _DTYPES.keys())[:3])
        raise DataError(f"{', '.join(_DTYPES)} are wanted; missing or unknown: {differing}")
    corners, mask, prototypes = (tables[name] for name in _DTYPES)
    num_tokens, num_pieces = (
        table.shape[axis] if table.dim() > axis else 0 for table, axis in ((corners, 1), (prototypes, 0))
    )
    shapes = {
        "corners": (len(CLASS_NAMES), num_tokens, STEPS_PER_TOKEN + 1, 4, 2),
        "token_mask": (len(CLASS_NAMES), num_tokens),
        "map_prototypes": (num_pieces, 3 if tables["map_prototypes"].shape[1:2] == (3,) else 11, 2),
    }
    for name, dtype in _DTYPES.items():
        if tables[name].dtype != dtype or tables[name].shape != shapes[name]:
            found = f"{tables[name].dtype} {list(tables[name].shape)}"
            raise DataError(f"{name} is {found}, not {dtype} {list(shapes[name])}")
    if not (1 <= num_tokens <= MAX_TOKENS and 1 <= num_pieces <= MAX_TOKENS):
        raise DataError(f"{num_tokens} motion tokens and {num_pieces} map pieces, there are 1 to {MAX_TOKENS} of each")
    for name, table in (("corners", corners), ("map_prototypes", prototypes)):
        if not (table.abs() <= MAX_COORDINATE_M).all():  # false for NaN, too
            raise DataError(f"{name} holds numbers that are no meters within {MAX_COORDINATE_M:g} m")
    if not mask[:, STILL_TOKEN].all():
        raise DataError("token_mask must be true for the first token of each class, which stands still")
