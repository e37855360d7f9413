"""Fingerprints of policies: hashes of weights and settings, equal for equal policies on any device."""

import hashlib
import inspect
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, is_dataclass

import numpy as np
import torch
from torch import Tensor, nn

from rlftsim.plugins import is_ours


def fingerprint_policy(policy: object) -> str:
    """Hash of a policy's architecture, weights and public settings (numbers, texts, tensors, dataclasses of these).

    Moving code must leave the fingerprints of stored models valid. So a class is hashed under the declared name,
    `fingerprint_name` or else `architecture`, and without either under module and name. Classes of nested settings
    count too. A base class's name does not stand for a subclass, which is different code. Of a policy of another
    package without a `fingerprint_name` the file counts that defines it, as an edit may make it decide otherwise; in a
    notebook there is none.

    Args:
        policy: Policy of any class; the bytes of weights count, whatever the device.

    Returns:
        32 hexadecimal digits; for a policy without weights and settings a hash of the architecture alone.
    """
    digest = hashlib.blake2b(digest_size=16)
    _feed(digest, policy)
    for part in (policy, *(getattr(policy, name) for name in getattr(type(policy), "fingerprint_parts", ()))):
        cls = type(part)
        if not is_ours(cls) and "fingerprint_name" not in vars(cls):
            with suppress(TypeError, OSError, KeyError):  # in a notebook there is no file
                digest.update(inspect.getsource(sys.modules[cls.__module__]).encode())
    return digest.hexdigest()


def _feed(digest: "hashlib.blake2b", value: object) -> None:
    if isinstance(value, Tensor):
        # bytes, not values: NaN and -0.0 count, and nothing is rounded
        array = value.detach().cpu().contiguous()
        digest.update(f"tensor {array.dtype} {tuple(array.shape)}".encode())
        digest.update(array.reshape(-1).view(torch.uint8).numpy().tobytes())
    elif isinstance(value, np.ndarray):
        digest.update(f"array {value.dtype} {value.shape}".encode() + np.ascontiguousarray(value).tobytes())
    elif isinstance(value, Mapping):
        # order of insertion does not count
        for key in sorted(value, key=str):
            digest.update(f"key {key}".encode())
            _feed(digest, value[key])
    elif isinstance(value, str | bool | int | float | None):
        digest.update(f"{type(value).__name__} {value!r}".encode())
    elif isinstance(value, Sequence):
        digest.update(f"sequence {len(value)}".encode())
        for item in value:
            _feed(digest, item)
    else:
        _feed_object(digest, value)


def _feed_object(digest: "hashlib.blake2b", value: object) -> None:
    """Feed a class's name, weights and public attributes."""
    cls = type(value)
    declared = (vars(cls).get(name) for name in ("fingerprint_name", "architecture"))
    default = f"{cls.__module__}.{cls.__qualname__}"
    digest.update(f"object {next((name for name in declared if isinstance(name, str)), default)}".encode())
    if is_dataclass(value) and not isinstance(value, type):
        _feed(digest, {field.name: getattr(value, field.name) for field in fields(value)})
        return
    is_code = isinstance(value, type) or (callable(value) and not isinstance(value, nn.Module))
    attributes = {} if is_code else getattr(value, "__dict__", {})
    settings = {name: item for name, item in attributes.items() if not name.startswith("_")}
    if isinstance(value, nn.Module):
        # mode is no setting; submodules are private attributes, so weights come in through the state dict alone
        settings.pop("training", None)
        # a submodule with settings is declared by the class
        settings |= {name: getattr(value, name) for name in getattr(cls, "fingerprint_parts", ())}
        _feed(digest, value.state_dict())
    _feed(digest, settings)
