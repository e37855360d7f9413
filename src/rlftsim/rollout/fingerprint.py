"""Which policy it was: a hash of weights and settings, equal for equal policies on any device."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass

import numpy as np
import torch
from torch import Tensor, nn


def fingerprint_policy(policy: object) -> str:
    """Hash of a policy's class, weights and public settings (numbers, texts, tensors, dataclasses of these).

    Returns:
        32 hexadecimal digits; for a policy without weights and settings they stand for its class alone.
    """
    digest = hashlib.blake2b(digest_size=16)
    _feed(digest, policy)
    return digest.hexdigest()


def _feed(digest: "hashlib.blake2b", value: object) -> None:
    if isinstance(value, Tensor):
        array = value.detach().cpu().contiguous()
        digest.update(f"tensor {array.dtype} {tuple(array.shape)}".encode())
        digest.update(array.reshape(-1).view(torch.uint8).numpy().tobytes())
    elif isinstance(value, np.ndarray):
        digest.update(f"array {value.dtype} {value.shape}".encode() + np.ascontiguousarray(value).tobytes())
    elif isinstance(value, Mapping):
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
    """Class, weights and what is kept in public attributes."""
    digest.update(f"object {type(value).__module__}.{type(value).__qualname__}".encode())
    if is_dataclass(value) and not isinstance(value, type):
        _feed(digest, {field.name: getattr(value, field.name) for field in fields(value)})
        return
    own = (
        {name: item for name, item in vars(value).items() if not name.startswith("_")} if _keeps_settings(value) else {}
    )
    if isinstance(value, nn.Module):
        own.pop("training", None)
        _feed(digest, value.state_dict())
    _feed(digest, own)


def _keeps_settings(value: object) -> bool:
    is_code = isinstance(value, type) or (callable(value) and not isinstance(value, nn.Module))
    return hasattr(value, "__dict__") and not is_code
