"""The loop of a planner and the traffic model: the same dice as `simulate`, forks, snapshots, the log itself."""

import hashlib
import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.numpy import load, save

from rlftsim.envs import EgoEnv, EgoVectorEnv, parallel_env
from rlftsim.envs.episode import advance
from rlftsim.envs.planners.registry import load_planner
from rlftsim.envs.world import Dice, begin, build_world, fork, step_world
from rlftsim.errors import ConfigError, DataError
from rlftsim.policies.registry import load_policy
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.scenario.open import open_dataset
from rlftsim.scenario.types import CURRENT_STEP, STEP_S
from scenes import Mover, bend, build_scenario, junction_with_light, straight_road, with_gaps, without_future


@pytest.fixture(scope="module")
def model():
    return load_policy("demo-base")


@pytest.fixture(scope="module")
def data():
    return open_dataset("synthetic", "validation")


def pose_action(before, after):
    """The `pose` action that leads from one pose to another, float32 as an action is."""
    dx, dy = after[:2] - before[:2]
    cos, sin = np.cos(before[2]), np.sin(before[2])
    turn = (after[2] - before[2] + np.pi) % (2 * np.pi) - np.pi
    return np.array([cos * dx + sin * dy, cos * dy - sin * dx, turn], np.float32)


def others(env):
    """Poses of all agents but the ego at all steps after the current one, float32."""
    track = np.stack([step[0] for step in env.state.world.track[CURRENT_STEP + 1 :]], 1)
    return np.delete(track[..., :3], env.episode.world.scenes[0].ego, axis=0).astype(np.float32)


@pytest.mark.parametrize("name", ["demo-base", "constant_velocity"])
def test_decisions_of_the_model_fed_back_as_poses_are_a_simulation(name, data):
    policy = load_policy(name)
    scenarios = [data[0]] if name == "demo-base" else [bend()]
    for scenario in scenarios:
        reference = simulate(policy, collate([scenario]), num_rollouts=range(3, 4), seed=7)
        env = EgoEnv(scenarios=[scenario], policy=policy, action="pose", stop_on=(), reward="none")
        env.reset(seed=7, options={"rollout": 3})
        ego = env.episode.world.scenes[0].ego
        wanted = torch.cat([reference.position, reference.heading[..., None]], -1)[0, 0].numpy()  # [A, 80, 3]
        for step in range(80):
            env.step(pose_action(env.state.world.motion[0, ego], wanted[ego, step].astype(np.float64)))
        assert np.array_equal(others(env), np.delete(wanted, ego, axis=0))
        np.testing.assert_allclose(env.state.world.motion[0, ego, :2], wanted[ego, -1, :2], atol=1e-4)


def test_a_world_that_the_policy_drives_alone_is_a_simulation(model, data):
    scenario = data[1]
    world = build_world([scenario], model, rules={"*": "policy"})
    state = begin(world, [Dice(5, 2)])
    for _ in range(80):
        state = step_world(world, state, np.zeros((0, 5)))
    reference = simulate(model, collate([scenario]), num_rollouts=range(2, 3), seed=5)
    track = np.stack([step[0] for step in state.track[CURRENT_STEP + 1 :]], 1)
    assert np.array_equal(track[..., :2].astype(np.float32), reference.position[0, 0].numpy())


def test_the_log_replayed_is_the_log(data):
    worst = 0.0
    for scenario in [*(data[i] for i in range(30)), bend(), with_gaps()]:
        env = EgoEnv(scenarios=[scenario], action="pose", traffic="replay", stop_on=(), reward="none")
        _, info = env.reset(seed=0)
        planner = load_planner("replay")
        planner.reset(info)
        episode, state = env.episode, env.state
        for _ in range(80):  # without the observations, which the planner ignores
            state, _ = advance(episode, state, planner.act({})[None])
        assert not any(collision.at_fault for collision in state.collisions[0]), scenario.scenario_id
        scene = env.episode.world.scenes[0]
        track = np.stack([step[0, : len(scene.object_id)] for step in state.world.track], 1)
        away = np.linalg.norm(track[..., :2] - scene.logged[..., :2], axis=-1)
        worst = max(worst, float(away[scene.valid].max()))
    assert worst <= 1e-4


