"""Rollouts as bytes, against protobuf's own writer and parser."""

import numpy as np
import pytest
import torch
from google.protobuf import unknown_fields
from hypothesis import given, settings
from hypothesis import strategies as st

from rlftsim.errors import DataError
from rlftsim.evaluation.submission_pb2 import ScenarioRollouts
from rlftsim.realism import SIM_AGENTS, SimulatedStates
from rlftsim.submission.messages import count_bytes, decode_rollouts, encode_rollouts

IDS = st.lists(st.integers(-(2**31), 2**31 - 1), unique=True, max_size=5)


def states(ids, num_scenes, seed=0):
    rng = np.random.default_rng(seed)
    arrays = rng.normal(0, 1000, (4, num_scenes, len(ids), 80)).astype(np.float32)
    return SimulatedStates(np.array(ids, np.int64), *torch.from_numpy(arrays))


@settings(max_examples=20)
@given(st.text(min_size=1, max_size=200), IDS, st.integers(1, 4))
def test_bytes_are_those_of_protobuf(name, ids, num_scenes):
    drawn = states(ids, num_scenes)
    message = ScenarioRollouts(scenario_id=name)
    for scene in range(num_scenes):
        joint = message.joint_scenes.add()
        for agent, object_id in enumerate(ids):
            x, y, z, heading = (getattr(drawn, a)[scene, agent].tolist() for a in ("x", "y", "z", "heading"))
            joint.simulated_trajectories.add(center_x=x, center_y=y, center_z=z, heading=heading, object_id=object_id)
    assert encode_rollouts(name, drawn) == message.SerializeToString()


def test_an_agent_takes_the_forecast_bytes_in_a_scene():
    few, many = (len(encode_rollouts("a", states(list(range(n)), 32))) for n in (10, 30))
    assert (many - few) / (20 * 32) == pytest.approx(count_bytes(SIM_AGENTS), abs=4)  # and the headers around them


def test_values_come_back_bit_for_bit_in_any_layout():
    drawn = states([3, 70000, -1], 4)
    data = encode_rollouts("a", drawn)
    shuffled = ScenarioRollouts.FromString(data)
    shuffled.joint_scenes[2].simulated_trajectories.reverse()  # decoded by protobuf's parser
    for bytes_of in (data, shuffled.SerializeToString()):
        decoded = decode_rollouts(bytes_of)
        assert decoded.scenario_id == "a"
        assert decoded.object_ids[0] == (3, 70000, -1)
        for axis, name in enumerate(("x", "y", "z", "heading")):
            np.testing.assert_array_equal(decoded.values[:, :, axis], getattr(drawn, name).numpy())
    assert decoded.object_ids[2] == (-1, 70000, 3)


def test_an_id_of_more_than_32_bits_is_refused():
    with pytest.raises(DataError, match="scenario a: object id 1099511627777 does not fit the 32 bits"):
        encode_rollouts("a", states([3, 2**40 + 1], 1))


def test_equal_rollouts_are_written_as_often_as_they_count():
    one = states([1, 2], 1)
    repeated = SimulatedStates(one.object_id, one.x, one.y, one.z, one.heading, repeat=32)
    decoded = decode_rollouts(encode_rollouts("a", repeated))
    assert decoded.values.shape == (32, 2, 4, 80)


def test_nothing_of_a_message_is_unknown():
    message = ScenarioRollouts.FromString(encode_rollouts("a", states([1], 2)))
    assert len(unknown_fields.UnknownFieldSet(message)) == 0


@pytest.mark.parametrize("data", [b"", b"\x12\x00", b"\xff" * 20, encode_rollouts("a", states([1], 2))[:-7]])
def test_bytes_that_are_no_rollouts_are_refused(data):
    with pytest.raises(DataError, match=r"rollouts that name no scenario|not a ScenarioRollouts message"):
        decode_rollouts(data)
