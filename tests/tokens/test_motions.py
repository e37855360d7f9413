"""Samples of motions: even, bounded, the same in any order."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

import scenes
from rlftsim.scenario.types import ObjectType
from rlftsim.tokens.motions import (
    DistinctSample,
    extract_motions,
    is_plausible,
    mirror_poses,
    motion_keys,
    sample_scenarios,
)

MOTION = arrays.arrays(np.float32, (5, 6, 3), elements=st.floats(-1, 1, width=32))


def rows(count: int) -> np.ndarray:
    return np.arange(count, dtype=np.float32)[:, None]


def sampled(parts: list[np.ndarray], capacity: int, seed: int = 0) -> list[float]:
    sample = DistinctSample(capacity, seed)
    for part in parts:
        sample.add(part, part.astype(np.int64))
    return sorted(sample.rows()[:, 0].tolist())


@settings(max_examples=20, deadline=None)
@given(st.permutations(range(60)), st.integers(1, 30), st.integers(1, 20))
def test_a_sample_does_not_depend_on_the_order_or_on_repetitions(order, cut, capacity):
    whole = sampled([rows(60)], capacity)
    shuffled = rows(60)[list(order)]
    assert sampled([shuffled[:cut], shuffled[cut:], shuffled[:cut]], capacity) == whole
    assert len(whole) == capacity


def test_a_sample_is_uniform_over_a_stream_and_follows_its_seed():
    parts = [rows(100_000)[start : start + 500] for start in range(0, 100_000, 500)]
    drawn = np.array(sampled(parts, 2000))
    quarters = np.histogram(drawn, 4, (0, 100_000))[0]
    assert np.abs(quarters - 500).max() < 100  # binomial: a standard deviation of 19
    assert sampled(parts, 2000, seed=1) != drawn.tolist()


def test_a_short_stream_is_kept_whole_and_counted():
    sample = DistinctSample(10, 0)
    sample.add(rows(4), rows(4).astype(np.int64))
    sample.add(rows(4), rows(4).astype(np.int64))
    assert sample.num_rows == 8
    assert len(sample.rows()) == 4


@settings(max_examples=30, deadline=None)
@given(MOTION)
def test_a_motion_and_its_mirror_image_are_one(motions):
    assert (motion_keys(motions) == motion_keys(mirror_poses(motions))).all()


def test_sampled_scenarios_are_spread_over_the_whole_data_set():
    drawn = sample_scenarios(10_000, 500, seed=1)
    assert len(set(drawn)) == 500
    assert drawn == sorted(drawn)
    assert np.histogram(drawn, 4, (0, 10_000))[0].min() > 80
    assert sample_scenarios(3, 500, seed=1) == sample_scenarios(3, None, seed=1) == [0, 1, 2]


@pytest.mark.parametrize(
    ("speed", "turn", "class_id", "plausible"),
    [
        *((4.4, 0.0, 0, True), (4.6, 0.0, 0, False), (1.3, 0.0, 1, False)),
        *((0.1, 0.2, 1, True), (0.1, 0.53, 1, False), (2.4, 0.1, 2, True)),
    ],
)
def test_impossible_motions_are_glitches(speed, turn, class_id, plausible):
    """A way of `speed` meters, and once a turn, within 0.1 s."""
    motion = np.zeros((1, 6, 3), np.float32)
    motion[0, :, 0] = speed * np.arange(6)
    motion[0, 3:, 2] = turn
    assert is_plausible(motion, class_id).tolist() == [plausible]


def test_a_straight_drive_is_straight_motions():
    scenario = scenes.build_scenario("one", (scenes.Mover(ObjectType.VEHICLE, speed_mps=8.0),))
    motions = extract_motions(scenario).select_class(0)
    assert len(motions) == 18
    np.testing.assert_allclose(motions[:, :, 0], np.tile(0.8 * np.arange(6), (18, 1)), atol=1e-3)
    np.testing.assert_allclose(motions[:, :, 1:], 0.0, atol=1e-3)