def test_the_same_seed_gives_the_same_bits_alone_and_in_a_vector(model, data):
    scenarios = [data[i] for i in range(6)]
    settings = {"scenarios": scenarios, "policy": model, "stop_on": (), "action": "bicycle"}
    actions = np.random.default_rng(0).uniform(-1, 1, (7, 32, 2)).astype(np.float32)
    vector = EgoVectorEnv(32, **settings)
    seen, _ = vector.reset(seed=40)
    ours = [seen]
    for action in actions:
        ours.append(vector.step(action)[0])
    for slot in (13, 31):
        for _ in range(slot // 13):  # slot 31 twice
            env = EgoEnv(**settings)
            alone, _ = env.reset(seed=40 + slot)
            for step, action in enumerate([None, *actions[:, slot]]):
                if action is not None:
                    alone = env.step(action)[0]
                assert all(np.array_equal(ours[step][name][slot], alone[name]) for name in alone)


def test_forks_with_the_same_dice_differ_only_after_the_running_block(model, data):
    later = 0
    for i in range(3):
        env = EgoEnv(scenarios=[data[i]], policy=model, stop_on=(), reward="none")
        env.reset(seed=1)
        for _ in range(12):
            env.step(np.zeros(2, np.float32))
        same, braking = env.fork(2)
        for step in range(17):
            env.step(np.array([0.5, 0.0], np.float32))
            same.step(np.array([0.5, 0.0], np.float32))
            braking.step(np.array([-1.0, 0.3], np.float32))
            assert np.array_equal(others(env), others(same))
            if step < 3:  # steps 13, 14 and 15 belong to the block that was running
                assert np.array_equal(others(env), others(braking))
        later += not np.array_equal(others(env), others(braking))
    assert later >= 1


def test_a_fork_with_new_dice_differs_where_the_same_actions_are_taken(model, data):
    env = EgoEnv(scenarios=[data[0]], policy=model, stop_on=(), reward="none")
    env.reset(seed=1)
    branches = [env, *env.fork(2, noise="new")]
    for branch in branches:
        for _ in range(15):
            branch.step(np.zeros(2, np.float32))
    tracks = [others(branch) for branch in branches]
    assert not np.array_equal(tracks[0], tracks[1])
    assert not np.array_equal(tracks[1], tracks[2])


RESTORE = """
import sys, numpy as np
from rlftsim.envs import EgoEnv
env = EgoEnv(data="synthetic", action="bicycle", stop_on=(), reward="none", max_steps=40)
env.restore(open(sys.argv[1], "rb").read())
while not env.state.ended[0]:
    env.step(np.array([-0.2, 0.1], np.float32))
np.save(sys.argv[2], np.stack(env.state.world.track))
"""


def test_a_snapshot_goes_on_in_another_process(tmp_path):
    env = EgoEnv(data="synthetic", action="bicycle", stop_on=(), reward="none", max_steps=40)
    env.reset(seed=4)
    for _ in range(13):
        env.step(np.array([0.4, 0.0], np.float32))
    env = env.fork(1, noise="new")[0]
    for _ in range(10):
        env.step(np.array([0.4, 0.0], np.float32))
    saved = env.snapshot()
    assert len(saved) <= 1e6
    (tmp_path / "saved").write_bytes(saved)
    out = tmp_path / "track.npy"
    subprocess.run([sys.executable, "-c", RESTORE, str(tmp_path / "saved"), str(out)], check=True)
    while not env.state.ended[0]:
        env.step(np.array([-0.2, 0.1], np.float32))
    assert np.array_equal(np.load(out), np.stack(env.state.world.track))


def test_snapshots_of_something_else_are_refused(data):
    env = EgoEnv(scenarios=[bend()], traffic="replay")
    env.reset(seed=0)
    saved = env.snapshot()
    other = EgoEnv(scenarios=[bend()], traffic="replay", max_steps=40)
    with pytest.raises(ConfigError, match="another max_steps"):
        other.restore(saved)
    with pytest.raises(ConfigError, match="another traffic model"):
        EgoEnv(
            scenarios=[bend()], traffic="constant_velocity", model="constant_velocity", drivers={101: "policy"}
        ).restore(saved)
    with pytest.raises(DataError, match="not a snapshot"):
        env.restore(b"12345678")
    for place in range(0, len(saved), 97):
        damaged = saved[:place] + bytes([saved[place] ^ 1]) + saved[place + 1 :]
        with pytest.raises(DataError, match="not a snapshot of an episode, or a damaged one"):
            env.restore(damaged)
    body = saved[:-32]
    for dice in (b'{"seed": -1,', b'{"seed":"0",', b'{"seed":[0],'):
        damaged = body.replace(b'{"seed": 0, ', dice)
        assert damaged != body
        with pytest.raises(DataError, match="damaged snapshot"):
            env.restore(damaged + hashlib.sha256(damaged).digest())
    env.restore(saved)


def test_a_changed_snapshot_with_a_right_checksum_is_refused_in_one_line():
    env = EgoEnv(scenarios=[bend()], traffic="replay", stop_on=())
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.zeros(2, np.float32))
    saved = env.snapshot()
    arrays = load(saved[:-32])
    motion, about = arrays["motion"], json.loads(arrays["about"].tobytes())
    scenario_id = about["scenarios"][0]
    begins_elsewhere, jumps, far = motion.copy(), motion.copy(), motion.copy()
    begins_elsewhere[0, 0, 0] += 1.0
    jumps[2:, 0, 1] += 50.0
    far[2:] *= 1e200
    for changed_about, changed_motion, cause in (
        ({"goals": {scenario_id: {"abc": [1, 2]}}}, motion, "abc"),
        ({"scenarios": []}, motion, "its scenarios cannot be used"),
        ({"scenarios": [["a"]]}, motion, "its scenarios cannot be used"),
        ({"dice": [[]]}, motion, "its dice are not of 1 scenarios"),
        ({"dice": about["dice"] * 2}, motion, "its dice are not of 1 scenarios and 1 decisions"),
        ({"dice": [5]}, motion, "not iterable"),
        ({}, motion[:0], "its motion has -1 steps"),
        ({}, np.repeat(motion, 40, 0), "its motion has 159 steps, not 0 to 80"),
        ({}, motion.astype(np.float32), "its motion cannot be used"),
        ({}, far, "its motion cannot be used"),
        ({}, begins_elsewhere, "does not begin as the log"),
        ({}, jumps, r"agent \d+ in scenario .* jumps by 50 m at step 2"),
    ):
        text = np.frombuffer(json.dumps({**about, **changed_about}).encode(), np.uint8)
        body = save({"motion": np.ascontiguousarray(changed_motion), "about": text})
        with pytest.raises(DataError, match=rf"^a damaged snapshot \(.*{cause}.*\): take a new one with snapshot"):
            env.restore(body + hashlib.sha256(body).digest())
    env.restore(saved)


