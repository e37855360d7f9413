from collections import Counter

from hypothesis import given
from hypothesis import strategies as st

from rlftsim.training.data import scenarios_of_update


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
