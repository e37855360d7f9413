"""Rollouts of a scenario as a serialized `ScenarioRollouts` message, and back, by copying arrays.

A packed float field is the bytes of its array, so a message is a header of a few bytes per array and the arrays.
Building Python lists of 340 000 numbers for each scenario would take a hundred times as long.

Shapes: N rollouts (scenes), A agents, T = 80 steps; 91 with sizes at each for generated scenes.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from io import BytesIO

import numpy as np
import torch
from google.protobuf.message import DecodeError
from jaxtyping import Float32, Int, UInt8

from rlftsim.errors import DataError
from rlftsim.evaluation import submission_pb2
from rlftsim.evaluation.rollout_files import AXES
from rlftsim.evaluation.wire_format import BYTES, iterate_fields
from rlftsim.realism import SCENARIO_GEN, SIM_AGENTS, Challenge, SimulatedStates

NUM_SCENES = 32
SIZES = ("width", "length", "height")
"""Sizes of generated agents, in the order of the message."""
_POSE_NAMES = ("center_x", "center_y", "center_z", "heading")
_HEADING_FINER = 8
"""Headings are rounded to this fraction of the positions' step, in radians; at 8 m from the center they are equal."""


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
    return num_arrays * (3 + 4 * challenge.num_steps) + 5 + 2 * challenge.makes_scenes


def encode_varint(number: int) -> bytes:
    """A whole number of 0 or more in protobuf's base 128."""
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
    arrays = [getattr(states, axis) for axis in AXES]  # each [N, A, T]
    types = [0] * len(states.object_id)
    if states.size is not None:
        assert object_type is not None
        length, width, height = states.size.unbind(-1)
        arrays, types = [*arrays, width, length, height], object_type.tolist()
    values = torch.stack(arrays, 2).flatten(1, 2).cpu().numpy().astype("<f4", copy=False)  # [N, A arrays, T]
    layout, starts = _lay_out_scene(states.object_id.tolist(), types, states.challenge)
    scenes = np.repeat(layout[:1], len(values), 0)  # [N, bytes]
    for array, start in zip(values.view(np.uint8).swapaxes(0, 1), starts):
        scenes[:, start : start + array.shape[1]] = array
    name = submission_pb2.ScenarioRollouts(scenario_id=scenario_id)
    return name.SerializeToString() + scenes.tobytes() * states.repeat


def _lay_out_scene(
    object_ids: Sequence[int], object_types: Sequence[int], challenge: Challenge
) -> tuple[UInt8[np.ndarray, "2 bytes"], Int[np.ndarray, "arrays"]]:
    """Two serialized scenes that differ in all bytes of all numbers and in no other, and where their arrays begin."""
    layout = []
    for number in (0.0, 1.1):
        message = submission_pb2.ScenarioRollouts()
        agents = message.joint_scenes.add().simulated_trajectories
        names = (*_POSE_NAMES, *SIZES) if challenge.makes_scenes else _POSE_NAMES
        arrays = submission_pb2.SimulatedTrajectory(**dict.fromkeys(names, [number] * challenge.num_steps))
        for object_id, object_type in zip(object_ids, object_types):
            agent = agents.add()
            agent.CopyFrom(arrays)
            agent.object_id = object_id
            if challenge.makes_scenes:
                agent.object_type = object_type
        layout.append(np.frombuffer(message.SerializeToString(), np.uint8))
    is_number = layout[0] != layout[1]
    return np.stack(layout), np.flatnonzero(is_number & ~np.roll(is_number, 1))  # a scene begins with a key


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
    """Contents where all scenes have the layout that `encode_rollouts` gives to the first; None for any other."""
    try:
        fields = iterate_fields(BytesIO(data), 0, len(data), is_stream=True)
        name, scene = next(fields), next(fields)
        agents = submission_pb2.JointScene.FromString(scene.payload).simulated_trajectories
        if len(agents) * count_bytes(challenge) > len(scene.payload):  # too short for their numbers
            return None
        object_ids = tuple(agent.object_id for agent in agents)
        layout, starts = _lay_out_scene(object_ids, [agent.object_type for agent in agents], challenge)
        rows = np.frombuffer(data, np.uint8, offset=name.stop).reshape(-1, layout.shape[1])  # [N, bytes]
    except (DataError, DecodeError, StopIteration, ValueError):
        return None
    is_header = layout[0] == layout[1]
    if not agents or (name.number, name.wire_type) != (1, BYTES) or (rows[:, is_header] != layout[0, is_header]).any():
        return None
    values = np.empty((len(rows), len(starts), challenge.num_steps), np.dtype("<f4"))
    as_bytes = values.view(np.uint8)  # [N, A arrays, 4 T]
    for number, start in enumerate(starts):
        as_bytes[:, number] = rows[:, start : start + as_bytes.shape[2]]
    values = values.reshape(len(rows), len(agents), -1, challenge.num_steps)
    return DecodedRollouts(as_text(name.payload), (object_ids,) * len(rows), (), values, challenge)


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
    names = (*_POSE_NAMES, *SIZES) if is_generated else _POSE_NAMES
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
