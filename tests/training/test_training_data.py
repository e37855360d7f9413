from collections import Counter
from dataclasses import replace

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

import scenes
from rlftsim.training.data import batch_with_futures, mirrored_of_update, scenarios_of_update, within_reach


@given(num=st.integers(1, 40), size=st.integers(1, 16), epochs=st.integers(1, 4), seed=st.integers(0, 99))
def test_every_scenario_comes_once_per_epoch(num, size, epochs, seed):
    updates = -(-epochs * num // size)  # enough for all epochs
    seen = [i for u in range(updates) for i in scenarios_of_update(u, size, num, seed)]
    for epoch in range(epochs):
        assert sorted(seen[epoch * num : (epoch + 1) * num]) == list(range(num))


@given(num=st.integers(1, 40), size=st.integers(1, 16), update=st.integers(0, 50))
def test_an_update_needs_nothing_of_the_ones_before(num, size, update):
    whole = [i for u in range(update + 1) for i in scenarios_of_update(u, size, num, 5)]
    assert scenarios_of_update(update, size, num, 5) == whole[update * size :]


def test_epochs_and_seeds_have_orders_of_their_own():
    orders = [tuple(scenarios_of_update(epoch, 50, 50, seed)) for seed in (0, 1) for epoch in (0, 1)]
    assert len(set(orders)) == 4


def test_a_batch_larger_than_the_data_set_takes_some_scenarios_again():
    counts = Counter(scenarios_of_update(0, 7, 3, 0))
    assert sorted(counts.values()) == [2, 2, 3]


def test_what_is_far_from_the_ego_is_not_seen():
    [scenario] = [scenes.straight_road()]
    tracks, ego = scenario.tracks, scenario.ego_index
    other = next(i for i in scenario.simulated_indices if i != ego)
    position, valid = tracks.position.copy(), np.ones_like(tracks.valid)
    position[:] = position[ego]
    position[other, :, 2] += 3.0
    position[other, 40:, 0] += np.float32(4.0)  # 3, 4, 5: three metres above it counts
    moved = replace(scenario, tracks=replace(tracks, position=position, valid=valid))
    near = within_reach(moved, 5.0)
    assert near.tracks.valid[other].tolist() == [True] * 40 + [False] * 51
    assert near.tracks.valid[ego].all()
    assert moved.tracks.valid.all()  # the scenario itself is untouched
    assert within_reach(moved, 5.0) is near  # so that its tokens are remembered
    assert within_reach(moved, 5.1) is moved
    assert other not in within_reach(moved, 3.0).simulated_indices  # out of reach at the current step


def test_a_batch_leaves_out_what_is_far(drawn_scenarios):
    whole = batch_with_futures(drawn_scenarios, range(4))
    near = batch_with_futures(drawn_scenarios, range(4), context_radius_m=20.0)
    assert torch.equal(batch_with_futures(drawn_scenarios, range(4), context_radius_m=1e6).valid, whole.valid)
    assert 0 < int(near.valid.sum()) < int(whole.valid.sum())


def test_the_given_fraction_of_scenarios_is_mirrored_anew_in_each_update():
    drawn = [mirrored_of_update(update, range(200), 0.3, seed=1) for update in range(20)]
    assert 0.26 < sum(map(len, drawn)) / 4000 < 0.34
    assert len({frozenset(one) for one in drawn}) == 20
    assert drawn[7] & set(range(50, 90)) == mirrored_of_update(7, range(50, 90), 0.3, seed=1)  # however it is cut
    assert mirrored_of_update(0, range(9), 0.0, seed=1) == set()
    assert mirrored_of_update(0, range(9), 1.0, seed=1) == set(range(9))
    scenario = scenes.bend()
    first, second = batch_with_futures([scenario, scenario], [0, 1], mirror={1}).position
    assert torch.equal(first * torch.tensor([1.0, -1.0]), second)
