"""AlpaSim's CAT-K models: settings, weights and token tables of its public layout, as a model of this package.

policy = import_alpasim(Path("trafficsim-models/catk_v120")).policy

The network is SMART's with other inputs: map pieces of three points, map types of its own, and a fourth type of agents.
What its service always feeds (sub-type 0, light 0) is added to the embedding of the map types once and for all, and so
the weights fit the network here. Source: `src/trafficsim/alpasim_trafficsim/catk` of NVlabs/alpasim.
"""

import hashlib
import io
import pickle
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rlftsim.errors import CheckpointError, ConfigError
from rlftsim.jobs.documents import first_line
from rlftsim.policies.smart.catk_checkpoint import (
    MAP_TABLE,
    PREFIX,
    CatkImport,
    build_catk_policy,
    build_catk_vocabulary,
    find_group,
    read_lightning,
)
from rlftsim.tokens.map_tokens import NUM_FAMILIES, NUM_LIGHTS, TRIPLE
from rlftsim.tokens.vocabulary import CLASS_NAMES

SETTINGS, WEIGHTS = "config.yaml", "latest.ckpt"
PUBLISHED = {
    SETTINGS: "60f40743c5df7b170a2a58a4f2f4f122301508e513ac495a993fe34180511344",
    WEIGHTS: "7c5a89bc6e876c025a82572b72f87ca97dd75fe5f57245dbf2b63fc3b3c4455e",
    "cabs_tc_base_agent_vocab_c1024.pkl": "3d6ac36663262cc3b475a87ce2aa2fd48427584a0fb7f6ce593236fef6ba9143",
    "cabs_tc_map_vocab_c2048_t1000.pkl": "624775cfd1fc6dcce735cf11d2810012fde965d760807db0ca7c6794d8ee60f9",
}
"""sha256 of the files of catk_v120."""
NOT_MAPPED = (
    "not mapped: agents of other types move as vehicles (there they stand still); history is 1.1 s (there 1.6 s); "
    "wait lines and road islands, which maps here do not have"
)
TYPE_OF_OURS = (5, 5, 5, 5, 1, 1, 0, 0, 0, 3)
"""AlpaSim's map type (0 lane line, 1 road boundary, 3 crosswalk, 5 lane center) of each of `MapSegments.type`."""
_MAX_BYTES = 16 << 20
"""Largest file of settings or tokens that is read; the published ones have less than 1 MB."""
_REFERENCE = re.compile(r"\$\{([\w.]+)\}")
_ARRAY_NAMES = {
    "numpy": ("ndarray", "dtype"),
    "numpy.core.multiarray": ("_reconstruct",),
    "numpy._core.multiarray": ("_reconstruct",),
    "numpy.core.numeric": ("_frombuffer",),
    "numpy._core.numeric": ("_frombuffer",),
}
"""All that a pickle of arrays names; nothing else is made."""


def import_alpasim(folder: Path) -> CatkImport:
    """Read a model in AlpaSim's layout.

    Args:
        folder: Folder with `config.yaml` and `latest.ckpt`; the token tables that the settings name are in the folder
            `tokens` beside it.

    Returns:
        The model in evaluation mode, with notes: each file with sha256, and what has no counterpart here.

    Raises:
        CheckpointError: A file is missing, damaged or refused, or weights do not fit; the first are named.
    """
    checks = [_describe_file(folder / name) for name in (SETTINGS, WEIGHTS)]
    settings = _read_settings(folder / SETTINGS)
    named = find_group(settings, "token_processor")
    tokens = {}
    for name in ("agent_token_file", "map_token_file"):
        if not isinstance(named.get(name), str):
            raise CheckpointError(f"{folder / SETTINGS}: names no {name}: get the file again.")
        tokens[name] = folder.parent / "tokens" / Path(named[name]).name
    checks += [_describe_file(path) for path in tokens.values()]
    weights, left_out = _adapt_weights(read_lightning(folder / WEIGHTS)[0], folder / WEIGHTS)

    def read_vocabulary():
        motions = find_group(read_pickled_arrays(tokens["agent_token_file"]), "token_all")
        pieces = read_pickled_arrays(tokens["map_token_file"]).get(MAP_TABLE)
        tables = {name: array for name, array in {**motions, MAP_TABLE: pieces}.items() if type(array) is np.ndarray}
        return build_catk_vocabulary(tables, ", ".join(map(str, tokens.values())), num_map_points=TRIPLE)

    imported = build_catk_policy(weights, settings, folder / WEIGHTS, read_vocabulary, num_map_points=TRIPLE)
    rest = [f"left out: {len(left_out)} weights outside {PREFIX}*, such as {left_out[0][:80]}"] if left_out else []
    return replace(imported, notes=(*checks, *imported.notes, NOT_MAPPED, *rest))


def _read_settings(path: Path) -> dict[str, Any]:
    """Groups of the file's `model_config`, with references to other settings replaced."""
    try:
        import yaml
    except ImportError:
        raise ConfigError(f"{path}: needs PyYAML to be read: pip install 'rlftsim[alpasim]'.") from None
    try:
        content = yaml.safe_load(path.read_bytes())
    except (yaml.YAMLError, ValueError, TypeError, RecursionError, AttributeError) as error:
        raise CheckpointError(f"{path}: damaged or not YAML ({first_line(error)}): get the file again.") from None
    root = content if isinstance(content, dict) else {}
    groups = find_group(root, "model_config") or find_group(find_group(root, "model"), "model_config")
    if not groups:
        raise CheckpointError(f"{path}: has no model_config: is it the config.yaml of AlpaSim's CAT-K?")
    return {
        name: {key: _resolve(value, root) for key, value in group.items()}
        for name, group in groups.items()
        if isinstance(group, dict)
    }


