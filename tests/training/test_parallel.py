"""Parts for processes, and pieces that fit into memory."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import scenes
import tiny
from rlftsim.errors import DataError
from rlftsim.scenario.dataset import ScenarioDataset, write_dataset
from rlftsim.scenario.synthetic import pack_path
from rlftsim.scenario.types import CURRENT_STEP
from rlftsim.training.parallel import balance_by_cost, check_scored, micro_batches, scenario_costs

COSTS = st.lists(st.floats(0.1, 100.0), min_size=1, max_size=24)


@given(costs=COSTS, num_groups=st.integers(1, 6))
def test_parts_hold_everything_once_and_cost_about_the_same(costs, num_groups):
    parts = balance_by_cost(costs, num_groups)
    assert sorted(i for share in parts for i in share) == list(range(len(costs)))
    spent = [sum(costs[i] for i in share) for share in parts]
    assert max(spent) - min(spent) <= max(costs) + 1e-6  # less than the most expensive scenario


def test_equal_costs_are_dealt_out_in_turn():
    assert balance_by_cost([1.0] * 5, 2) == [[0, 2, 4], [1, 3]]


def test_a_crowded_scenario_is_set_off_by_several_small_ones():
    assert balance_by_cost([1.0, 6.0, 2.0, 2.0, 1.0], 2) == [[1], [0, 2, 3, 4]]


@given(costs=COSTS, max_count=st.integers(1, 8), max_cost=st.none() | st.floats(0.1, 300.0))
def test_pieces_hold_everything_once_within_the_budget(costs, max_count, max_cost):
    pieces = micro_batches(range(len(costs)), np.array(costs), max_count=max_count, max_cost=max_cost)
    assert sorted(i for piece in pieces for i in piece) == list(range(len(costs)))
    for piece in pieces:
        assert len(piece) <= max_count
        assert max_cost is None or len(piece) == 1 or sum(costs[i] for i in piece) <= max_cost * (1 + 1e-9)
    assert costs[pieces[0][0]] == max(costs)


def test_a_budget_gives_crowded_scenarios_smaller_pieces():
    costs = np.array([1.0, 9.0, 2.0, 2.0, 3.0, 1.0])
    assert micro_batches(range(6), costs, max_count=8, max_cost=6.0) == [[1], [4, 2], [3, 0, 5]]


def test_the_index_knows_what_the_scenarios_cost():
    data = ScenarioDataset(pack_path(), "validation")
    some = [0, 7, 20]
    counted = [len(data[i].simulated_indices) * 0.2 + len(data[i].map_features.points) / 1000 for i in some]
    assert scenario_costs(data)[some] == pytest.approx(counted)
    assert scenario_costs([data[i] for i in some]) == pytest.approx(counted)


def test_scenarios_without_a_reward_are_refused_before_a_run_begins(vocabulary, tmp_path):
    sound = scenes.straight_road()
    tracks = sound.tracks
    valid = tracks.valid.copy()
    valid[sound.evaluated_indices, CURRENT_STEP] = False
    alone = replace(sound, scenario_id="alone", tracks=replace(tracks, valid=valid))
    check_scored([sound])
    with pytest.raises(DataError, match=r"scenario alone has no evaluated agent: .* and 0 others of 2"):
        check_scored([sound, alone])
    write_dataset([sound, alone], tmp_path / "data", split="training")
    data = ScenarioDataset(tmp_path / "data", "training")
    with pytest.raises(DataError, match=r"scenario alone has no evaluated agent"):
        tiny.train("finetune", tiny.tiny_policy(vocabulary), data, tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("stage", ["pretrain", "catk"])
def test_a_gradient_does_not_depend_on_the_budget(stage, vocabulary, drawn_scenarios, tmp_path):
    costs, found = scenario_costs(drawn_scenarios), []
    for budget in (None, float(costs.max()), 2.1 * float(costs.min())):
        policy = tiny.tiny_policy(vocabulary, tiny.WITHOUT_CHANCE)
        changes = {"epochs": 1.0, "batch_size": 4, "gradient_clip": 1e9, "micro_batch_cost": budget}
        tiny.train(stage, policy, drawn_scenarios, tmp_path / str(budget), **changes)
        found.append(tiny.gradients_of(policy))
    for gradients in found[1:]:
        for name, gradient in found[0].items():
            torch.testing.assert_close(gradients[name], gradient, atol=1e-6, rtol=1e-5, msg=name)


def test_a_run_may_go_on_with_a_smaller_budget(vocabulary, drawn_scenarios, tmp_path):
    config = {"epochs": 0.5, "batch_size": 2}
    tiny.train("pretrain", tiny.tiny_policy(vocabulary), drawn_scenarios, tmp_path, **config)
    smaller = replace(tiny.PRETRAIN, **config, micro_batch_size=1, micro_batch_cost=0.5)
    tiny.train_policy(tiny.tiny_policy(vocabulary), drawn_scenarios, tmp_path, smaller)
