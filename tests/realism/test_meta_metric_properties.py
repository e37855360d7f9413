"""What must not change the metric, and what must change it in a known way."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from realism_drawing import draw_red_light, draw_rollouts, draw_traffic, select_rollouts
from torch.nn import functional

from rlftsim.realism import SimulatedStates, compute_features, scenario_log, score
from rlftsim.realism.config import HISTOGRAM_FEATURES
from rlftsim.realism.from_rollouts import states_of_rollouts
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import MapFeatures

SEEDS = st.integers(0, 10_000)
SLOW = settings(deadline=None, max_examples=15)


def draw(seed, **options):
    scenario = draw_traffic(seed, lights=draw_red_light(), **options)
    return scenario, draw_rollouts(scenario, 4, seed=seed)


def assert_same_features(a, b, *, kinematic=0.0, distance=0.0, seconds=0.0):
    for name in HISTOGRAM_FEATURES:
        tolerance = distance if "distance" in name else seconds if name == "time_to_collision" else kinematic
        torch.testing.assert_close(getattr(a, name), getattr(b, name), atol=tolerance, rtol=0, equal_nan=True)


@SLOW
@given(SEEDS)
def test_the_order_of_agents_does_not_matter(seed):
    scenario, states = draw(seed)
    order = np.random.default_rng(seed).permutation(len(states.object_id))
    shuffled = SimulatedStates(
        states.object_id[order], *(v[:, order] for v in (states.x, states.y, states.z, states.heading))
    )
    assert score(scenario, shuffled).to_official_fields() == score(scenario, states).to_official_fields()


@SLOW
@given(SEEDS)
def test_the_order_of_tracks_in_the_log_does_not_matter(seed):
    scenario, states = draw(seed)
    order = np.random.default_rng(seed).permutation(len(scenario.tracks.object_id))
    rank = np.argsort(order)
    tracks = dataclasses.replace(
        scenario.tracks, **{name: values[order] for name, values in vars(scenario.tracks).items()}
    )
    shuffled = dataclasses.replace(
        scenario,
        tracks=tracks,
        ego_index=int(rank[0]),
        tracks_to_predict=rank[scenario.tracks_to_predict].astype(np.int32),
    )
    assert score(shuffled, states).to_official_fields() == score(scenario, states).to_official_fields()


@SLOW
@given(SEEDS)
def test_the_order_of_rollouts_only_orders_their_own_values(seed):
    scenario, states = draw(seed)
    order = torch.from_numpy(np.random.default_rng(seed).permutation(4))
    result, shuffled = score(scenario, states), score(scenario, select_rollouts(states, order))
    torch.testing.assert_close(shuffled.likelihoods, result.likelihoods, atol=1e-6, rtol=0)
    torch.testing.assert_close(
        shuffled.leave_one_out_meta_metric, result.leave_one_out_meta_metric[order], atol=1e-6, rtol=0
    )
    torch.testing.assert_close(shuffled.single_meta_metric, result.single_meta_metric[order], atol=1e-6, rtol=0)


@SLOW
@given(SEEDS, st.integers(2, 8))
def test_repeated_rollouts_equal_copied_ones(seed, repeat):
    scenario, states = draw(seed)
    repeated = score(scenario, dataclasses.replace(states, repeat=repeat))
    copied = score(scenario, select_rollouts(states, torch.arange(4).repeat_interleave(repeat)))
    for name in ("likelihoods", "leave_one_out_meta_metric", "single_meta_metric", "rollout_displacement_error"):
        torch.testing.assert_close(getattr(repeated, name), getattr(copied, name), atol=1e-6, rtol=0)
    assert repeated.collision_rate == pytest.approx(copied.collision_rate.item())


@SLOW
@given(SEEDS)
def test_rewards_centered_on_the_leave_one_out_mean_sum_to_zero(seed):
    scenario, states = draw(seed)
    without_each = score(scenario, states).leave_one_out_meta_metric
    assert (without_each.mean() - without_each).sum().item() == pytest.approx(0.0, abs=1e-6)


@SLOW
@given(SEEDS)
def test_agents_not_valid_at_the_current_step_do_not_exist(seed):
    scenario, states = draw(seed)
    changed = dataclasses.replace(scenario.tracks, position=scenario.tracks.position.copy())
    changed.position[-1] = changed.position[0]  # the last track, put on the ego
    other = dataclasses.replace(scenario, tracks=changed)
    assert score(other, states).to_official_fields() == score(scenario, states).to_official_fields()


@SLOW
@given(SEEDS)
def test_agents_far_away_change_nothing(seed):
    scenario, states = draw(seed)
    tracks = scenario.tracks
    far = {name: np.concatenate([values, values[-1:]]) for name, values in vars(tracks).items()}
    far["position"][-1] = [3000.0, 3000.0, 0.0]
    far["valid"][-1] = True
    far["object_id"][-1] = 7777
    with_far = dataclasses.replace(scenario, tracks=dataclasses.replace(tracks, **far))
    fields = (states.x, states.y, states.z, states.heading)
    parked = (torch.full((4, 1, 80), value) for value in (3000.0, 3000.0, 0.0, 0.0))
    extended = SimulatedStates(
        np.append(states.object_id, 7777), *(torch.cat([v, p], 1) for v, p in zip(fields, parked))
    )
    assert score(with_far, extended).to_official_fields() == score(scenario, states).to_official_fields()


def move_map(features, rotation, shift):
    points = features.points.astype(np.float64)
    points[:, :2] = points[:, :2] @ rotation.T + shift
    return MapFeatures(features.feature_id, features.feature_type, points.astype(np.float32), features.offsets)


def move(scenario, states, angle, shift):
    """The same scene elsewhere. Lights are left out: the official rule for lanes knows the world's origin."""
    rotation = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    position = scenario.tracks.position.astype(np.float64)
    position[..., :2] = position[..., :2] @ rotation.T + shift
    tracks = dataclasses.replace(
        scenario.tracks,
        position=position.astype(np.float32),
        heading=(scenario.tracks.heading + np.float32(angle)).astype(np.float32),
    )
    xy = torch.stack([states.x, states.y], -1).double() @ torch.from_numpy(rotation.T) + torch.tensor(shift)
    x, y = xy.float().unbind(-1)
    moved = dataclasses.replace(scenario, tracks=tracks, map_features=move_map(scenario.map_features, rotation, shift))
    return moved, SimulatedStates(states.object_id, x, y, states.z, states.heading + angle)


