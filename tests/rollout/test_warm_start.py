"""Scenarios that begin where a policy has driven to."""

from dataclasses import replace

import numpy as np
import pytest

import scenes
import tiny
from rlftsim.errors import ConfigError, DataError
from rlftsim.policies.calibrated.policy import CalibratedTokenPolicy
from rlftsim.policies.registry import load_policy
from rlftsim.rollout.warm_start import start_from_rollouts
from rlftsim.scenario.types import CURRENT_STEP, HISTORY_STEPS
from rlftsim.training.calibrate import split_scenarios
from rlftsim.training.config import CalibrateConfig, FinetuneConfig
from rlftsim.training.data import find_starts
from rlftsim.training.run import train_policy

EGO, LEADER, STOPS, JOINS, LEAVES = range(5)


@pytest.fixture
def world(monkeypatch):
    """Ego and leader keep their speed for 14 s; another one stops after 1 s, one joins at 5 s, one leaves at 3 s."""
    monkeypatch.setattr(scenes, "TOTAL_STEPS", HISTORY_STEPS + 140)
    places = ((0.0, 5.0), (30.0, 5.0), (60.0, 5.0), (90.0, 5.0), (-40.0, 5.0))
    movers = tuple(scenes.Mover(x_m=x, speed_mps=speed) for x, speed in places)
    scenario = scenes.build_scenario("long", movers, scenes.straight_map())
    tracks = scenario.tracks
    position, velocity, valid = tracks.position.copy(), tracks.velocity.copy(), tracks.valid.copy()
    position[STOPS, 20:], velocity[STOPS, 20:] = position[STOPS, 20], 0
    valid[JOINS, :60], valid[LEAVES, 40:] = False, False
    return replace(scenario, tracks=replace(tracks, position=position, velocity=velocity, valid=valid))


def test_agents_are_where_the_policy_drove_and_the_future_is_the_logs(world):
    policy = load_policy("constant_velocity")
    first, later = start_from_rollouts(policy, [world], (0.0, 6.0), seed=0)
    logged = world.window(60)
    np.testing.assert_array_equal(first.tracks.position, world.window(0).tracks.position)
    tracks, now = later.tracks, CURRENT_STEP
    # who keeps the speed in the log is there; who stops in the log drove on, 5 m/s for 5 s more
    gap = tracks.position[:, now, 0] - logged.tracks.position[:, now, 0]
    np.testing.assert_allclose(gap[[EGO, LEADER, STOPS, JOINS]], [0, 0, 25.0, 0], atol=0.02)
    np.testing.assert_allclose(tracks.velocity[STOPS, : now + 1, 0], 5.0, atol=0.01)
    assert later.simulated_indices.tolist() == [EGO, LEADER, STOPS, JOINS]
    np.testing.assert_array_equal(tracks.position[:, HISTORY_STEPS:], logged.tracks.position[:, HISTORY_STEPS:])
    assert (later.scenario_id, later.num_steps, later.tracks_to_predict.tolist()) == ("long@60", 91, [LEADER, STOPS])
    later.check_consistency()


def test_nobody_joins_where_somebody_has_driven_to_or_stays_in_the_way_of_the_ego(world):
    tracks = world.tracks
    position = tracks.position.copy()
    position[JOINS] = position[STOPS, :1] + (np.arange(world.num_steps) * 0.5)[:, None] * np.array([1.0, 0, 0])
    crossed = replace(world, tracks=replace(tracks, position=position))  # where the policy lets STOPS drive
    policy = load_policy("constant_velocity")
    (later,) = start_from_rollouts(policy, [crossed], (6.0,), seed=0)
    assert later.simulated_indices.tolist() == [EGO, LEADER, STOPS]
    position[EGO] = position[LEADER]  # the ego is led along its log
    (later,) = start_from_rollouts(policy, [replace(world, tracks=replace(tracks, position=position))], (4.0,), seed=0)
    assert later.simulated_indices.tolist() == [EGO, STOPS]


def test_a_run_trains_on_such_starts_and_short_logs_and_odd_seconds_are_refused(world, tmp_path):
    config = CalibrateConfig(
        num_rollouts=2, batch_size=1, micro_batch_size=1, start_seconds=(2.0, 4.0), device=tiny.CPU
    )
    policy = tiny.tiny_policy(tiny.small_vocabulary([world]), tiny.WITHOUT_CHANCE)
    updates = []
    model = train_policy(
        CalibratedTokenPolicy(policy, config.features).eval(),
        world,
        tmp_path / "run",
        config,
        on_update=lambda update, values: updates.append(update),
    )
    assert len(updates) == config.num_updates(2)
    assert model.exists()
    with pytest.raises(DataError, match="no 8 s after a start at 10 s: rlftsim synthesize --seconds"):
        start_from_rollouts(policy, [world], (10.0,), seed=0)
    for seconds in ((3.0,), (-2.0,), ()):
        with pytest.raises(ConfigError, match="start_seconds are multiples of 2 s, at least one"):
            start_from_rollouts(policy, [world], seconds, seed=0)
    with pytest.raises(ConfigError, match=r"imitation_weight is 0\.1, but with start_seconds"):
        FinetuneConfig(start_seconds=(2.0,), imitation_weight=0.1)
    valid = world.tracks.valid.copy()
    valid[EGO, 40 + CURRENT_STEP] = False
    with pytest.raises(DataError, match="the log lacks the ego 4 s after the beginning"):
        start_from_rollouts(policy, [replace(world, tracks=replace(world.tracks, valid=valid))], (4.0,), seed=0)


def test_a_gap_in_the_log_ends_nobodys_way_and_dropout_moves_no_start(world):
    valid = world.tracks.valid.copy()
    valid[LEADER, 20 + CURRENT_STEP] = False
    gap = replace(world, tracks=replace(world.tracks, valid=valid))
    (start,) = start_from_rollouts(load_policy("constant_velocity"), [gap], (4.0,), seed=0)
    assert LEADER in start.simulated_indices
    policy = tiny.tiny_policy(tiny.small_vocabulary([world]), replace(tiny.MODEL, dropout=0.5)).train()
    first, second = (find_starts(policy, [world], CalibrateConfig(start_seconds=(4.0,))) for _ in range(2))
    np.testing.assert_array_equal(first[0].tracks.position, second[0].tracks.position)
    assert policy.training


def test_windows_of_a_log_are_not_on_both_sides_of_a_calibration():
    ids = [f"log{log}@{start}" for log in range(5) for start in (100, 200)]
    fitted, held_back = split_scenarios(CalibrateConfig(held_back=0.4), ids)
    assert len(fitted) == 6
    assert len(held_back) == 4
    assert not {ids[i].split("@")[0] for i in fitted} & {ids[i].split("@")[0] for i in held_back}
