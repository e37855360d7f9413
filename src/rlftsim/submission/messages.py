"""Rollouts of a scenario as a serialized `ScenarioRollouts` message, and back, by copying arrays.

A packed float field is the bytes of its array, so a message is a header of a few bytes per array and the arrays.
Building Python lists of 340 000 numbers for each scenario would take a hundred times as long.

Shapes: N rollouts (scenes), A agents, T = 80 steps; 91 with sizes at each for generated scenes.
"""

import math
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
import torch
from google.protobuf.message import DecodeError
from jaxtyping import Float32, Int

from rlftsim.errors import DataError
from rlftsim.evaluation import submission_pb2
from rlftsim.evaluation.rollout_files import AXES
from rlftsim.realism import SCENARIO_GEN, SIM_AGENTS, Challenge, SimulatedStates

NUM_SCENES = 32
SIZES = ("width", "length", "height")
"""Sizes of generated agents, in the order of the message."""
_ARRAY_BYTES = {challenge: 4 * challenge.num_steps for challenge in (SIM_AGENTS, SCENARIO_GEN)}
_AXIS_KEYS = b"\x12\x1a\x22\x2a"
"""Keys of center_x, center_y, center_z and heading: field numbers 2 to 5, wire type 2."""
_SIZE_KEYS, _TYPE_KEY = b"\x3a\x42\x4a", b"\x50"
"""Keys of the sizes, field numbers 7 to 9, and of the object type, 10."""
_HEADING_FINER = 8
"""Headings are rounded to this fraction of the positions' step, in radians; at 8 m from the center they are equal."""
_ID_KEY, _FIRST_KEY, _SECOND_KEY = b"\x30", b"\x0a", b"\x12"


def round_states(states: SimulatedStates, round_m: float | None) -> SimulatedStates:
    """Positions rounded to a power of two of at most `round_m`, headings to an eighth of that step.

    Powers of two leave zeros in the last bits of a float, which compress to nothing.

    Args:
        states: Rollouts of a scenario.
        round_m: Largest step in meters, such as 0.001; None returns the states unchanged.
    """
    if round_m is None:
        return states
    step = 2.0 ** math.floor(math.log2(round_m))

    def rounded(values: torch.Tensor, unit: float) -> torch.Tensor:
        return (values.double() / unit).round().mul(unit).float()

    x, y, heading = rounded(states.x, step), rounded(states.y, step), rounded(states.heading, step / _HEADING_FINER)
    return replace(states, x=x, y=y, heading=heading)


def count_bytes(challenge: Challenge) -> int:
    """Bytes of one agent in one scene, with an object id below 128: arrays of floats, and a few bytes around them."""
    num_arrays = len(AXES) + len(SIZES) * challenge.makes_scenes
    return num_arrays * (3 + _ARRAY_BYTES[challenge]) + 5 + 2 * challenge.makes_scenes


def encode_varint(number: int) -> bytes:
    """A whole number in protobuf's base 128; a negative number takes ten bytes, as in an int32 field."""
    number &= (1 << 64) - 1
    digits = bytearray()
    while number >= 0x80:
        digits.append(number & 0x7F | 0x80)
        number >>= 7
    digits.append(number)
    return bytes(digits)


