"""Tensors and arrays from files that anybody may have written, damaged or edited.

The only module that opens safetensors and npz files. Both formats announce sizes before contents, and neither runs
code.
"""

import math
import struct
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from os import PathLike

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from rlftsim.errors import DataError, RlftsimError
from rlftsim.jobs.documents import explained_damage, first_line

MAX_ARRAY_BYTES = 1 << 30
"""Most bytes that arrays read together from one npz may unfold to; zeros are packed a thousand times smaller."""
_FLOATS = {torch.float16, torch.bfloat16, torch.float32, torch.float64}
"""Types that convert into each other; a float of 8 bits is no weight."""
_TENSOR_DAMAGE = (SafetensorError, OSError, ValueError, TypeError, KeyError, AttributeError, RuntimeError, MemoryError)
_ARRAY_DAMAGE = (
    *(OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error, MemoryError, OverflowError, RuntimeError),
    *(SyntaxError, TypeError, KeyError, struct.error, tokenize.TokenError),  # of headers
)


def read_tensors(
    path: str | PathLike[str], remedy: str, *, error: type[RlftsimError] = DataError, missing: str = ""
) -> tuple[dict[str, Tensor], Mapping[str, str]]:
    """Tensors of a safetensors file by name, on the CPU, and the texts in the header.

    Args:
        path: Safetensors file; the header is checked against the size of the file before any tensor is made.
        remedy: Way out at the end of every message, such as "write it again".
        error: Class of the errors raised.
        missing: Whole message where there is no such file; empty leaves it to the caller.

    Raises:
        FileNotFoundError: No such file, without `missing`; the caller names the file in the message.
        RlftsimError: Damaged file, or no such file.
    """
    words = ": damaged safetensors file"
    with (
        explained_damage(path, _TENSOR_DAMAGE, remedy, words=words, error=error, missing=missing),
        safe_open(path, "pt") as file,
    ):
        return {name: file.get_tensor(name) for name in file.keys()}, file.metadata() or {}  # noqa: SIM118


def find_misfits(
    tensors: Mapping[str, Tensor], expected: Mapping[str, Tensor], *, may_convert: bool = False
) -> list[str]:
    """Names, shapes and number types by which tensors are not those of a module, a text for each.

    Args:
        tensors: Tensors by name, as in a file.
        expected: State dict of the module, maybe on no device; only names, shapes and types are read.
        may_convert: True = floats may have another precision.
    """
    problems = [f"missing {name}" for name in sorted(expected.keys() - tensors.keys())]
    problems += [f"unknown {name[:100]}" for name in sorted(tensors.keys() - expected.keys())]
    for name in sorted(expected.keys() & tensors.keys()):
        tensor, counterpart = tensors[name], expected[name]
        are_floats = {tensor.dtype, counterpart.dtype} <= _FLOATS
        if tensor.shape != counterpart.shape:
            problems.append(f"{name} has shape {tuple(tensor.shape)} instead of {tuple(counterpart.shape)}")
        elif tensor.dtype != counterpart.dtype and not (may_convert and are_floats):
            problems.append(f"{name} is {tensor.dtype} instead of {counterpart.dtype}")
    return problems


def read_npz(
    path: str | PathLike[str], names: Sequence[str], remedy: str, *, error: type[RlftsimError] = DataError
) -> dict[str, np.ndarray]:
    """Arrays of an npz by name; names that the file lacks are missing in the result.

    Args:
        path: Npz file, packed or not.
        names: Arrays to read; all headers are checked before any contents are read.
        remedy: Way out at the end of every message, such as "write it again".
        error: Class of the errors raised.

    Raises:
        FileNotFoundError: No such file; the caller names the file in the message.
        RlftsimError: No npz, damaged, an array of Python objects, or an array that unfolds to more than
            `MAX_ARRAY_BYTES`.
    """
    with (
        explained_damage(path, _ARRAY_DAMAGE, remedy, describe=_describe_cause, error=error),
        warnings.catch_warnings(action="ignore"),  # numpy and Python warn of odd headers
        zipfile.ZipFile(path) as archive,
    ):
        members = {name: archive.getinfo(f"{name}.npy") for name in names if f"{name}.npy" in archive.namelist()}
        num_bytes = sum(_read_header(archive, member) for member in members.values())
        if num_bytes > MAX_ARRAY_BYTES:
            raise ValueError(f"its arrays unfold to {num_bytes / 1e9:.3g} GB")
        arrays = {}
        for name, member in members.items():
            with archive.open(member) as file:
                arrays[name] = np.lib.format.read_array(file, allow_pickle=False)  # pyright: ignore
        return arrays


def _describe_cause(problem: BaseException) -> str:
    is_cut = isinstance(problem, zipfile.BadZipFile | EOFError)
    return "it is not an npz archive, or cut off" if is_cut else first_line(problem)


def _read_header(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> int:
    """Bytes of an array by the header, checked against the bytes of the array's entry in the archive.

    Raises:
        ValueError: The array holds Python objects, or the two sizes differ.
    """
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
        size = math.prod(shape) * dtype.itemsize
        if dtype.hasobject:
            raise ValueError(f"{member.filename} holds Python objects")
        if size + file.tell() != member.file_size or min(shape, default=0) < 0:
            raise ValueError(f"{member.filename} announces an array of another size")
    return size
