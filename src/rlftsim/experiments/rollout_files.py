"""Anybody's rollouts from files: npz of one scenario, or submission files of the Sim Agents challenge.

`find_rollouts` says what is there without reading trajectories; `read_states` reads one scenario's. Pickles are never
loaded, because loading one runs whatever code its author put in: docs/rollout_formats.md says how to convert them.
"""

import re
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from google.protobuf.message import DecodeError

from rlftsim.errors import DataError
from rlftsim.experiments import submission_pb2
from rlftsim.experiments.wire_format import BYTES, WireField, iterate_fields
from rlftsim.realism import SimulatedStates
from rlftsim.scenario.types import FUTURE_STEPS

FORMATS_NOTE = "see docs/rollout_formats.md"
AXES = ("x", "y", "z", "heading")
_KEYS = ("scenario_id", "object_ids", *AXES)
_SUBMISSION_NAME = re.compile(r"\.(binproto|pb)(-\d+-of-\d+)?$")
_PICKLE_NAME = re.compile(r"\.(pkl|pickle|pt|pth|ckpt|joblib)$")
_ZIP_MAGIC, _GZIP_MAGIC, _PICKLE_MAGIC = b"PK\x03\x04", b"\x1f\x8b", tuple(b"\x80" + bytes([n]) for n in range(2, 6))
_NPZ_DAMAGE = (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error, MemoryError, OverflowError, RuntimeError)

Kind = Literal["npz", "submission"]


@dataclass(frozen=True)
class RolloutEntry:
    """Where one scenario's rollouts are."""

    scenario_id: str
    file: Path
    kind: Kind
    start: int = 0
    """First byte of the scenario's message in a submission file."""
    stop: int = 0

    def __str__(self) -> str:
        return f"{self.file} (scenario {self.scenario_id})"


def find_rollouts(source: Path) -> list[RolloutEntry]:
    """Scenarios that have rollouts in a file or folder, by path and place in the file.

    Args:
        source: an npz, a submission file of any name, or a folder with such files in it or its subfolders (`*.npz`,
            `*.binproto`, `*.binproto-00000-of-00150`, `*.pb`).

    Raises:
        DataError: nothing there, a pickle, an archive that has to be unpacked, or a damaged file.
    """
    return [entry for path in _find_files(Path(source)) for entry in _entries_of(path)]


def read_states(entry: RolloutEntry) -> SimulatedStates:
    """One scenario's rollouts, checked to be finite numbers.

    Raises:
        DataError: wrong shapes, keys or numbers of steps, agents that differ between rollouts, values that are no
            numbers; the message names the file and the scenario.
    """
    try:
        states = _states_of_npz(entry) if entry.kind == "npz" else _states_of_submission(entry)
        states.check_finite()
    except DataError as error:
        raise DataError(f"{entry}: {error}") from error
    return states


def _find_files(source: Path) -> list[Path]:
    if source.is_file():
        return [source]
    if not source.is_dir():
        raise DataError(f"{source}: there is no such file or folder of rollouts.")
    names = sorted(path for path in source.rglob("*") if path.is_file() and not path.name.startswith("."))
    files = [path for path in names if path.suffix == ".npz" or _SUBMISSION_NAME.search(path.name)]
    if files:
        return files
    pickles = [path for path in names if _PICKLE_NAME.search(path.name)]
    if pickles:
        raise _pickle_error(pickles[0])
    raise DataError(f"{source}: no rollouts in this folder, neither *.npz nor *.binproto: {FORMATS_NOTE}.")


def _pickle_error(path: Path) -> DataError:
    return DataError(
        f"{path} is a pickle. Loading one runs any code that is in it, so pickles are not read: convert it to npz, "
        f"{FORMATS_NOTE}."
    )


def _entries_of(path: Path) -> list[RolloutEntry]:
    try:
        with path.open("rb") as file:
            magic = file.read(4)
    except OSError as error:
        raise DataError(f"{path}: cannot be opened: {error.strerror}") from error
    if magic.startswith(_GZIP_MAGIC):
        raise DataError(f"{path} is compressed: unpack it first (tar xzf), then give the folder of its files.")
    if _PICKLE_NAME.search(path.name) or magic.startswith(_PICKLE_MAGIC):
        raise _pickle_error(path)
    if magic == _ZIP_MAGIC or path.suffix == ".npz":
        return [RolloutEntry(_scenario_id_of_npz(path), path, "npz")]
    try:
        return list(_entries_of_submission(path))
    except DataError as error:
        raise DataError(f"{path}: neither npz nor a submission file ({error}): {FORMATS_NOTE}.") from error


def _scenario_id_of_npz(path: Path) -> str:
    value = _read_npz(path, ("scenario_id",))["scenario_id"]
    if value.size != 1 or value.dtype.kind not in "US":
        raise DataError(f"{path}: scenario_id must be one text, got {value.dtype} {list(value.shape)}.")
    text = value.reshape(-1)[0]
    return text.decode("utf-8", "replace") if isinstance(text, bytes) else str(text)


