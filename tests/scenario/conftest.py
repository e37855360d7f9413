from collections.abc import Callable
from dataclasses import fields, is_dataclass

import numpy as np
import pytest

from rlftsim.scenario import womd_pb2
from rlftsim.scenario.tfrecord import write_records
from womd_messages import build_message


@pytest.fixture
def make_message() -> Callable[..., womd_pb2.Scenario]:
    return build_message


@pytest.fixture
def make_tfrecord() -> Callable[..., None]:
    """Write messages (or bytes) as a tfrecord file."""

    def write(path, *messages):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_records(path, [m if isinstance(m, bytes) else m.SerializeToString() for m in messages])

    return write


def differing_fields(a, b, path="scenario") -> list[str]:
    """Names of the fields in which two scenarios differ by as much as a bit, a dtype or a shape."""
    if is_dataclass(a):
        return [
            d for f in fields(a) for d in differing_fields(getattr(a, f.name), getattr(b, f.name), f"{path}.{f.name}")
        ]
    if isinstance(a, np.ndarray):
        same = a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    else:
        same = a == b
    return [] if same else [path]


@pytest.fixture
def differences():
    return differing_fields