def test_replayed_agents_stand_in_a_gap_of_their_log_and_leave_with_its_end():
    env = EgoEnv(scenarios=[with_gaps()], traffic="replay", stop_on=())
    env.reset(seed=0)
    scene = env.episode.world.scenes[0]
    row = int(np.flatnonzero(scene.object_id == 101)[0])
    for _ in range(16):  # step 26 of the log, where agent 101 is not seen
        observation = env.step(np.zeros(2, np.float32))[0]
    np.testing.assert_array_equal(env.state.world.motion[0, row], [*scene.logged[row, 24, :3], 0.0, 0.0])
    assert observation["neighbors_mask"].sum() == 4
    assert observation["neighbors"][:4, 9].max() == pytest.approx(0.2)
    for _ in range(61):  # step 87, its last state
        observation = env.step(np.zeros(2, np.float32))[0]
    left = env.step(np.zeros(2, np.float32))[0]
    assert left["neighbors_mask"].sum() == observation["neighbors_mask"].sum() - 1


def test_a_replayed_agent_is_not_hit_where_it_is_not_logged():
    for missing, contacts in ((range(20, 91), 0), (range(20, 85), 0), (range(85, 91), 1)):
        lead = Mover(x_m=40.0, speed_mps=4.5, missing=tuple(missing))
        env = EgoEnv(scenarios=[build_scenario("cut", (Mover(speed_mps=11.0), lead))], traffic="replay",
                     action="pose", stop_on=(), reward="none")  # fmt: skip
        env.reset(seed=0)
        for _ in range(80):
            env.step(np.array([1.1, 0.0, 0.0], np.float32))
        result = env.result()
        assert len(result.record.collisions) == contacts
        assert result.planner.time_to_collision == float(not contacts)