def encode_rollouts(
    scenario_id: str, states: SimulatedStates, object_type: Int[np.ndarray, "A"] | None = None
) -> bytes:
    """Serialized `ScenarioRollouts`, equal to what protobuf writes.

    Args:
        scenario_id: Name under which the server looks up the log.
        states: States of N rollouts; a rollout that stands for several is written several times.
        object_type: Type of each agent of generated scenes, which are written with sizes and types.

    Raises:
        DataError: An object id that does not fit the message's 32 bits.
    """
    wide = states.object_id[states.object_id != states.object_id.astype(np.int32)]
    if len(wide):
        raise DataError(
            f"scenario {scenario_id}: object id {wide[0]} does not fit the 32 bits that a submission has for it: give "
            "the objects smaller ids and convert again"
        )
    arrays = [getattr(states, axis).cpu().numpy() for axis in AXES]  # each [N, A, T]
    types = [0] * len(states.object_id)
    if states.size is not None:
        assert object_type is not None
        length, width, height = states.size.cpu().numpy().transpose(3, 0, 1, 2)
        arrays, types = [*arrays, width, length, height], object_type.tolist()
    as_bytes = [np.ascontiguousarray(a, np.dtype("<f4")).view(np.uint8) for a in arrays]  # each [N, A, 4 T]
    num_bytes = _ARRAY_BYTES[states.challenge]
    array_size = encode_varint(num_bytes)
    # Headers are the same in all scenes, so each is written into a column of all of them at once.
    columns: list[bytes | np.ndarray] = []
    for agent, (object_id, agent_type) in enumerate(zip(states.object_id.tolist(), types)):
        middle = _ID_KEY + encode_varint(object_id)
        tail = _TYPE_KEY + encode_varint(agent_type) if states.challenge.makes_scenes else b""
        size = len(arrays) * (1 + len(array_size) + num_bytes) + len(middle) + len(tail)
        columns.append(_FIRST_KEY + encode_varint(size))
        for number, (key, values) in enumerate(zip(_AXIS_KEYS + _SIZE_KEYS, as_bytes)):
            head = middle if number == len(AXES) else b""
            columns += [head + bytes([key]) + array_size, values[:, agent]]
        columns.append(tail or middle)
    scene_size = sum(c.shape[1] if isinstance(c, np.ndarray) else len(c) for c in columns)
    head = _SECOND_KEY + encode_varint(scene_size)
    scenes = np.empty((len(arrays[0]), len(head) + scene_size), np.uint8)  # [N, bytes]
    at = 0
    for column in (head, *columns):
        block = column if isinstance(column, np.ndarray) else np.frombuffer(column, np.uint8)
        scenes[:, at : at + block.shape[-1]] = block
        at += block.shape[-1]
    name = scenario_id.encode()
    return _FIRST_KEY + encode_varint(len(name)) + name + scenes.tobytes() * states.repeat


@dataclass(frozen=True)
class WrongLength:
    """An agent of a scene with arrays of another length than the challenge's."""

    scene: int
    object_id: int
    lengths: tuple[int, ...]
    """Lengths of x, y, z and heading, and of width, length and height of a generated agent."""


@dataclass(frozen=True, eq=False)
class DecodedRollouts:
    """Contents of a `ScenarioRollouts` message, right or wrong."""

    scenario_id: str
    object_ids: tuple[tuple[int, ...], ...]
    """Agents of each scene, in the order of the message."""
    wrong_lengths: tuple[WrongLength, ...]
    values: Float32[np.ndarray, "N A n T"] | None
    """x, y, z, heading, then sizes of generated agents as in `SIZES`; agents in the order of the first scene. None
    where scenes differ in agents or lengths."""
    challenge: Challenge = SIM_AGENTS
    """Challenge that the message is laid out for: that of scenes if an agent has a size or 91 steps."""
    has_types: bool = True
    """False where a generated agent has no type."""


def decode_rollouts(data: bytes) -> DecodedRollouts:
    """Contents of a serialized `ScenarioRollouts`, from any writer; fast for scenes that are laid out alike.

    Raises:
        DataError: Bytes that are no such message, or name no scenario.
    """
    uniform = _decode_uniform(data, SIM_AGENTS) or _decode_uniform(data, SCENARIO_GEN)
    return uniform or _decode_message(data)


def _decode_uniform(data: bytes, challenge: Challenge) -> DecodedRollouts | None:
    """Contents where all scenes have the layout of the first and fill the message; None for any other message."""
    array_bytes, num_arrays = _ARRAY_BYTES[challenge], len(AXES) + len(SIZES) * challenge.makes_scenes
    try:
        name, at = _payload(data, 0, _FIRST_KEY)
        first, stop = _payload(data, at, _SECOND_KEY)
        stride = stop - at
        num_scenes, remainder = divmod(len(data) - at, stride)
        if remainder:
            return None
        rows = np.frombuffer(data, np.uint8, offset=at).reshape(num_scenes, stride)
        # 1. the first scene: ids, and where in a row the arrays begin
        ids, starts = [], []  # [A], [A][arrays]
        position = first.start
        while position < first.stop:
            agent, position = _payload(data, position, _FIRST_KEY)
            inside, agent_starts, object_id = agent.start, [], -1
            for key in (_AXIS_KEYS + _SIZE_KEYS)[:num_arrays]:
                array, inside = _payload(data, inside, bytes([key]))
                if len(array) != array_bytes:
                    return None
                agent_starts.append(array.start - at)
                if len(agent_starts) == len(AXES):
                    object_id, inside = _read_number(data, inside, _ID_KEY)
            if challenge.makes_scenes:
                _, inside = _read_number(data, inside, _TYPE_KEY)
            if inside != agent.stop:
                return None
            ids.append((object_id + (1 << 31)) % (1 << 32) - (1 << 31))  # as an int32
            starts.append(agent_starts)
    except (IndexError, ValueError):
        return None
    # 2. all other bytes must be equal in all scenes
    is_number = np.zeros(stride, bool)
    for start in chain.from_iterable(starts):
        is_number[start : start + array_bytes] = True
    headers = rows[:, ~is_number]
    if not ids or not (headers == headers[0]).all():
        return None
    values = np.empty((num_scenes, len(ids), num_arrays, challenge.num_steps), np.dtype("<f4"))
    as_bytes = values.view(np.uint8)  # [N, A, arrays, 4 T]
    for agent, agent_starts in enumerate(starts):
        for axis, start in enumerate(agent_starts):
            as_bytes[:, agent, axis] = rows[:, start : start + array_bytes]
    return DecodedRollouts(as_text(data[name.start : name.stop]), (tuple(ids),) * num_scenes, (), values, challenge)


