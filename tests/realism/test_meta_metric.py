import dataclasses
import gc
import weakref
from collections import deque

import jaxtyping
import numpy as np
import pytest
import torch
from realism_drawing import draw_map, draw_red_light, draw_rollouts, draw_traffic, select_rollouts

from rlftsim.errors import DataError
from rlftsim.realism import (
    METRIC_2024_ORIGINAL,
    METRIC_2025,
    AgentScores,
    ComputeConfig,
    ScenarioFeatures,
    SimulatedStates,
    compute_batch_features,
    compute_features,
    scenario_log,
    score,
    score_batch,
    score_features,
)
from rlftsim.realism import features as realism_features
from rlftsim.realism.features import JoinedLogs


@pytest.fixture(scope="module")
def scenario():
    return draw_traffic(0, lights=draw_red_light())


def test_the_log_of_a_scenario_is_computed_once(scenario):
    assert scenario_log(scenario) is scenario_log(scenario, "cpu")


def test_cached_logs_are_bounded_and_keep_no_scenario_in_memory(monkeypatch):
    monkeypatch.setattr(realism_features, "_recent_logs", deque(maxlen=2))
    scenarios = [draw_traffic(seed) for seed in range(3)]
    logs = [weakref.ref(scenario_log(scenario)) for scenario in scenarios]
    gc.collect()
    assert [log() is None for log in logs] == [True, False, False]
    scenario_log(scenarios[1])  # used again: now the last one to go
    scenario_log(scenarios[0])
    gc.collect()
    assert [log() is None for log in logs[1:]] == [False, True]
    alive = weakref.ref(scenarios[0])
    del scenarios
    gc.collect()
    assert alive() is None


def test_rollouts_that_repeat_the_log_score_high_but_not_one(scenario):
    oracle = draw_rollouts(scenario, 1, seed=0, spread=0.0)
    result = score(scenario, dataclasses.replace(oracle, repeat=32))
    assert 0.6 < result.meta_metric < 0.999
    assert result.min_average_displacement_error == pytest.approx(0.0)
    assert result.leave_one_out_meta_metric.shape == (32,)


def test_leave_one_out_and_single_values_equal_scores_from_scratch(scenario):
    states = draw_rollouts(scenario, 5, seed=1)
    result = score(scenario, states)
    for rollout in range(5):
        others = [other for other in range(5) if other != rollout]
        without = score(scenario, select_rollouts(states, others)).meta_metric
        alone = score(scenario, select_rollouts(states, [rollout])).meta_metric
        assert result.leave_one_out_meta_metric[rollout].item() == pytest.approx(without.item(), abs=1e-6)
        assert result.single_meta_metric[rollout].item() == pytest.approx(alone.item(), abs=1e-6)


def test_leaving_out_the_only_rollout_is_not_a_number(scenario):
    result = score(scenario, draw_rollouts(scenario, 1, seed=1))
    assert result.leave_one_out_meta_metric.isnan().all()
    assert result.single_meta_metric[0] == result.meta_metric


def test_sub_scores_add_up_to_the_meta_metric(scenario):
    result = score(scenario, draw_rollouts(scenario, 4, seed=1))
    combined = 0.2 * result.kinematic + 0.45 * result.interactive + 0.35 * result.map_based
    assert combined.item() == pytest.approx(result.meta_metric.item(), abs=1e-6)


def test_per_rollout_errors_and_rates_average_to_the_reported_ones(scenario):
    result = score(scenario, draw_rollouts(scenario, 4, seed=1, spread=4.0))
    assert result.rollout_displacement_error.mean() == result.average_displacement_error
    assert result.rollout_displacement_error.min() == result.min_average_displacement_error
    assert result.rollout_collision_rate.mean() == result.collision_rate
    assert result.rollout_offroad_rate.mean() == result.offroad_rate
    assert result.offroad_rate > 0


def test_agents_that_leave_the_road_count_apart_where_their_log_stays_on_it():
    staying = []
    for seed in range(4):
        scenario = draw_traffic(seed)
        scenario.tracks.position[scenario.evaluated_indices[:seed], 60:, 1] += 20.0  # the street is 12 m wide
        log, states = scenario_log(scenario), draw_rollouts(scenario, 4, seed=1, spread=4.0)
        distance = compute_features(log, states).distance_to_road_edge.numpy()
        logged, valid = log.features.distance_to_road_edge[0].numpy(), log.agents.future_valid.numpy()
        left = [
            any(distance[n, agent, step] > 0 and valid[agent, step] for step in range(80))
            for agent in range(len(valid))
            if not any(logged[agent, step] > 0 and valid[agent, step] for step in range(80))
            for n in range(4)
        ]
        staying.append(len(left) / 4 / len(valid))
        found = score(scenario, states).unlogged_offroad_rate
        assert found == pytest.approx(np.mean(left), abs=1e-6) if left else found.isnan()
    assert staying == pytest.approx([1, 2 / 3, 1 / 3, 0])


