"""Token tables of the public CAT-K code, which are no part of a checkpoint."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from rlftsim.errors import CheckpointError, DataError
from rlftsim.jobs.arrays import read_npz
from rlftsim.jobs.files import write_atomically
from rlftsim.tokens.vocabulary import MAX_COORDINATE_M, MAX_TOKENS, STEPS_PER_TOKEN, Vocabulary

MOTION_TABLES = ("veh", "ped", "cyc")
MAP_TABLE = "traj_src"
_AGENT_SHAPE = (STEPS_PER_TOKEN + 1, 4, 2)
_MAP_SHAPE = (11, 2)

PUBLISHED_AGENT_FILE = "agent_vocab_555_s2.pkl"
PUBLISHED_NUM_TOKENS = 2048
_PUBLISHED = {
    "veh": "131c0714b245d5357b9ed24bb5ecf0d437b8f0072a7a7b9746a9ab34c0dc9bad",
    "ped": "3ba4fbdb7a6fc0ab1d0867e01af54cf2b26d5e09aa4b4586aa83630261cd80a9",
    "cyc": "f670da05e7a5eb3c789dd93864462b6ea945fe2ef51556f75002e9dc437374ac",
}
"""sha256 of the float32 bytes of the table that CAT-K published."""


def read_catk_vocabulary(paths: Sequence[Path]) -> Vocabulary:
    """Token tables from npz files, or from a vocabulary file of this package.

    Args:
        paths: Files of type npz that together hold `veh`, `ped`, `cyc` [V, 6, 4, 2] and `traj_src` [P, 11, 2],
            meters; or a single `.safetensors` written by `Vocabulary.save`.

    Raises:
        CheckpointError: A table is missing or has the wrong size, or a file cannot be read.
    """
    if len(paths) == 1 and paths[0].suffix == ".safetensors":
        try:
            return Vocabulary.load(paths[0])
        except DataError as error:
            raise CheckpointError(str(error)) from None
    names, tables = (*MOTION_TABLES, MAP_TABLE), {}
    for path in paths:
        try:
            way_out = "not an npz of token tables (pickles are not read, see docs/catk.md)"
            tables |= read_npz(path, names, way_out, error=CheckpointError)
        except FileNotFoundError:
            raise CheckpointError(f"{path}: no such vocabulary.") from None
    source = ", ".join(str(p) for p in paths)
    missing = [name for name in names if name not in tables]
    if missing:
        raise CheckpointError(f"{source}: no table {', '.join(missing)}: hand over veh, ped, cyc and traj_src.")
    _check_tables(tables, source)
    # classes in this package's order: vehicles, pedestrians, cyclists [3, V, 6, 4, 2]
    corners = torch.from_numpy(np.stack([tables[name] for name in MOTION_TABLES]).astype(np.float32))
    prototypes = torch.from_numpy(tables[MAP_TABLE].astype(np.float32))
    mask = torch.ones(corners.shape[:2], dtype=torch.bool)
    return Vocabulary(corners, mask, prototypes, origin=f"imported from {source}")


def has_published_tokens(vocabulary: Vocabulary) -> bool:
    """True if the motion tokens are those that CAT-K published, by sha256."""
    tables = dict(zip(MOTION_TABLES, vocabulary.corners.cpu().numpy()))
    return all(
        hashlib.sha256(np.ascontiguousarray(t, np.float32).tobytes()).hexdigest() == _PUBLISHED[name]
        for name, t in tables.items()
    )


def write_catk_vocabulary(vocabulary: Vocabulary, path: Path) -> None:
    """Write the tables as npz, in the form `read_catk_vocabulary` takes.

    Args:
        vocabulary: Vocabulary with equally many tokens in all classes.
        path: Path of the new npz file, written whole or not at all.

    Raises:
        DataError: The file cannot be written.
    """
    motions = dict(zip(MOTION_TABLES, vocabulary.corners.cpu().numpy()))
    tables = {**motions, MAP_TABLE: vocabulary.map_prototypes.cpu().numpy()}

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:
            np.savez(file, **tables)  # type: ignore[arg-type]

    write_atomically(path, write)


def _check_tables(tables: dict[str, np.ndarray], source: str) -> None:
    """Check shapes, types, numbers of tokens and coordinates of the tables.

    Raises:
        CheckpointError: A table differs from the form of the public code; the message names the first kind of mistake.
    """
    shapes = {name: ("V", *_AGENT_SHAPE) for name in MOTION_TABLES} | {MAP_TABLE: ("P", *_MAP_SHAPE)}
    problems = [
        f"{name} has shape {tables[name].shape} instead of ({', '.join(map(str, shape))})"
        for name, shape in shapes.items()
        if tables[name].shape[1:] != shape[1:] or tables[name].ndim != len(shape)
    ]
    types = {name: tables[name].dtype for name in shapes}
    problems += [f"{name} holds {dtype}, not numbers" for name, dtype in types.items() if dtype.kind not in "fiu"]
    if not problems:
        counts = {len(tables[name]) for name in MOTION_TABLES}
        if not 1 <= min(counts) <= max(counts) <= MAX_TOKENS:
            problems = [f"a class has {max(counts)} tokens, there are 1 to {MAX_TOKENS}"]
        elif len(counts) > 1:
            problems = [f"veh, ped and cyc have different numbers of tokens ({', '.join(map(str, sorted(counts)))})"]
    if not problems:
        problems = [
            f"{name} holds values that are not finite, or beyond {MAX_COORDINATE_M:g} m"
            for name in shapes
            if not (np.abs(tables[name]) <= MAX_COORDINATE_M).all()
        ]
    if problems:
        raise CheckpointError(f"{source}: {'; '.join(problems)}.")