def _payload(data: bytes, position: int, key: bytes) -> tuple[range, int]:
    """Bytes of a field of wire type 2 at a position, and the position after the field."""
    if data[position : position + 1] != key:
        raise ValueError
    size, start = _varint(data, position + 1)
    if start + size > len(data):
        raise ValueError
    return range(start, start + size), start + size


def _read_number(data: bytes, position: int, key: bytes) -> tuple[int, int]:
    """Value of a field of wire type 0 at a position, and the position after the field."""
    if data[position : position + 1] != key:
        raise ValueError
    return _varint(data, position + 1)


def _varint(data: bytes, position: int) -> tuple[int, int]:
    """The number at a position, and the position after the number."""
    value = 0
    for shift in range(0, 70, 7):
        byte = data[position]
        value |= (byte & 0x7F) << shift
        position += 1
        if byte < 0x80:
            return value, position
    raise ValueError  # no number has more than 10 bytes


def as_text(value: str | bytes) -> str:
    """Text of a message; protobuf hands over bytes that are not UTF-8."""
    return value if isinstance(value, str) else value.decode("utf-8", "replace")


def _decode_message(data: bytes) -> DecodedRollouts:
    """Contents through protobuf's parser."""
    try:
        message = submission_pb2.ScenarioRollouts.FromString(data)
    except DecodeError as error:
        raise DataError(f"not a ScenarioRollouts message ({error})") from error
    if not message.HasField("scenario_id"):
        raise DataError("rollouts that name no scenario")
    trajectories = [agent for scene in message.joint_scenes for agent in scene.simulated_trajectories]
    is_generated = any(agent.width or len(agent.center_x) == SCENARIO_GEN.num_steps for agent in trajectories)
    challenge = SCENARIO_GEN if is_generated else SIM_AGENTS
    names = (*(f"center_{axis}" for axis in AXES[:3]), "heading", *(SIZES if is_generated else ()))
    scenes, ids, wrong_lengths = [], [], []
    for number, scene in enumerate(message.joint_scenes):
        arrays = {}
        ids.append(tuple(trajectory.object_id for trajectory in scene.simulated_trajectories))
        for trajectory in scene.simulated_trajectories:
            axes = [getattr(trajectory, name) for name in names]
            lengths = tuple(len(values) for values in axes)
            if any(length != challenge.num_steps for length in lengths):
                wrong_lengths.append(WrongLength(number, trajectory.object_id, lengths))
            else:
                arrays[trajectory.object_id] = np.array(axes, np.float32)  # [arrays, T]
        scenes.append(arrays)
    values = None
    # An id that is listed twice has one array: then the numbers of ids and of arrays differ.
    is_uniform = all(len(a) == len(agents) and a.keys() == scenes[0].keys() for a, agents in zip(scenes, ids))
    if scenes and scenes[0] and is_uniform:
        values = np.array([[arrays[object_id] for object_id in ids[0]] for arrays in scenes], np.float32)
    has_types = challenge == SIM_AGENTS or all(agent.HasField("object_type") for agent in trajectories)
    return DecodedRollouts(as_text(message.scenario_id), tuple(ids), tuple(wrong_lengths), values, challenge, has_types)