def test_a_batch_is_its_scenarios_stacked():
    scenarios = [draw_traffic(seed, num_agents=4 + seed) for seed in range(3)]
    states = [draw_rollouts(scenario, 4, seed=7) for scenario in scenarios]
    batch = score_batch(scenarios, states)
    assert batch.meta_metric.shape == (3,)
    assert batch.leave_one_out_meta_metric.shape == (3, 4)
    assert batch.likelihoods.shape == (3, 10)
    assert batch.likelihood("linear_speed").shape == (3,)
    for row, (scenario, item) in enumerate(zip(scenarios, states)):
        single = score(scenario, item)
        assert torch.equal(batch.leave_one_out_meta_metric[row], single.leave_one_out_meta_metric)
        assert batch.to_official_fields()[row] == single.to_official_fields()[0]


def test_scenarios_measured_side_by_side_have_the_scores_of_each_alone():
    no_edges = draw_map([(2, [[-300.0, -2, 0], [300.0, -2, 0]])])
    scenarios = [
        draw_traffic(0, num_agents=7, lights=draw_red_light()),
        draw_traffic(1, num_agents=4, num_evaluated=1),
        draw_traffic(2, num_agents=5, map_features=no_edges),
        draw_traffic(3, num_agents=9, num_evaluated=6, lights=draw_red_light(at_x=35.0)),
    ]
    states = [draw_rollouts(scenario, 4, seed=5, spread=4.0) for scenario in scenarios]
    # rollouts may name their agents in any order
    order = np.arange(len(states[0].object_id))[::-1].copy()
    swapped = (v[:, order] for v in (states[0].x, states[0].y, states[0].z, states[0].heading))
    states[0] = SimulatedStates(states[0].object_id[order], *swapped)
    logs = [scenario_log(scenario, missing_map="neutral") for scenario in scenarios]
    joined = JoinedLogs.from_logs(logs)
    features = compute_features(joined, states)
    expected = score_batch(logs, states)
    result = score_features(joined, features)
    assert result.traffic_light_violation_rate.max() > 0
    assert result.offroad_rate.min() == 0 < result.offroad_rate.max()
    for field in dataclasses.fields(result):
        found, wanted = getattr(result, field.name), getattr(expected, field.name)
        if isinstance(found, torch.Tensor):
            torch.testing.assert_close(found, wanted, atol=1e-6, rtol=0, equal_nan=True, msg=field.name)
        else:
            assert found == wanted
    side_by_side = AgentScores((ScenarioFeatures(joined, features),), METRIC_2025, 10)
    one_by_one = AgentScores(compute_batch_features(logs, states), METRIC_2025, 10)
    for name in ("leave_one_out", "single", "displacement_error", "collision", "offroad"):
        torch.testing.assert_close(getattr(side_by_side, name), getattr(one_by_one, name), atol=1e-6, rtol=0, msg=name)


def test_batches_must_match(scenario):
    states = draw_rollouts(scenario, 4, seed=1)
    with pytest.raises(DataError, match="got 1 for 2"):
        score_batch([scenario, scenario], [states])
    with pytest.raises(DataError, match="got 0 for 0"):
        score_batch([], [])
    with pytest.raises(DataError, match=r"\[3, 4\]"):
        score_batch([scenario, scenario], [states, select_rollouts(states, [0, 1, 2])])


def test_features_serve_several_metrics(scenario):
    states = draw_rollouts(scenario, 4, seed=1)
    log = scenario_log(scenario)
    result = score_features(log, compute_features(log, states), METRIC_2024_ORIGINAL)
    fields = result.to_official_fields()[0]
    assert fields["metametric"] == score(scenario, states, METRIC_2024_ORIGINAL).meta_metric.item()
    assert not any("traffic_light" in name for name in [*fields, *fields["buckets"]])