def _resolve(value: object, root: dict[str, Any]) -> Any:
    """A setting, or the one that `${a.b}` refers to."""
    for _ in range(8):  # references to references
        reference = _REFERENCE.fullmatch(value) if isinstance(value, str) else None
        if reference is None:
            break
        value = root
        for key in reference[1].split("."):
            value = value.get(key) if isinstance(value, dict) else None
    return value


def _adapt_weights(weights: dict[str, Tensor], path: Path) -> tuple[dict[str, Tensor], list[str]]:
    """Weights in the shapes of the network here, and the names of those that are no part of it.

    Raises:
        CheckpointError: An embedding lacks a type, or is none.
    """
    adapted = {name: value for name, value in weights.items() if name.startswith(PREFIX)}
    names = ("map_encoder.polygon_type_emb", "map_encoder.type_pt_emb", "map_encoder.light_pl_emb")
    *maps, agents = (f"{PREFIX}{name}.weight" for name in (*names, "agent_encoder.type_a_emb"))
    tables = [adapted.get(name, torch.zeros(0)) for name in (*maps, agents)]
    width = tables[0].shape[-1]
    for name, table, count in zip((*maps, agents), tables, (max(TYPE_OF_OURS) + 1, 1, 1, len(CLASS_NAMES))):
        if table.dim() != 2 or len(table) < count or table.shape[1] != width:
            shape = list(table.shape) if name in adapted else "missing"
            raise CheckpointError(f"{path}: {name} is {shape}, not [{count} or more, {width}]: get the file again.")
    polygon, sub_type, light, agent = tables
    zeros = torch.zeros_like(sub_type[:1])
    adapted[maps[0]] = zeros.repeat(NUM_FAMILIES, 1)
    adapted[maps[1]] = polygon[list(TYPE_OF_OURS)] + sub_type[0] + light[0]
    adapted[maps[2]] = zeros.repeat(NUM_LIGHTS, 1)
    adapted[agents] = agent[: len(CLASS_NAMES)].clone()
    return adapted, sorted(weights.keys() - adapted.keys())


def _describe_file(path: Path) -> str:
    """Line with a file's sha256, and whether it is the published one.

    Raises:
        CheckpointError: The file is missing, a pointer of Git LFS, or far too large.
    """
    if not path.is_file():
        raise CheckpointError(f"{path}: no such file: name the folder catk_v120, with the folder tokens beside it.")
    if path.name != WEIGHTS and path.stat().st_size > _MAX_BYTES:
        raise CheckpointError(f"{path}: {path.stat().st_size} bytes, settings and tokens have less than {_MAX_BYTES}.")
    with path.open("rb") as file:
        if file.read(23) == b"version https://git-lfs":
            raise CheckpointError(f"{path}: a pointer of Git LFS, not the file: fetch it with `git lfs pull`.")
        file.seek(0)
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    published = "the published file" if PUBLISHED.get(path.name) == digest else "not a published file"
    return f"{path.name}: {published}, sha256 {digest}"


class _StoredArray:
    """Stand-in for numpy's arrays and types in a pickle, and for the functions that make them: runs none of these."""

    def __init__(self, *arguments: Any) -> None:
        self.arguments = arguments
        self.state: Any = ()

    def __setstate__(self, state: Any) -> None:
        self.state = state

    def unfold(self) -> np.ndarray:
        """The array of floats that is stored.

        Raises:
            ValueError: It is none; or a TypeError, AttributeError, KeyError or IndexError.
        """
        if self.state:
            _, shape, number, is_column_first, raw = self.state
        else:
            raw, number, shape, order = self.arguments
            is_column_first = order == "F"
        if number.arguments[0] not in ("f4", "f8") or number.state[1] != "<":
            raise ValueError(f"numbers of type {number.arguments[0]}")
        values = np.frombuffer(raw, f"<{number.arguments[0]}")
        return values.reshape(shape, order="F" if is_column_first else "C")


class _ArrayUnpickler(pickle._Unpickler):  # type: ignore[name-defined]  # its memo is a dict: no announced size is believed
    def find_class(self, module: str, name: str) -> type:
        if name not in _ARRAY_NAMES.get(module, ()):
            raise CheckpointError(f"refused, it holds {module}.{name}: token tables are dictionaries of numpy arrays")
        return _StoredArray


def read_pickled_arrays(path: Path) -> dict[str, Any]:
    """Dictionary of arrays, or of dictionaries of arrays, from a pickle. No code of the file is run.

    Raises:
        CheckpointError: Missing or damaged file, or one that holds anything but arrays of floats.
    """
    try:
        return _unfold(_ArrayUnpickler(io.BytesIO(path.read_bytes())).load(), depth=2)
    except CheckpointError as error:
        raise CheckpointError(f"{path}: {error}.") from None
    except Exception as error:  # whatever damage makes of the code that reads it
        raise CheckpointError(f"{path}: damaged or no token tables ({first_line(error)}): get it again.") from None


def _unfold(value: Any, depth: int) -> dict[str, Any]:
    """Arrays in place of stand-ins; values of other types are left out."""
    items = value.items() if isinstance(value, dict) else ()
    groups = {str(k): _unfold(v, depth - 1) for k, v in items if isinstance(v, dict) and depth > 1}
    return groups | {str(k): v.unfold() for k, v in items if isinstance(v, _StoredArray)}
