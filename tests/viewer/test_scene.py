from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

import rlftsim as rs
from rlftsim.errors import DataError
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.viewer.scene import build_scene, logged_trajectories, rollout_trajectories, simplify


def undo_second_differences(values, num_steps):
    """The player's rule, written another way: two cumulative sums, the second from step 1 on."""
    padded = np.zeros(num_steps, int)
    padded[: len(values)] = values
    slopes = np.cumsum(padded[1:])
    return np.concatenate([[padded[0]], padded[0] + np.cumsum(slopes)])


def test_agents_are_the_simulated_ones_in_track_order(scenario):
    agents = build_scene(scenario).agents
    assert agents.object_id.tolist() == [5, 9, 3]
    assert agents.is_ego.tolist() == [False, True, False]
    assert agents.evaluated_mask.tolist() == [True, True, False]
    assert agents.length.tolist() == pytest.approx([4.5, 4.5, 1.8])


def test_map_is_simplified_and_centered_on_the_ego(scenario):
    lines = {line.style: line.points for line in build_scene(scenario).lines}
    # 61 points on a straight lane become its ends; the corner of the edge stays, its middle point goes
    assert lines["lane"].tolist() == [[-30, 0], [30, 0]]
    assert lines["edge"].tolist() == [[-30, -4], [20, -4], [20, -20]]
    assert lines["stop_sign"].tolist() == [[21, -3]]
    assert len(lines["crosswalk"]) == 4


def test_simplified_line_stays_within_tolerance():
    angle = np.linspace(0, np.pi, 200)
    arc = 30 * np.stack([np.cos(angle), np.sin(angle)], -1)
    simple = simplify(arc, tolerance_m=0.1)
    assert len(simple) < 40
    share = np.linspace(0, 1, 50)[:, None]
    drawn = np.concatenate([a + share * (b - a) for a, b in pairwise(simple)])
    gaps = np.linalg.norm(arc[:, None] - drawn[None], axis=-1).min(1)
    assert gaps.max() < 0.13


def test_light_has_a_state_for_every_step(scenario):
    (light,) = build_scene(scenario).lights
    assert light.stop_point.tolist() == [18, 0]
    assert light.states == "6" * 20 + "4" * 70 + "-"


def test_lights_that_are_known_for_longer_than_the_tracks_end_with_them(scenario):
    tracks = scenario.tracks
    short = {name: getattr(tracks, name)[:, :50] for name in ("position", "heading", "velocity", "size", "valid")}
    (light,) = build_scene(replace(scenario, tracks=replace(tracks, **short))).lights
    assert light.states == "6" * 20 + "4" * 30


def test_logged_trajectories_equal_the_record(scenario):
    log = logged_trajectories(scenario)
    assert log.position.shape == (1, 3, 91, 2)
    assert log.position[0, 1, :, 0].tolist() == list(range(-10, 81))
    assert log.valid[0].sum(-1).tolist() == [91, 91, 41]


def test_rollout_is_the_history_followed_by_the_simulation(scenario):
    batch = collate([scenario, scenario], max_agents=5)
    rollouts = simulate(ConstantVelocity(), batch, num_rollouts=3, seed=0)
    simulated = rollout_trajectories(scenario, rollouts, row=1, max_rollouts=2)
    assert simulated.position.shape == (2, 3, 91, 2)
    # the ego keeps its 10 m/s, so the rollout equals its log; the cyclist stays in the picture, standing still
    np.testing.assert_allclose(simulated.position[1, 1, :, 0], np.arange(-10, 81), atol=1e-4)
    assert simulated.valid[:, 2].all()
    np.testing.assert_allclose(simulated.position[0, 2, 90], [0, 5])


def test_rollouts_in_the_world_frame_are_shown_where_the_log_is(scenario):
    shown = [
        rollout_trajectories(scenario, rs.simulate(ConstantVelocity(), batch, num_rollouts=1), row=0).position
        for batch in (collate([scenario]), collate([scenario], frame="world"))
    ]
    np.testing.assert_allclose(shown[1], shown[0], atol=1e-3)


def test_rollouts_of_another_scenario_are_refused(scenario):
    rollouts = simulate(ConstantVelocity(), collate([scenario]), num_rollouts=1, seed=0)
    with pytest.raises(DataError, match="3 agents, but the rollouts have 2"):
        rollout_trajectories(scenario, _first_agents(rollouts, 2), row=0)