@SLOW
@given(SEEDS, st.integers(-4000, 4000), st.integers(-4000, 4000))
def test_a_shift_by_whole_meters_changes_features_by_rounding_only(seed, x, y):
    # Coordinates are multiples of 1/64 m below 8192 m: the shift itself is exact, box corners are rounded to 5e-4 m.
    scenario = draw_traffic(seed)
    states = draw_rollouts(scenario, 3, seed=seed)
    moved, moved_states = move(scenario, states, 0.0, [float(x), float(y)])
    before = compute_features(scenario_log(scenario), states)
    after = compute_features(scenario_log(moved), moved_states)
    assert_same_features(before, after, kinematic=1e-6, distance=4e-3, seconds=1e-4)


@SLOW
@given(SEEDS, st.floats(-1.5, 1.5))
def test_a_rotation_changes_features_by_rounding_only(seed, angle):
    # Coordinates below 200 m are rounded to 8e-6 m: 4e-5 m/s of speed, 4e-4 m/s² of acceleration.
    scenario = draw_traffic(seed)
    states = draw_rollouts(scenario, 3, seed=seed)
    moved, moved_states = move(scenario, states, angle, [0.0, 0.0])
    before = compute_features(scenario_log(scenario), states)
    after = compute_features(scenario_log(moved), moved_states)
    for name in ("distance_to_nearest_object", "distance_to_road_edge", "linear_speed", "angular_speed"):
        difference = (getattr(before, name) - getattr(after, name)).abs().nan_to_num()
        assert difference.max() < 1e-3, name
    assert (before.linear_acceleration - after.linear_acceleration).abs().nan_to_num().max() < 1e-2
    # Time to collision jumps where an agent is just or just not followed: nearly all steps agree.
    assert ((before.time_to_collision - after.time_to_collision).abs() > 1e-2).float().mean() < 0.01


@SLOW
@given(SEEDS, st.floats(-1.5, 1.5))
def test_a_rotation_moves_the_score_by_a_few_flipped_bins_at_most(seed, angle):
    # 3 agents x 80 steps: a flipped bin changes a likelihood by about 1/240 of itself.
    scenario = draw_traffic(seed)
    states = draw_rollouts(scenario, 3, seed=seed)
    moved, moved_states = move(scenario, states, angle, [0.0, 0.0])
    assert score(moved, moved_states).meta_metric.item() == pytest.approx(
        score(scenario, states).meta_metric.item(), abs=0.01
    )


@SLOW
@given(SEEDS, st.integers(2, 6))
def test_leaving_one_out_equals_scoring_the_others(seed, num_rollouts):
    scenario = draw_traffic(seed, lights=draw_red_light())
    states = draw_rollouts(scenario, num_rollouts, seed=seed)
    without_each = score(scenario, states).leave_one_out_meta_metric
    for rollout in range(num_rollouts):
        others = [other for other in range(num_rollouts) if other != rollout]
        expected = score(scenario, select_rollouts(states, others)).meta_metric
        assert without_each[rollout].item() == pytest.approx(expected.item(), abs=1e-6)


@SLOW
@given(SEEDS, st.integers(0, 9))
def test_padding_of_a_batch_changes_nothing(seed, padding):
    scenario, states = draw(seed)
    count = len(states.object_id)
    batch = collate([scenario], max_agents=count + padding)
    position = torch.stack([states.x, states.y], -1)[None] - batch.origin[:, None, None, None].float()
    padded = Rollouts(
        position=functional.pad(position, (0, 0, 0, 0, 0, padding), value=float("nan")),
        heading=functional.pad(states.heading[None], (0, 0, 0, padding), value=float("nan")),
        decision=torch.zeros(1, 4, count + padding, 1),
        decision_mask=torch.ones(1, 4, count + padding, 1, dtype=torch.bool),
        log_prob=torch.zeros(1, 4, count + padding, 1),
    )
    (unpadded,) = states_of_rollouts(batch, padded)
    same_height = dataclasses.replace(states, z=unpadded.z)  # a policy keeps the current step's height
    assert score(scenario, unpadded).to_official_fields() == score(scenario, same_height).to_official_fields()