def test_memory_bounds_change_no_value(scenario):
    states = draw_rollouts(scenario, 2, seed=1)
    small = score(scenario, states, compute=ComputeConfig(max_pairs=1))
    large = score(scenario, states, compute=ComputeConfig(max_pairs=1 << 22))
    assert small.to_official_fields() == large.to_official_fields()


def test_missing_unknown_and_repeated_agents_are_named(scenario):
    states = draw_rollouts(scenario, 2, seed=1)
    simulated = [int(object_id) for object_id in states.object_id]

    def give(ids, index):
        return SimulatedStates(
            np.array(ids), *(v[:, index].contiguous() for v in (states.x, states.y, states.z, states.heading))
        )

    with pytest.raises(DataError, match=f"drawn_0 .*missing {simulated[0]}"):
        score(scenario, give(simulated[1:], [1, 2, 3, 4]))
    with pytest.raises(DataError, match="not simulated in this scenario 5000"):
        score(scenario, give([*simulated, 5000], [0, 1, 2, 3, 4, 4]))
    with pytest.raises(DataError, match="listed twice"):
        score(scenario, give([*simulated, simulated[0]], [0, 1, 2, 3, 4, 0]))


def test_states_of_another_shape_or_precision_are_refused(scenario):
    # Where run-time type checks are on, they refuse first: another message, the same refusal.
    refusals = (DataError, jaxtyping.TypeCheckError)
    states = draw_rollouts(scenario, 2, seed=1)
    with pytest.raises(refusals, match=r"float32 tensor \[N, A = 5, T = 80\], got a Tensor of torch.float64"):
        dataclasses.replace(states, x=states.x.double())
    with pytest.raises(refusals, match=r"\[2, ?5, ?79\]"):
        dataclasses.replace(states, z=states.z[..., 1:])
    with pytest.raises(DataError, match="At least one rollout"):
        dataclasses.replace(states, repeat=0)


def test_values_that_are_no_numbers_are_found_on_request(scenario):
    states = draw_rollouts(scenario, 2, seed=1)
    states.check_finite()
    states.y[1, 3, 7] = float("nan")
    with pytest.raises(DataError, match=f"object id {states.object_id[3]} in rollout 1 at future step 7"):
        states.check_finite()
    assert score(scenario, states).meta_metric.isfinite()


def test_a_scenario_without_future_is_refused(scenario):
    tracks = scenario.tracks
    cut = dataclasses.replace(
        tracks,
        **{name: getattr(tracks, name)[:, :11] for name in ("position", "heading", "velocity", "size", "valid")},
    )
    with pytest.raises(DataError, match="drawn_0 has 11 logged steps"):
        score(dataclasses.replace(scenario, tracks=cut), draw_rollouts(scenario, 2, seed=1))


def test_a_scenario_without_road_edges_is_refused_or_counts_as_on_the_road():
    scenario = draw_traffic(0, map_features=draw_map([]))
    states = draw_rollouts(scenario, 4, seed=1)
    with pytest.raises(DataError, match="drawn_0 has no road edge"):
        score(scenario, states)
    result = score(scenario, states, missing_map="neutral")
    assert result.likelihood("distance_to_road_edge") > 0.99
    assert result.likelihood("offroad_indication") > 0.99
    assert result.offroad_rate == 0


@pytest.mark.parametrize(("num_agents", "num_rollouts"), [(2, 1), (2, 33), (60, 2)])
def test_lonely_and_crowded_scenes_and_any_number_of_rollouts_score(num_agents, num_rollouts):
    scenario = draw_traffic(1, num_agents=num_agents, num_evaluated=1)
    result = score(scenario, draw_rollouts(scenario, num_rollouts, seed=1))
    assert result.likelihoods.isfinite().all()
    assert len(scenario.simulated_indices) == num_agents - 1


def test_an_evaluated_agent_seen_at_the_current_step_only_gives_what_the_rules_say():
    scenario = draw_traffic(1, num_agents=3, num_evaluated=1)
    scenario.tracks.valid[0] = False
    scenario.tracks.valid[0, 10] = True
    # as in training: an evaluation refuses a log without anything to compare with
    result = score(scenario, draw_rollouts(scenario, 2, seed=1), missing_map="neutral")
    # No step of the log is scored: likelihoods of histograms are 0/0; outcomes are all "no" on both sides.
    assert result.likelihoods[:7].isnan().all()
    assert result.likelihoods[7:].tolist() == pytest.approx([2.001 / 2.002] * 3)
    assert result.average_displacement_error == 0