def _first_agents(rollouts, count):
    fields = ("position", "heading", "decision", "decision_mask", "log_prob")
    return replace(rollouts, **{name: getattr(rollouts, name)[:, :, :count] for name in fields})


def test_payload_restores_positions_to_half_a_centimetre(scenario):
    rng = np.random.default_rng(0)
    log = logged_trajectories(scenario)
    wild = replace(log, position=rng.normal(0, 50, log.position.shape), heading=rng.uniform(-9, 9, log.heading.shape))
    payload = wild.to_payload()
    for agent, (x, y, heading, valid, *_) in enumerate(payload["rollouts"][0]):
        seen = wild.valid[0, agent]
        for values, expected in ((x, wild.position[0, agent, :, 0]), (y, wild.position[0, agent, :, 1])):
            np.testing.assert_allclose(undo_second_differences(values, 91)[seen] / 100, expected[seen], atol=0.00501)
        turned = undo_second_differences(heading, 91)[seen] / 100 - wild.heading[0, agent, seen]
        np.testing.assert_allclose(np.cos(turned), 1, atol=1e-4)
        assert valid == ([0, 41] if agent == 2 else [0, 91])


def test_standing_agents_cost_next_to_nothing(scenario):
    x, y, heading, valid, collides, offroad = logged_trajectories(scenario).to_payload()["rollouts"][0][0]
    assert (x, y, heading, valid, collides, offroad) == ([1000], [], [], [0, 91], [], [])


def test_overlap_is_marked_while_the_boxes_touch(scenario):
    scene = build_scene(scenario)
    log = logged_trajectories(scenario).with_overlaps(scene.agents)
    # both are 4.5 m long: |1000 + step - 1020| < 4.5 holds for steps 16..24
    assert np.flatnonzero(log.collides[0, 0]).tolist() == list(range(16, 25))
    assert np.array_equal(log.collides[0, 0], log.collides[0, 1])
    assert not log.collides[0, 2].any()


def test_agents_that_overlap_at_the_current_step_are_not_marked_for_it(scenario):
    scene = build_scene(scenario)
    log = logged_trajectories(scenario)
    position = log.position.copy()
    position[0, 2] = position[0, 1]  # the cyclist rides on the ego's roof, up to step 40
    log = replace(log, position=position).with_overlaps(scene.agents)
    assert not log.collides[0, 1, :16].any()
    assert log.collides[0, 2].sum() > 0  # it still meets the parked car


def test_metric_marks_reach_the_right_agents(scenario):
    # evaluated agents by ascending object id: the parked car (5), then the ego (9)
    offroad = torch.zeros(1, 2, 80, dtype=torch.bool)
    offroad[0, 1, 4:] = True
    marked = logged_trajectories(scenario).with_evaluated_flags(scenario, offroad=offroad)
    assert marked.collides is None
    assert np.flatnonzero(marked.offroad[0, 1]).tolist() == list(range(15, 91))
    assert not marked.offroad[0, [0, 2]].any()


def test_scenario_without_future_and_map_has_a_view(scenario):
    tracks = scenario.tracks
    short = {n: getattr(tracks, n)[:, :11] for n in ("position", "heading", "velocity", "size", "valid")}
    empty_map = replace(
        scenario.map_features,
        feature_id=np.zeros(0, int),
        feature_type=np.zeros(0, np.int8),
        points=np.zeros((0, 3), np.float32),
        offsets=np.zeros(1, int),
    )
    lights = scenario.lights
    early = {n: getattr(lights, n)[:11] for n in ("step", "lane_id", "state", "stop_point")}
    cut = replace(scenario, tracks=replace(tracks, **short), map_features=empty_map, lights=replace(lights, **early))
    scene = build_scene(cut)
    assert scene.lines == ()
    assert scene.lights[0].states == "6" * 11
    assert logged_trajectories(cut).to_payload()["steps"] == 11


def test_state_that_is_not_a_number_is_not_shown(scenario):
    scenario.tracks.position[1, 30] = np.nan
    log = logged_trajectories(scenario)
    assert not log.valid[0, 1, 30]
    assert log.to_payload()["rollouts"][0][1][3] == [0, 30, 31, 91]
