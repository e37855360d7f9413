"""Worlds that agents leave and enter."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

import rlftsim as rs
import scenes
from rlftsim.cli.main import main
from rlftsim.errors import ConfigError, DataError
from rlftsim.policies.calibrated.candidates import Traffic
from rlftsim.policies.registry import load_policy
from rlftsim.rollout.edge_scenes import edge_scenes, without_future
from rlftsim.rollout.entries import FittedEntries, fit_entries, load_entries, write_entries
from rlftsim.rollout.gates import GateFinder
from rlftsim.rollout.open_world import EGO_GAP_M, VISITORS, add_visitors, find_safe_speed
from rlftsim.rollout.simulate import lead_ego, simulate
from rlftsim.rollout.types import AgentStates
from rlftsim.scenario.batch import collate
from rlftsim.scenario.open import to_scenarios
from rlftsim.scenario.polylines import arc_length, resample_to


@pytest.fixture(scope="module")
def scenario():
    return to_scenarios("synthetic", "validation")[0]


@pytest.fixture(scope="module")
def rollouts(scenario):
    return rs.simulate("demo-base", scenario, num_rollouts=2, seconds=20.0, entries="fixed-rate")


def test_agents_leave_and_enter_far_from_the_ego_and_nobody_jumps(scenario, rollouts):
    valid, position = rollouts.valid[0].numpy(), rollouts.position[0].numpy()  # [N, A, T]
    ego = int(np.flatnonzero(scenario.simulated_indices == scenario.ego_index)[0])
    is_there = valid[:, :, 1:] & valid[:, :, :-1]
    assert np.linalg.norm(np.diff(position, axis=2), axis=-1)[is_there].max() < 4.0  # 40 m/s
    appears = valid[:, :, 1:] & ~valid[:, :, :-1]
    distance = np.linalg.norm(position - position[:, ego, None], axis=-1)
    assert appears.any()
    assert distance[:, :, 1:][appears].min() > EGO_GAP_M
    assert (~valid[:, :, 1:] & valid[:, :, :-1]).any()
    assert valid[:, ego].all()
    assert distance[valid].max() < 150  # who waits is not there
    assert not torch.equal(rollouts.valid[0, 0], rollouts.valid[0, 1])
    assert not rollouts.decision_mask[0][~rollouts.valid[0, ..., ::5]].any()


def test_the_same_seed_gives_the_same_world_and_without_entries_it_is_the_closed_one(scenario, rollouts):
    again = rs.simulate("demo-base", scenario, num_rollouts=2, seconds=20.0, entries="fixed-rate")
    assert torch.equal(again.valid, rollouts.valid)
    assert torch.equal(again.position, rollouts.position)
    closed = rs.simulate("demo-base", scenario, num_rollouts=1, seconds=2.0)
    nobody = rs.simulate("demo-base", scenario, num_rollouts=1, seconds=2.0, entries="none")
    count = len(scenario.simulated_indices)
    stays = nobody.valid[0, :, :count].all(-1)
    assert stays.sum() > 5
    assert torch.allclose(nobody.position[0, :, :count][stays], closed.position[0][stays], atol=1e-3)
    assert nobody.valid[0, :, count:].sum() == 0


def test_an_agent_that_is_put_elsewhere_has_no_past(scenario):
    policy, batch = load_policy("demo-base"), collate([scenario])
    with torch.no_grad():
        context = policy.encode(batch)
        state = policy.begin(context, 1, None, torch.zeros(1, 1, batch.agent_mask.shape[1], 0))
        decision = policy.decide(context, state).sample(rs.Sampling(), torch.full((*state.heading.shape, 1), 0.5))
        poses = policy.advance(context, state, decision).poses
        moved = poses.clone()
        moved[:, :, 0, :, 0] += 500.0 + torch.arange(5) * 0.4
        forced = impose(moved, agent=0)
        state = policy.advance(context, state, decision, forced)
    assert (state.past.row[:, :, 0] == -1).all()
    assert (state.past.row[:, :, 1] >= 0).any()
    assert torch.equal(state.poses[0, 0, 0], moved[0, 0, 0])
    assert state.pending.motion[0, 0, 0, 0].norm() < 15  # not 500 m


def impose(poses, agent):
    valid = torch.zeros(poses.shape[:-1], dtype=torch.bool)
    valid[:, :, agent] = True
    return AgentStates(poses[..., :2], poses[..., 2], valid)


def test_gates_are_where_lanes_cross_the_border():
    road = scenes.straight_road()
    gates = GateFinder(road).find(np.zeros(2), np.array([5.0, 0.0]), 60.0)
    assert len(gates) > 0
    assert np.allclose(np.linalg.norm(gates.position, axis=-1), 60.0, atol=2.1)
    ahead = gates.position[:, 0] > 0
    assert np.allclose(gates.standing_closing_mps, np.where(ahead, 5.0, -5.0), atol=0.3)


def appear(speed, others, velocity, path=((0.0, 0.0), (100.0, 0.0))):
    """Speed of somebody who appears at the origin and drives east, or along a path."""
    line = resample_to(np.array(path), int(arc_length(np.array(path))[-1]) + 1)
    path_m = np.arange(len(line), dtype=float)
    return find_safe_speed(np.zeros(2), np.array([1.0, 0.0]), speed, np.array(others), np.array(velocity), line, path_m)


def test_nobody_appears_where_braking_could_not_avoid_the_one_ahead():
    still = [(0.0, 0.0)]
    assert appear(15.0, [(200.0, 0.0)], still) == 15.0
    slowed = appear(15.0, [(30.0, 0.0)], still)
    # half a second on, then braking at 3 m/s², it stops 6 m behind
    assert 0.5 * slowed + slowed**2 / (2 * 3) == pytest.approx(24.0)
    assert appear(15.0, [(4.0, 1.0)], still) is None
    assert appear(2.0, [(-20.0, 0.0)], [(20.0, 0.0)]) is None
    assert appear(15.0, [(4.0, 3.5)], still) == 15.0  # beside


def test_who_appears_sees_the_one_behind_the_bend_and_nobody_who_is_about_to_cross():
    bend = ((0.0, 0.0), (20.0, 0.0), (20.0, 60.0))
    assert appear(15.0, [(20.0, 15.0)], [(0.0, 0.0)]) == 15.0
    slowed = appear(15.0, [(20.0, 15.0)], [(0.0, 0.0)], bend)
    assert 0.5 * slowed + slowed**2 / (2 * 3) == pytest.approx(35.0 - 6.0)
    assert appear(10.0, [(15.0, -15.0)], [(0.0, 10.0)]) is None
    assert appear(10.0, [(15.0, -15.0)], [(0.0, -10.0)]) == 10.0


def busy_log():
    """A log in which vehicles become visible 60 m ahead of an ego that stands, one every second."""
    road = scenes.straight_road()
    steps = 300
    tracks = road.tracks.select(np.repeat(road.ego_index, 30))
    names = ("position", "heading", "velocity", "size")
    still = {name: np.repeat(getattr(tracks, name)[:, 10:11], steps, 1) for name in names}
    tracks = replace(tracks, **still, valid=np.zeros((30, steps), bool), object_id=np.arange(30))
    tracks.velocity[0] = 0.0
    tracks.valid[0] = True
    ego = tracks.position[0, 0].copy()
    for car in range(1, 30):
        first = 10 * car
        travel = 10.0 * 0.1 * np.arange(steps - first)
        tracks.position[car, first:, 0] = ego[0] - 60.0 + travel
        tracks.velocity[car] = (10.0, 0.0)
        tracks.valid[car, first : first + 100] = True
    return replace(
        road, tracks=tracks, timestamps_s=np.round(np.arange(steps) * 0.1, 1), ego_index=0,
        tracks_to_predict=np.zeros(0, np.int32), difficulty=np.zeros(0, np.int8),
    )  # fmt: skip


def test_fitted_entries_expect_what_the_log_had(tmp_path):
    log = busy_log()
    model = fit_entries([log])
    gates = GateFinder(log).find(log.tracks.position[0, 10, :2] - log.origin, np.zeros(2), 60.0)
    entered = 28  # in 28.5 s
    assert model.expect(gates).sum() * 57 == pytest.approx(entered, rel=0.25)
    assert np.median(model.entrants.speed_mps) == pytest.approx(10.0)
    write_entries(tmp_path / "entries.npz", model)
    read = load_entries(str(tmp_path / "entries.npz"))
    assert isinstance(read, FittedEntries)
    assert np.array_equal(read.expect(gates), model.expect(gates))
    (tmp_path / "entries.npz").write_bytes(b"PK")
    with pytest.raises(DataError, match="rlftsim entries fit"):
        load_entries(str(tmp_path / "entries.npz"))


def parked_log(ego_mps):
    """A log in which cars parked every 10 m beside the road become visible 60 m ahead of the ego."""
    road = scenes.straight_road()
    steps = 300
    tracks = road.tracks.select(np.repeat(road.ego_index, 40))
    still = {
        name: np.repeat(getattr(tracks, name)[:, 10:11], steps, 1)
        for name in ("position", "heading", "velocity", "size")
    }
    tracks = replace(tracks, **still, valid=np.zeros((40, steps), bool), object_id=np.arange(40))
    ego = tracks.position[0, 0].copy()
    tracks.position[0, :, 0] += ego_mps * 0.1 * np.arange(steps)
    tracks.velocity[:] = 0.0
    tracks.velocity[0, :, 0] = ego_mps
    tracks.valid[0] = True
    for car in range(1, 40):
        tracks.position[car] = ego + np.array([10.0 * car, -3.5, 0.0])
        tracks.valid[car] = np.abs(tracks.position[car, 0, 0] - tracks.position[0, :, 0]) < 60.0
    return replace(
        road, tracks=tracks, timestamps_s=np.round(np.arange(steps) * 0.1, 1), ego_index=0,
        tracks_to_predict=np.zeros(0, np.int32), difficulty=np.zeros(0, np.int8),
    )  # fmt: skip


def test_parked_cars_enter_as_fast_as_the_ego_comes_and_none_where_it_stands():
    model = fit_entries([parked_log(speed) for speed in (0.0, 1.0, 2.0)] * 8)
    finder, ego = GateFinder(parked_log(2.0)), np.zeros(2)
    rates = [model.expect(finder.find(ego, np.array([speed, 0.0]), 60.0)).sum() for speed in (0.0, 1.0, 2.0)]
    assert rates[0] < 0.2 * rates[2]
    assert rates[2] * 2 == pytest.approx(2.0 / 10.0, rel=0.3)  # per second
    gates = finder.find(ego, np.array([2.0, 0.0]), 60.0)
    entrants = model.draw(gates.select(np.flatnonzero(gates.position[:, 0] > 0)), np.random.default_rng(0))
    assert (entrants.speed_mps < 0.1).all()
    assert (np.abs(entrants.left_m) > 1.8).all()


def test_a_scene_with_more_agents_now_expects_more_to_enter():
    model = load_entries("fitted")
    gates = GateFinder(scenes.straight_road()).find(np.zeros(2), np.array([5.0, 0.0]), 60.0)
    denser = replace(gates, moving_per_km=4 * gates.moving_per_km, standing_per_km=4 * gates.standing_per_km)
    assert model.expect(denser).sum() > 1.2 * model.expect(gates).sum()


def test_an_ego_that_is_led_follows_the_log_while_others_enter(scenario):
    batch = collate([add_visitors(scenario)])
    policy = load_policy("demo-base")
    rollouts = simulate(
        policy, batch, num_rollouts=2, seed=0, entries=load_entries("fitted"),
        force=lead_ego(batch, policy.steps_per_decision),
    )  # fmt: skip
    ego = int(np.flatnonzero(scenario.simulated_indices == scenario.ego_index)[0])
    logged = scenario.tracks.position[scenario.ego_index, 11:, :2] - scenario.origin
    assert np.allclose(rollouts.position[0, :, ego].numpy(), logged, atol=1e-3)
    assert rollouts.valid[0, :, len(scenario.simulated_indices) :].any()


def test_what_does_not_fit_is_refused_in_one_line(scenario):
    with pytest.raises(ConfigError, match="did you mean 'fixed-rate'"):
        rs.simulate("demo-base", scenario, num_rollouts=1, entries="fixed-rates")
    with pytest.raises(ConfigError, match=r"agents enter every 0\.5 s"):
        rs.simulate("constant_velocity", scenario, num_rollouts=1, entries="none")


def test_rollouts_with_entries_are_files_that_play(scenario, tmp_path):
    options = ["--data", "synthetic", "--scenario", scenario.scenario_id, "--num-rollouts", "1", "--seconds", "10"]
    command = ["simulate", "demo-base", *options, "--entries", "fixed-rate", "--out", str(tmp_path / "out")]
    assert main([*command, "--export", "page"]) == 0
    with np.load(tmp_path / "out" / f"{scenario.scenario_id}.npz") as arrays:
        assert arrays["valid"].shape == arrays["x"].shape
        assert arrays["x"].shape[1] == len(scenario.simulated_indices) + sum(VISITORS.values())
        assert not arrays["valid"].all()
    assert (tmp_path / "out" / f"{scenario.scenario_id}.html").exists()


def test_lights_of_the_log_are_seen_after_eight_seconds(monkeypatch):
    junction = scenes.junction_with_light()
    policy, batch = load_policy("demo-base"), collate([add_visitors(junction)])
    now, later = (policy.encode(replace(batch, light_step=step)) for step in (10, 80))
    assert not torch.equal(now.scene.map_features, later.scene.map_features)  # red until step 50
    assert torch.equal(now.scene.map_features, policy.encode(batch).scene.map_features)
    steps, encode = [], type(policy).encode
    monkeypatch.setattr(type(policy), "encode", lambda self, b: steps.append(b.light_step) or encode(self, b))
    kept = simulate(policy, collate([junction]), num_rollouts=1, seed=0, num_steps=100)
    assert steps == [10]  # maps are not encoded anew
    monkeypatch.delattr(type(policy), "relight")
    anew = simulate(policy, collate([junction]), num_rollouts=1, seed=0, num_steps=100)
    assert steps == [10, 10, 90]
    assert torch.allclose(kept.position, anew.position, atol=1e-3)


def test_a_calibrated_model_sees_a_newcomer_by_where_it_drives():
    traffic = Traffic(*(torch.zeros(1, 1, 1, 1, *shape) for shape in ((2,), (), (2,), (), ())))
    x = 500.0 - torch.arange(1, 6)  # 10 m/s, to the west
    poses = torch.stack([x, torch.zeros(5), torch.full((5,), torch.pi)], -1)[None, None, None]
    after = traffic.advance(poses, 0.5)
    assert after.speed.item() == pytest.approx(10.0, abs=1e-4)
    assert after.turn.item() == pytest.approx(0.0, abs=1e-6)


def test_windows_of_a_log_are_scenarios_of_their_own(scenario):
    assert scenario.window(0).scenario_id == scenario.scenario_id
    assert scenario.window(5).scenario_id == f"{scenario.scenario_id}@5"


def test_logs_without_lanes_or_without_future_say_that_nobody_enters(scenario):
    for logs in ([], [edge_scenes(scenario)["no map"]], [without_future(scenario)]):
        with pytest.raises(DataError, match="nobody enters"):
            fit_entries(logs)


def test_entries_of_a_batch_in_the_world_frame_are_refused(scenario):
    with pytest.raises(ConfigError, match="map frame"):
        rs.simulate("demo-base", collate([scenario], frame="world"), num_rollouts=1, seconds=1.0, entries="none")


def test_files_of_others_have_no_agent_that_flies(scenario, tmp_path):
    options = ["--data", "synthetic", "--scenario", scenario.scenario_id, "--num-rollouts", "1", "--seconds", "10"]
    command = ["simulate", "demo-base", *options, "--entries", "fixed-rate", "--out", str(tmp_path / "out")]
    assert main([*command, "--export", "gpudrive"]) == 0
    [file] = tmp_path.rglob("tfrecord-*.json")
    for agent in json.loads(file.read_text())["objects"]:
        speed = [np.hypot(v["x"], v["y"]) for v, there in zip(agent["velocity"], agent["valid"]) if there]
        assert max(speed, default=0.0) < 60.0


def test_open_worlds_are_shown_with_their_newcomers_and_not_scored(scenario, rollouts):
    assert "<canvas" in rs.show(scenario, rollouts).page
    short = rs.simulate("demo-base", scenario, num_rollouts=1, entries="none")
    for simulated in (rollouts, short):
        with pytest.raises(DataError, match="agents leave and enter"):
            rs.score(scenario, simulated)


def test_what_does_not_fit_leaves_no_folder(tmp_path, capsys):
    command = ["simulate", "--data", "synthetic", "--limit", "1", "--num-rollouts", "1", "--out", str(tmp_path / "out")]
    for words, reason in (
        (["demo-base", "--seconds", "0.3"], "decides for 0.5 s at a time"),
        (["constant_velocity", "--entries", "none"], "take a SMART model"),
    ):
        assert main([command[0], words[0], *command[1:], *words[1:]]) == 2
        assert reason in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()
    assert main(["entries", "fit", "synthetic", str(tmp_path / "entries")]) == 2
    assert "ends in .npz" in " ".join(capsys.readouterr().err.split())


def test_stored_open_worlds_continue_and_are_refused_by_the_metric(scenario, tmp_path, capsys):
    out = str(tmp_path / "out")
    command = [
        "simulate",
        "demo-base",
        "--data",
        "synthetic",
        "--scenario",
        scenario.scenario_id,
        "--num-rollouts",
        "1",
    ]
    assert main([*command, "--entries", "none", "--out", out]) == 0
    [file] = (tmp_path / "out").glob("*.npz")
    changed = file.stat().st_mtime_ns
    assert main([*command, "--entries", "none", "--out", out]) == 0
    assert file.stat().st_mtime_ns == changed
    assert main(["score", out, "--data", "synthetic"]) == 2
    assert "agents leave and enter" in " ".join(capsys.readouterr().err.split())
