"""Rollouts in files, from any simulator: npz of a scenario, or submission files of the Sim Agents challenge.

`find_rollouts` lists the scenarios without reading trajectories; `read_states` reads the rollouts of a scenario. No
pickle is ever loaded, because loading runs any code in the file: docs/rollout_formats.md explains the conversion.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from google.protobuf.message import DecodeError

from rlftsim.errors import DataError
from rlftsim.evaluation import submission_pb2
from rlftsim.evaluation.wire_format import BYTES, MAX_FIELD_BYTES, WireField, iterate_fields
from rlftsim.jobs.arrays import read_npz
from rlftsim.jobs.documents import check_has_end
from rlftsim.jobs.files import describe_type, list_folder
from rlftsim.realism import SimulatedStates
from rlftsim.realism.agents import check_closed
from rlftsim.rollout.decisions import MAX_COORDINATE_M
from rlftsim.scenario.types import FUTURE_STEPS, STEP_S

FORMATS_NOTE = "see docs/rollout_formats.md"
AXES = ("x", "y", "z", "heading")
MAX_ID_LENGTH = 200
"""Characters of a scenario's id, which names files."""
_KEYS = ("scenario_id", "object_ids", *AXES)
_SUBMISSION_NAME = re.compile(r"\.(binproto|pb)(-\d+-of-\d+)?$")
_PICKLE_NAME = re.compile(r"\.(pkl|pickle|pt|pth|ckpt|joblib)$")
_ZIP_MAGIC, _GZIP_MAGIC, _PICKLE_MAGIC = b"PK\x03\x04", b"\x1f\x8b", tuple(b"\x80" + bytes([n]) for n in range(2, 6))

FileFormat = Literal["npz", "submission"]


@dataclass(frozen=True)
class RolloutEntry:
    """Location of a scenario's rollouts."""

    scenario_id: str
    file: Path
    format: FileFormat
    start: int = 0
    """First byte of the scenario's message in a submission file."""
    stop: int = 0

    def __str__(self) -> str:
        return f"{self.file} (scenario {self.scenario_id})"


def find_rollouts(source: str | PathLike[str]) -> list[RolloutEntry]:
    """Scenarios that have rollouts in a file or folder, by path and position in the file.

    Args:
        source: An npz, a submission file of any name, or a folder with such files at any depth (`*.npz`, `*.binproto`,
            `*.binproto-00000-of-00150`, `*.pb`).

    Raises:
        DataError: No rollouts, a pickle, an archive that has to be unpacked, or a damaged file.
    """
    source = Path(source)
    if source.is_file():
        return list(_list_entries(source))
    if not source.is_dir():
        raise DataError(f"{source}: {describe_type(source)}: name a file or folder of rollouts.")
    # hidden files are those that a writer has not finished, or an editor's
    paths = sorted(path for path in list_folder(source) if path.is_file() and not path.name.startswith("."))
    files = [path for path in paths if path.suffix == ".npz" or _SUBMISSION_NAME.search(path.name)]
    pickles = [path for path in paths if _PICKLE_NAME.search(path.name)]
    if not files and pickles:
        raise _pickle_error(pickles[0])
    if not files:
        raise DataError(f"{source}: no rollouts in this folder, neither *.npz nor *.binproto: {FORMATS_NOTE}.")
    return [entry for path in files for entry in _list_entries(path)]


def read_states(entry: RolloutEntry, num_steps: int | None = FUTURE_STEPS) -> SimulatedStates:
    """Rollouts of a scenario, checked to be finite numbers within `MAX_COORDINATE_M` of the origin.

    Args:
        entry: Location of the rollouts.
        num_steps: Number of steps that the rollouts must have, by default those of the metric; None = any.

    Raises:
        DataError: Wrong shapes, keys or numbers of steps, agents that differ between rollouts, values that are no
            numbers or out of range; the message names the file and the scenario.
    """
    try:
        states = _states_of_npz(entry, num_steps) if entry.format == "npz" else _states_of_submission(entry)
        states.check_finite()
        for axis in AXES[:3]:
            values = getattr(states, axis)  # [N, A, T]
            outliers = (values.abs() > MAX_COORDINATE_M).nonzero()
            if len(outliers):
                rollout, agent, step = outliers[0].tolist()
                raise DataError(
                    f"{axis} of object id {states.object_id[agent]} in rollout {rollout} at future step {step} is "
                    f"{float(values[rollout, agent, step]):.6g} m, more than {MAX_COORDINATE_M:g} m from the origin: "
                    "positions must be meters in the world frame of the scenario."
                )
    except DataError as error:
        # errors of the whole file begin with its name already
        text, file = str(error), str(entry.file)
        raise DataError(f"{entry}{text[len(file) :] if text.startswith(file) else f': {text}'}") from error
    return states