def test_idm_traffic_stops_behind_a_planner_that_stands():
    env = EgoEnv(scenarios=[straight_road()], traffic="policy", policy=load_policy("constant_velocity"),
                 drivers={"vehicles": "idm"}, action="pose", stop_on=(), reward="none")  # fmt: skip
    # the rule for the ego comes first, and pedestrians follow the policy
    env.reset(seed=0)
    world = env.episode.world
    assert [int(d) for d in world.drivers[0]] == [0, 4, 4, 1, 1, 4]
    follower = build_world([straight_road()], None, rules={101: "planner", "vehicles": "idm", "*": "replay"})
    state = begin(follower, [Dice(0)])
    standing = np.append(follower.scenes[0].logged[1, 10, :3], [0.0, 0.0])[None]
    for _ in range(80):
        state = step_world(follower, state, standing)
    gap = standing[0, 0] - state.motion[0, 0, 0] - follower.size[0, :2, 0].sum() / 2
    assert 0.3 < gap < 3.0
    assert np.hypot(*state.motion[0, 0, 3:]) < 0.5


def test_a_driver_of_all_the_others_comes_before_the_traffic():
    settings = {"scenarios": [straight_road()], "traffic": "replay", "drivers": {"*": "constant_velocity"}}
    env = EgoEnv(**settings)
    env.reset(seed=0)
    assert [int(d) for d in env.episode.world.drivers[0]] == [0, 3, 3, 3, 3, 3]
    everyone = parallel_env(scenarios=[straight_road()], traffic="replay", controlled="*")
    assert len(everyone.reset(seed=0)[0]) == 6


def test_a_bicycle_that_tracks_a_steady_plan_keeps_its_speed():
    log = build_scenario("steady", (Mover(speed_mps=9.9),))
    env = EgoEnv(scenarios=[log], traffic="replay", action="trajectory", tracker="bicycle", stop_on=(), reward="none")
    env.reset(seed=0)
    plan = np.zeros((5, 3), np.float32)
    plan[:, 0] = np.arange(1, 6)  # 10 m/s
    for _ in range(80):
        env.step(plan)
    result = env.result()
    np.testing.assert_allclose(np.hypot(*result.record.agent_motion[3:, 3:].T), 10.0, atol=1e-3)
    assert result.planner.comfort == 1.0


@pytest.mark.parametrize(("reverse", "expected"), [(False, [-1.6, -1.2, -0.8, -0.4, 0.0, 0.0]), (True, [-2.0] * 6)])
def test_a_bicycle_that_backs_up_brakes_within_its_limit_or_goes_on(reverse, expected):
    log = build_scenario("backing", (Mover(speed_mps=-2.0),))
    env = EgoEnv(scenarios=[log], traffic="replay", reverse=reverse, stop_on=(), reward="none")
    env.reset(seed=0)
    speeds = [env.step(np.zeros(2, np.float32))[0]["ego"][0] for _ in range(6)]
    np.testing.assert_allclose(speeds, expected, atol=1e-5)


def test_hard_braking_does_not_speed_up_backwards():
    log = build_scenario("backing", (Mover(speed_mps=-2.0),))
    env = EgoEnv(scenarios=[log], traffic="replay", reverse=True, hard_braking=True, stop_on=(), reward="none")
    env.reset(seed=0)
    observation, *_ = env.step(np.array([-1.0, 0.0], np.float32))
    assert observation["ego"][0] == pytest.approx(-2.4, abs=1e-5)


@pytest.mark.parametrize("speed", [-3.0, -0.6])
def test_idm_traffic_backs_up_as_in_its_log(speed):
    log = build_scenario("backing", (Mover(x_m=60.0, y_m=30.0), Mover(x_m=10.0, heading_rad=0.5, speed_mps=speed)))
    world = build_world([log], None, rules={"ego": "planner", "vehicles": "idm", "*": "replay"})
    state = begin(world, [Dice(0)])
    for _ in range(20):
        state = step_world(world, state, world.logged[0, :1, CURRENT_STEP])
    now, logged = state.motion[0, 1], world.logged[0, 1, CURRENT_STEP + 20]
    assert now[2] == pytest.approx(0.5, abs=1e-3)
    np.testing.assert_allclose(now[:2], logged[:2], atol=0.2)
    np.testing.assert_allclose(now[3:], logged[3:], atol=0.3)