def _read_npz(path: Path, keys: Sequence[str]) -> dict[str, np.ndarray]:
    """Some arrays of an npz, none of which may need a pickle."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise DataError(f"{path}: a single array, not an npz with keys {', '.join(_KEYS)}.")
            missing = [key for key in keys if key not in archive.files]
            if missing:
                raise DataError(f"{path}: no {', '.join(missing)} in it, only {', '.join(archive.files) or 'nothing'}.")
            return {key: archive[key] for key in keys}
    except _NPZ_DAMAGE as error:
        looks_pickled = isinstance(error, ValueError) and "pickle" in str(error)
        cause = "an array of Python objects, or not an npz at all; neither is read" if looks_pickled else error
        raise DataError(f"{path}: not a readable npz ({cause}).") from error


def _states_of_npz(entry: RolloutEntry) -> SimulatedStates:
    arrays = _read_npz(entry.file, _KEYS[1:])
    ids = arrays.pop("object_ids")
    if ids.ndim != 1 or ids.dtype.kind not in "iu":
        raise DataError(f"object_ids must be whole numbers [A], got {ids.dtype} {list(ids.shape)}.")
    expected = (len(ids), FUTURE_STEPS)
    for axis, values in arrays.items():
        if values.dtype.kind != "f" or values.ndim != 3 or values.shape[1:] != expected or not len(values):
            raise DataError(
                f"{axis} must be floats [N, A, {FUTURE_STEPS}] with A = {len(ids)} as in object_ids, "
                f"got {values.dtype} {list(values.shape)}."
            )
    numbers = [len(values) for values in arrays.values()]
    if len(set(numbers)) > 1:
        raise DataError(
            f"x, y, z and heading hold {', '.join(map(str, numbers))} rollouts: there must be equally many."
        )
    with np.errstate(over="ignore"):  # what becomes infinite is refused by name
        x, y, z, heading = (torch.from_numpy(np.ascontiguousarray(arrays[axis], np.float32)) for axis in AXES)
    return SimulatedStates(ids.astype(np.int64), x, y, z, heading)


def _entries_of_submission(path: Path) -> Iterator[RolloutEntry]:
    """Scenarios of a serialized SimAgentsChallengeSubmission, or the one of a serialized ScenarioRollouts."""
    size = path.stat().st_size
    with path.open("rb") as file:
        fields = list(iterate_fields(file, 0, size))
        # A submission's field 2 is a number (its type), that of ScenarioRollouts the rollouts themselves.
        if any(field.number == 2 and field.wire_type == BYTES for field in fields):
            messages = [WireField(1, BYTES, 0, size)]
        else:
            messages = [field for field in fields if field.number == 1 and field.wire_type == BYTES]
        if not messages:
            raise DataError("it holds no rollouts")
        for message in messages:
            names = [
                f for f in iterate_fields(file, message.start, message.stop) if (f.number, f.wire_type) == (1, BYTES)
            ]
            if len(names) != 1:
                raise DataError(f"the rollouts at byte {message.start} name no scenario")
            file.seek(names[0].start)
            name = file.read(names[0].stop - names[0].start).decode("utf-8", "replace")
            yield RolloutEntry(name, path, "submission", message.start, message.stop)


def _states_of_submission(entry: RolloutEntry) -> SimulatedStates:
    with entry.file.open("rb") as file:
        file.seek(entry.start)
        data = file.read(entry.stop - entry.start)
    try:
        message = submission_pb2.ScenarioRollouts.FromString(data)
    except DecodeError as error:
        raise DataError(f"not a ScenarioRollouts message ({error})") from error
    if not message.joint_scenes:
        raise DataError("no joint scene in it")
    scenes = [_trajectories_by_id(scene, rollout) for rollout, scene in enumerate(message.joint_scenes)]
    ids = list(scenes[0])
    for rollout, scene in enumerate(scenes):
        if scene.keys() != scenes[0].keys():
            other = sorted(scene.keys() ^ scenes[0].keys())
            raise DataError(f"rollout {rollout} has other agents than rollout 0: object id {other[0]} is in one only.")
    values = np.array([[scene[object_id] for object_id in ids] for scene in scenes], np.float32)
    values = values.reshape(len(scenes), len(ids), len(AXES), FUTURE_STEPS)
    x, y, z, heading = (torch.from_numpy(np.ascontiguousarray(values[:, :, axis])) for axis in range(len(AXES)))
    return SimulatedStates(np.array(ids, np.int64), x, y, z, heading)


def _trajectories_by_id(scene: submission_pb2.JointScene, rollout: int) -> dict[int, np.ndarray]:
    """x, y, z and heading of each agent, [4, 80]."""
    found: dict[int, np.ndarray] = {}
    for trajectory in scene.simulated_trajectories:
        fields = (trajectory.center_x, trajectory.center_y, trajectory.center_z, trajectory.heading)
        lengths = [len(values) for values in fields]
        where = f"object id {trajectory.object_id} in rollout {rollout}"
        if not trajectory.HasField("object_id") or trajectory.object_id in found:
            raise DataError(f"{where}: an agent without an id, or listed twice.")
        if lengths != [FUTURE_STEPS] * len(AXES):
            raise DataError(f"{where}: x, y, z, heading have {lengths} steps, {FUTURE_STEPS} are needed.")
        if not all(trajectory.valid):
            raise DataError(f"{where}: invalid steps; in the Sim Agents challenge every agent exists at all steps.")
        found[trajectory.object_id] = np.array(fields, np.float32)
    return found