def _pickle_error(path: Path) -> DataError:
    return DataError(
        f"{path} is a pickle. Loading one runs any code that is in it, so pickles are not read: convert it to npz, "
        f"{FORMATS_NOTE}."
    )


def _list_entries(path: Path) -> list[RolloutEntry]:
    try:
        check_has_end(path)
        with path.open("rb") as file:
            magic = file.read(4)
    except OSError as error:
        raise DataError(f"{path}: cannot be opened: {error.strerror}") from error
    # The content decides, names only where it cannot: any file may be called rollouts.bin.
    if magic.startswith(_GZIP_MAGIC):
        raise DataError(f"{path} is compressed: unpack it first (tar xzf), then give the folder of its files.")
    if _PICKLE_NAME.search(path.name) or magic.startswith(_PICKLE_MAGIC):
        raise _pickle_error(path)
    if magic == _ZIP_MAGIC or path.suffix == ".npz":
        value = _read_npz(path, ("scenario_id",))["scenario_id"]
        if value.size != 1 or value.dtype.kind not in "US":
            raise DataError(f"{path}: scenario_id must be one text, got {value.dtype} {list(value.shape)}.")
        text = value.reshape(-1)[0]
        try:
            scenario_id = text.decode("utf-8", "replace") if isinstance(text, bytes) else str(text)
        except ValueError:  # a number that is no character
            scenario_id = ""
        if not scenario_id.isprintable() or not 0 < len(scenario_id) <= MAX_ID_LENGTH:
            raise DataError(f"{path}: scenario_id is no text of 1 to {MAX_ID_LENGTH} printable characters.")
        return [RolloutEntry(scenario_id, path, "npz")]
    try:
        return list(_entries_of_submission(path))
    except DataError as error:
        raise DataError(f"{path}: neither npz nor a submission file ({error}): {FORMATS_NOTE}.") from error


def _read_npz(path: Path, keys: Sequence[str]) -> dict[str, np.ndarray]:
    """Arrays of an npz by key, without a pickle."""
    try:
        arrays = read_npz(path, keys, f"no rollouts file, write it again as npz, {FORMATS_NOTE}")
    except FileNotFoundError:
        raise DataError(f"{path}: there is no such file of rollouts.") from None
    missing = [key for key in keys if key not in arrays]
    if missing:
        raise DataError(f"{path}: no {', '.join(missing)} in it: rollouts have {', '.join(_KEYS)}, {FORMATS_NOTE}.")
    return arrays


def _states_of_npz(entry: RolloutEntry, num_steps: int | None) -> SimulatedStates:
    arrays = _read_npz(entry.file, _KEYS[1:])
    valid = read_npz(entry.file, ("valid",), "write it again").get("valid")
    if num_steps == FUTURE_STEPS:
        check_closed(valid)
    ids = arrays.pop("object_ids")
    if ids.ndim != 1 or ids.dtype.kind not in "iu":
        raise DataError(f"object_ids must be whole numbers [A], got {ids.dtype} {list(ids.shape)}.")
    unique, counts = np.unique(ids, return_counts=True)
    if (counts > 1).any():
        repeated = ", ".join(map(str, unique[counts > 1][:8]))
        raise DataError(f"object_ids must differ: {repeated} listed twice.")
    lengths = {values.shape[-1] for values in arrays.values() if values.ndim == 3}
    if num_steps is not None and len(lengths) == 1 and num_steps not in lengths:
        raise DataError(
            f"rollouts of {min(lengths) * STEP_S:g} s ({min(lengths)} steps), where {num_steps * STEP_S:g} s are "
            f"compared with the log: simulate {num_steps * STEP_S:g} seconds, and leave the history out."
        )
    expected = (len(ids), *(arrays["x"].shape[2:] if num_steps is None else [num_steps]))  # of [N, A, T] without N
    for axis, values in arrays.items():
        if values.dtype.kind != "f" or values.ndim != 3 or values.shape[1:] != expected or not len(values):
            raise DataError(
                f"{axis} must be floats [N, A, {num_steps or 'T'}] with A = {len(ids)} as in object_ids, "
                f"got {values.dtype} {list(values.shape)}."
            )
    numbers = [len(values) for values in arrays.values()]
    if len(set(numbers)) > 1:
        text = ", ".join(map(str, numbers))
        raise DataError(f"x, y, z and heading hold {text} rollouts: there must be equally many.")
    if valid is not None and (valid.dtype.kind != "b" or valid.shape != arrays["x"].shape):
        raise DataError(f"valid must be true or false in the shape of x, got {valid.dtype} {list(valid.shape)}.")
    with np.errstate(over="ignore"):  # what becomes infinite is refused by name
        x, y, z, heading = (torch.from_numpy(np.ascontiguousarray(arrays[axis], np.float32)) for axis in AXES)
    presence = None if valid is None else torch.from_numpy(valid)
    return SimulatedStates(ids.astype(np.int64), x, y, z, heading, valid=presence)