def shuttling(acceleration_mps2, speed_mps=-3.0, heading_rad=0.5):
    """A log of a vehicle that backs up, stops, and goes on forward (or the other way around)."""
    log = build_scenario("turning", (Mover(x_m=60.0, y_m=30.0), Mover(x_m=10.0, heading_rad=heading_rad)))
    time = STEP_S * (np.arange(91) - CURRENT_STEP)
    speed = speed_mps + acceleration_mps2 * np.maximum(time, 0.0)
    forward = np.array([np.cos(heading_rad), np.sin(heading_rad)])
    tracks, row = log.tracks, log.simulated_indices[1]
    position, velocity = tracks.position.copy(), tracks.velocity.copy()
    way = np.append(0.0, np.cumsum((speed[1:] + speed[:-1]) / 2 * STEP_S))
    position[row, :, :2] += ((way - way[CURRENT_STEP]) - 8.0 * time)[:, None] * forward
    velocity[row] = speed[:, None] * forward
    return replace(log, tracks=replace(tracks, position=position, velocity=velocity))


@pytest.mark.parametrize(
    ("speed", "acceleration"), [(-3.0, 0.6), (-3.0, 1.5), (-3.0, 2.5), (3.0, 0.6), (3.0, 2.5), (-1.2, 0.6), (-1.2, 1.5)]
)
def test_idm_traffic_stops_before_it_goes_the_other_way(speed, acceleration):
    log = shuttling(-np.sign(speed) * acceleration, speed)
    world = build_world([log], None, rules={"ego": "planner", "vehicles": "idm", "*": "replay"})
    state = begin(world, [Dice(0)])
    motion = [state.motion[0, 1]]
    for _ in range(80):
        state = step_world(world, state, world.logged[0, :1, CURRENT_STEP])
        motion.append(state.motion[0, 1])
    motion = np.array(motion)
    forward = motion[:, 3] * np.cos(0.5) + motion[:, 4] * np.sin(0.5)
    assert np.sign(forward[-1]) == -np.sign(speed)
    assert np.abs(np.diff(forward)).max() <= 3.02 * STEP_S
    np.testing.assert_allclose(motion[:, 2], 0.5, atol=1e-3)
    moved = np.linalg.norm(np.diff(motion[:, :2], axis=0), axis=1) / STEP_S
    np.testing.assert_allclose(moved, np.abs(forward[1:] + forward[:-1]) / 2, atol=0.35, rtol=0.4)
    way = np.append(0.0, np.cumsum(moved * np.sign(forward[1:]) * np.sign(speed))) * STEP_S
    assert way.max() == pytest.approx(speed**2 / 2 / acceleration, abs=0.3)  # it turns where its log does


def test_traffic_of_smart_that_backs_up_starts_without_a_jump(model):
    log = build_scenario("backing", (Mover(x_m=60.0, y_m=30.0), Mover(x_m=10.0, speed_mps=-5.0)))
    world = build_world([log], model, rules={"ego": "planner", "*": "policy"})
    state = begin(world, [Dice(0)])
    moved = step_world(world, state, world.logged[0, :1, CURRENT_STEP]).motion[0, 1, :2] - state.motion[0, 1, :2]
    assert np.linalg.norm(moved) < 1.0


def test_lights_hold_their_last_state_where_a_log_ends():
    cut = replace(without_future(), lights=junction_with_light().lights)
    lights = cut.lights
    kept = lights.step <= CURRENT_STEP
    cut = replace(cut, lights=replace(lights, **{n: getattr(lights, n)[kept] for n in vars(lights)}))
    env = EgoEnv(scenarios=[cut], traffic="constant_velocity")
    _, info = env.reset(seed=0)
    assert not info["lights_held"]
    observation, _, _, _, info = env.step(np.zeros(2, np.float32))
    assert info["lights_held"]
    assert observation["lights"][0, 2] == 1  # red


def test_forking_costs_no_copies(data):
    world = build_world([data[0]], None, rules={"ego": "planner", "*": "replay"})
    state = begin(world, [Dice(0)])
    assert all(branch is state for branch in fork(world, state, 8))