def _entries_of_submission(path: Path) -> Iterator[RolloutEntry]:
    """Scenarios of a serialized SimAgentsChallengeSubmission, or the scenario of a serialized ScenarioRollouts."""
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
            # ScenarioRollouts: field 1 is the scenario's id
            message_fields = iterate_fields(file, message.start, message.stop)
            names = [field for field in message_fields if (field.number, field.wire_type) == (1, BYTES)]
            if len(names) != 1 or names[0].stop - names[0].start > MAX_ID_LENGTH:
                raise DataError(f"the rollouts at byte {message.start} name no scenario")
            file.seek(names[0].start)
            name = file.read(names[0].stop - names[0].start).decode("utf-8", "replace")
            yield RolloutEntry(name, path, "submission", message.start, message.stop)


def _states_of_submission(entry: RolloutEntry) -> SimulatedStates:
    if entry.stop - entry.start > MAX_FIELD_BYTES:
        raise DataError(f"its message is {(entry.stop - entry.start) / 1e9:.3g} GB, more than any scenario's")
    with entry.file.open("rb") as file:
        file.seek(entry.start)
        data = file.read(entry.stop - entry.start)
    try:
        message = submission_pb2.ScenarioRollouts.FromString(data)
    except DecodeError as error:
        raise DataError(f"not a ScenarioRollouts message ({error})") from error
    if not message.joint_scenes:
        raise DataError("no joint scene in it")
    # Agents may be listed in another order in every rollout.
    scenes = [_trajectories_by_id(scene, rollout) for rollout, scene in enumerate(message.joint_scenes)]
    ids = list(scenes[0])
    for rollout, scene in enumerate(scenes):
        if scene.keys() != scenes[0].keys():
            differing = min(scene.keys() ^ scenes[0].keys())
            raise DataError(f"rollout {rollout} has other agents than rollout 0: object id {differing} is in one only.")
    values = np.array([[scene[object_id] for object_id in ids] for scene in scenes], np.float32)  # [N, A, 4, 80]
    # for an empty list of agents, whose array has lost its last axes
    values = values.reshape(len(scenes), len(ids), len(AXES), FUTURE_STEPS)
    x, y, z, heading = (torch.from_numpy(np.ascontiguousarray(values[:, :, axis])) for axis in range(len(AXES)))
    return SimulatedStates(np.array(ids, np.int64), x, y, z, heading)


def _trajectories_by_id(scene: submission_pb2.JointScene, rollout: int) -> dict[int, np.ndarray]:
    """x, y, z and heading of each agent, [4, 80]."""
    trajectories: dict[int, np.ndarray] = {}
    for trajectory in scene.simulated_trajectories:
        fields = (trajectory.center_x, trajectory.center_y, trajectory.center_z, trajectory.heading)
        lengths = [len(values) for values in fields]
        location = f"object id {trajectory.object_id} in rollout {rollout}"
        if not trajectory.HasField("object_id") or trajectory.object_id in trajectories:
            raise DataError(f"{location}: an agent without an id, or listed twice.")
        if lengths != [FUTURE_STEPS] * len(AXES):
            raise DataError(f"{location}: x, y, z, heading have {lengths} steps, {FUTURE_STEPS} are needed.")
        if not all(trajectory.valid):
            raise DataError(f"{location}: invalid steps; in the Sim Agents challenge every agent exists at all steps.")
        trajectories[trajectory.object_id] = np.array(fields, np.float32)
    return trajectories
