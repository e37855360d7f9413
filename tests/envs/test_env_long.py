"""Episodes of another length than the metric's 8 seconds."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import parallel_api_test
from PIL import Image

import scenes
from rlftsim.cli import main
from rlftsim.envs import EgoEnv, parallel_env
from rlftsim.envs.drive_scenario import DriveConfig
from rlftsim.envs.planner_episode import run_planner
from rlftsim.envs.planners.registry import load_planner, read_action_settings
from rlftsim.envs.route import find_route
from rlftsim.envs.world import Dice, begin, build_world, find_presence, step_world
from rlftsim.errors import ConfigError, DataError
from rlftsim.evaluation.drive_results import DriveResult, compare_drives
from rlftsim.policies.registry import load_policy
from rlftsim.rollout.entries import load_entries
from rlftsim.rollout.open_world import EGO_GAP_M, add_visitors
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.scenario.open import to_scenarios
from rlftsim.scenario.types import CURRENT_STEP, HISTORY_STEPS, LightState
from scenes import Mover, bend_map, build_scenario, junction_map, junction_with_light, light, straight_road

STILL = np.zeros(2, np.float32)


@pytest.fixture(scope="module")
def policy():
    return load_policy("demo-base")


@pytest.fixture
def long_logs(monkeypatch):
    """Scenarios drawn by hand have 15 s after the current step."""
    monkeypatch.setattr(scenes, "TOTAL_STEPS", HISTORY_STEPS + 150)


def drive_all(env, action=STILL, **options):
    """Observations and infos of an episode with the same action at every step."""
    observations, infos = zip(env.reset(seed=3, options=options))
    observations, infos, is_over = list(observations), list(infos), False
    while not is_over:
        observation, _, terminated, truncated, info = env.step(action)
        observations.append(observation)
        infos.append(info)
        is_over = terminated or truncated
    return observations, infos


def driven(scenario, name="idm", **settings):
    planner = load_planner(name)
    settings |= {"stop_on": (), "reward": "none", **read_action_settings(planner)}
    source = EgoEnv(scenarios=[scenario], **settings).source
    (((result,), _),) = run_planner(source, planner, [scenario], seed=0, rollouts=[0])
    return result


def test_a_world_that_the_policy_drives_alone_is_a_simulation_and_sees_the_later_lights(policy):
    # a light that is red now, and green from second 8 on
    scenario = build_scenario("light", scenes.TRAFFIC, junction_map(), light(1, 38.0, 0.2, red_until=90))
    held = replace(scenario, lights=replace(scenario.lights, state=np.full(91, LightState.STOP, np.int8)))
    tracks = []
    for logged in (scenario, held):
        world = build_world([logged], policy, rules={"*": "policy"}, max_steps=120)
        state = begin(world, [Dice(5, 2)])
        for _ in range(120):
            state = step_world(world, state, np.zeros((0, 5)))
        tracks.append(np.stack([step[0] for step in state.track[CURRENT_STEP + 1 :]], 1)[..., :2].astype(np.float32))
        reference = simulate(policy, collate([logged]), num_rollouts=range(2, 3), seed=5, num_steps=120)
        np.testing.assert_array_equal(tracks[-1], reference.position[0, 0].numpy())
    assert not np.array_equal(*tracks)
    np.testing.assert_array_equal(tracks[0][:, :80], tracks[1][:, :80])


@pytest.mark.parametrize("traffic", ["policy", "replay"])
def test_a_longer_episode_begins_with_the_same_bits_and_can_be_stored(traffic, policy):
    settings = {"scenarios": [junction_with_light()], "policy": policy, "traffic": traffic, "stop_on": ()}
    short, long = (EgoEnv(max_steps=steps, **settings) for steps in (80, 95))
    for env in (short, long):
        drive_all(env)
    assert len(short.state.world.track) == HISTORY_STEPS + 80
    np.testing.assert_array_equal(
        np.stack(short.state.world.track), np.stack(long.state.world.track[: HISTORY_STEPS + 80])
    )
    restored = EgoEnv(max_steps=95, **settings)
    restored.restore(long.snapshot())
    np.testing.assert_array_equal(np.stack(restored.state.world.track), np.stack(long.state.world.track))


def test_new_dice_after_second_8_are_those_of_a_simulation_from_there_on(policy):
    env = EgoEnv(scenarios=[junction_with_light()], policy=policy, max_steps=90, stop_on=(), reward="none")
    env.reset(seed=3)
    for _ in range(80):
        env.step(STILL)
    same, other = env.fork(1)[0], env.fork(1, noise="new")[0]
    motions = []
    for branch in (env, same, other):
        for _ in range(10):
            branch.step(STILL)
        motions.append(branch.state.world.motion)
    np.testing.assert_array_equal(motions[0], motions[1])
    assert not np.array_equal(motions[0], motions[2])


def test_replayed_agents_are_gone_after_their_log_and_lights_hold():
    env = EgoEnv(scenarios=[junction_with_light()], traffic="replay", max_steps=100, stop_on=(), reward="none")
    observations, infos = drive_all(env)
    assert observations[80]["neighbors_mask"].sum() > 4
    assert observations[81]["neighbors_mask"].sum() == 0
    np.testing.assert_array_equal(observations[100]["lights"][0, 2:5], observations[80]["lights"][0, 2:5])
    assert observations[100]["lights"][0, 5] == pytest.approx(observations[80]["lights"][0, 5] + 2.0)
    assert [info["lights_held"] for info in (infos[80], infos[81])] == [False, True]
    assert [observations[step]["ego"][10] for step in (0, 99)] == pytest.approx([10.0, 0.1])
    assert infos[-1]["result"].record.is_present[1:, -1].sum() == 0


def test_an_episode_ends_where_the_map_does():
    result = driven(straight_road(), "constant_velocity", traffic="replay", max_steps=600)
    end_m = result.record.agent_motion[-1, 0]
    assert 140 + 20 < end_m < 140 + 40
    assert 80 < result.record.steps < 600
    assert result.missing[f"scores beyond {result.record.steps / 10:.1f} s"] == "the map ends there"
    # not within the 8 s of the log, and not without a map
    fast = build_scenario("fast", (Mover(speed_mps=30.0),))
    assert driven(fast, "constant_velocity", traffic="replay").record.steps == 80
    assert driven(replace(fast, map_features=scenes.NO_MAP), "constant_velocity", max_steps=90).record.steps == 90


def test_scores_that_need_the_log_say_why_they_are_missing():
    result = driven(junction_with_light(), traffic="replay", max_steps=120)
    reason = "the log ends after 8.0 s"
    names = ("progress", "making_progress", "displacement_error", "red_light_rate")
    assert result.missing == {"others_realism": "the metric compares 8 s", **dict.fromkeys(names, reason)}
    assert all(np.isnan(result.scores[name]) for name in names)
    measured = ("nuplan_style", "no_at_fault_collision", "drivable_area", "comfort", "time_to_collision", "least_ttc_s")
    assert all(np.isfinite(result.scores[name]) for name in measured)


def test_a_longer_log_is_a_log_to_compare_with(long_logs):
    scenario = build_scenario("long", (Mover(speed_mps=8.0), Mover(x_m=20.0, speed_mps=8.2)), junction_map())
    scenario = replace(scenario, lights=light(1, 100.0, 0.2, red_until=200))
    assert scenario.num_steps == 161
    result = driven(scenario, "replay", traffic="replay", max_steps=140)
    assert result.record.steps == 140
    assert result.record.is_present.all()
    assert result.planner.displacement_error < 0.01
    assert result.planner.progress > 0.99
    assert result.planner.red_light_rate == 1.0  # at second 12.5
    assert set(result.missing) == {"others_realism"}
    assert driven(scenario, "replay", traffic="replay").planner.red_light_rate == 0.0


def test_the_route_follows_a_long_log_and_the_lanes_beyond_it(long_logs):
    lanes = bend_map()
    scenario = build_scenario("bend", (Mover(speed_mps=7.0, turn_rate_radps=7.0 / 90.0),), lanes)
    route = find_route(scenario, 0, "logged", 161)
    logged = scenario.tracks.position[0, 10:, :2] - scenario.origin
    to_route = np.linalg.norm(logged[:, None] - route.points, axis=-1).min(1)
    assert to_route.max() < 4.0
    end = lanes.polyline(0)[-1, :2] - scenario.origin
    assert np.linalg.norm(route.points[-1] - end) < 3.0
    steps = np.linalg.norm(np.diff(route.points, axis=0), axis=1)
    assert steps.max() < 2.01


def test_idm_traffic_follows_the_lanes_beyond_its_log_and_leaves_at_their_end(policy):
    follower = Mover(x_m=12.0, y_m=0.8, heading_rad=0.13, speed_mps=4.0, turn_rate_radps=4.0 / 90.0)
    scenario = build_scenario("bend", (Mover(speed_mps=0.0), follower), bend_map())
    result = driven(scenario, "constant_velocity", policy=policy, traffic="idm", max_steps=300)
    record = result.record
    is_there = record.is_present[1]
    assert is_there[:100].all()
    assert not is_there[-1]
    assert (np.diff(is_there.astype(int)) <= 0).all()
    lane = bend_map().polyline(0)[:, :2] - scenario.origin
    to_lane = np.linalg.norm(record.motion[1, 85:, None, :2] - lane, axis=-1).min(1)
    assert to_lane[is_there[85:]].max() < 2.5
    assert (np.linalg.norm(record.motion[1, :, 3:], axis=-1)[is_there] < 12.0).all()


def test_gymnasium_and_pettingzoo_find_nothing_to_complain_about_at_600_steps():
    settings = {"scenarios": [junction_with_light()], "traffic": "replay", "max_steps": 600, "stop_on": ()}
    env = gymnasium.make("rlftsim.envs:rlftsim/Ego-v0", **settings)
    check_env(env.unwrapped, skip_render_check=True)
    _, infos = drive_all(env, np.array([-1.0, 0.0], np.float32))
    assert infos[-1]["result"].record.steps == 600
    agents = parallel_env(controlled="vehicles", **settings)
    parallel_api_test(agents, num_cycles=610)


# ---- agents leave and enter ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def crossing():
    return to_scenarios("synthetic", "validation")[0]


@pytest.fixture(scope="module")
def open_env(policy, crossing):
    """An environment after 15 s beside traffic that enters, and what the ego has seen."""
    env = EgoEnv(scenarios=[crossing], policy=policy, max_steps=600, stop_on=(), entries="fixed-rate")
    observations = [env.reset(seed=3)[0]]
    for _ in range(150):
        observations.append(env.step(STILL)[0])
    return env, observations


def test_an_open_world_that_the_policy_drives_alone_is_a_simulation(policy, crossing):
    scenario, entries = add_visitors(crossing), load_entries("fixed-rate")
    world = build_world([crossing], policy, rules={"*": "policy"}, max_steps=150, entries=entries)
    state = begin(world, [Dice(5, 2)])
    for _ in range(150):
        state = step_world(world, state, np.zeros((0, 5)))
    reference = simulate(
        policy, collate([scenario]), num_rollouts=range(2, 3), seed=5, num_steps=150, entries=entries
    )  # fmt: skip
    track = np.stack([step[0] for step in state.track[CURRENT_STEP + 1 :]], 1)
    valid = reference.valid[0, 0].numpy()
    np.testing.assert_array_equal(track[..., :2].astype(np.float32), reference.position[0, 0].numpy())
    np.testing.assert_array_equal(find_presence(world, state)[0][CURRENT_STEP + 1 :, 0].T, valid)
    assert (valid[:, 1:] & ~valid[:, :-1]).any()
    assert np.linalg.norm(track[valid][:, 3:], axis=-1).max() < 30.0  # who enters has not jumped


def test_the_ego_sees_who_enters_and_nobody_with_the_past_of_another(open_env):
    env, observations = open_env
    record = env.result().record
    is_present, position = record.is_present, record.motion[..., :2]
    entered, steps = np.nonzero(is_present[:, 1:] & ~is_present[:, :-1])
    distance = np.linalg.norm(position - position[record.agent], axis=-1)
    assert len(entered)
    assert distance[entered, steps + 1].min() > EGO_GAP_M
    assert (is_present[:, :-1] & ~is_present[:, 1:]).any()
    for step in (0, steps[0], steps[0] + 1, 150):
        others = np.delete(is_present[:, step], record.agent).sum()
        shown = observations[step]["neighbors_mask"]
        assert shown.sum() == min(others, len(shown))
    for observation in observations:
        nearby = observation["neighbors_mask"].astype(bool)
        past = observation["neighbors_history"].reshape(len(nearby), -1, 4)
        history = np.concatenate([past, observation["neighbors"][:, None, :4]], 1)[nearby]
        is_seen = (history != 0).any(-1)
        moved = np.linalg.norm(np.diff(history[..., :2], axis=1), axis=-1)
        assert moved[is_seen[:, 1:] & is_seen[:, :-1]].max(initial=0.0) < 4.0


def test_open_worlds_are_forked_and_stored_bit_for_bit(open_env, policy, crossing):
    env, observations = open_env
    same, other = env.fork(1)[0], env.fork(1, noise="new")[0]
    restored = EgoEnv(scenarios=[crossing], policy=policy, max_steps=600, stop_on=(), entries="fixed-rate")
    seen, _ = restored.restore(env.snapshot())
    for name, values in observations[-1].items():
        np.testing.assert_array_equal(seen[name], values)
    for branch in (same, other, restored):
        for _ in range(60):
            branch.step(np.array([-1.0, 0.0], np.float32))
    presence = [np.stack(branch.state.world.has_left) for branch in (same, restored, other)]
    np.testing.assert_array_equal(presence[0], presence[1])
    np.testing.assert_array_equal(same.state.world.motion, restored.state.world.motion)
    assert not np.array_equal(presence[0], presence[2])
    closed = EgoEnv(scenarios=[crossing], policy=policy, max_steps=600, stop_on=())
    with pytest.raises(ConfigError, match="another entries"):
        closed.restore(env.snapshot())


def test_the_checkers_find_nothing_to_complain_about_where_agents_enter(policy, crossing):
    settings = {"scenarios": [crossing], "policy": policy, "max_steps": 600, "entries": "fixed-rate"}
    check_env(EgoEnv(**settings), skip_render_check=True)
    parallel_api_test(parallel_env(controlled=[int(crossing.tracks.object_id[crossing.ego_index])], **settings), 100)


def test_entries_need_traffic_that_follows_a_policy(policy):
    road = straight_road()
    for settings in ({"traffic": "idm"}, {"drivers": {"pedestrians": "replay"}}):
        with pytest.raises(ConfigError, match="needs traffic that follows the policy"):
            EgoEnv(scenarios=[road], policy=policy, entries="none", **settings)
    with pytest.raises(ConfigError, match="named one by one"):
        parallel_env(scenarios=[road], policy=policy, controlled="vehicles", entries="none")
    with pytest.raises(ConfigError, match="take a SMART model"):
        EgoEnv(scenarios=[road], model="constant_velocity", entries="none")
    with pytest.raises(ConfigError, match="entries=none has no effect: add policy"):
        DriveConfig("idm", traffic=("replay",), entries="none")


def test_drives_with_and_without_entries_are_not_taken_for_each_other(tmp_path, capsys):
    command = ["drive", "idm", "--data", "synthetic", "--limit", "1", "--seconds", "2", "--out", str(tmp_path)]
    assert main([*command, "--entries", "none", "--film", "first"]) == 0
    printed = capsys.readouterr().out.replace("\n", "")
    assert "idm in policy: no others_realism, agents leave and enter" in printed
    assert len([*tmp_path.glob("*.webp")]) == 1  # beside replayed traffic, where nobody enters
    closed = DriveResult.read(tmp_path / "idm-replay.parquet").settings
    assert (closed.entries, DriveResult.read(tmp_path / "idm-policy.parquet").settings.entries) == (None, "none")
    assert main(command) == 2
    assert "another entries" in capsys.readouterr().err


def test_a_token_may_end_after_the_last_step(policy):
    env = EgoEnv(
        scenarios=[junction_with_light()], policy=policy, traffic="replay", action="token", max_steps=92, stop_on=()
    )
    _, infos = drive_all(env, 0)
    assert infos[-1]["step"] == 95


def test_refused_lengths():
    with pytest.raises(ConfigError, match=r"seconds must be at most 600, got 600\.1"):
        DriveConfig("idm", seconds=600.1)
    for steps in (0, 6_001):
        with pytest.raises(ConfigError, match="max_steps must lie between 1 and 6000"):
            EgoEnv(scenarios=[straight_road()], traffic="replay", max_steps=steps)


def test_drive_takes_seconds_and_films(tmp_path, capsys):
    options = ["--data", "synthetic", "--limit", "1", "--traffic", "replay,constant_velocity", "--out", str(tmp_path)]
    assert main(["drive", "idm", *options, "--seconds", "20", "--film", "first"]) == 0
    printed = capsys.readouterr().out.replace("\n", "")
    for traffic in ("replay", "constant_velocity"):
        assert f"idm in {traffic}: no others_realism, the metric compares 8 s: " in printed
        assert f"idm in {traffic}: no progress, the log ends after 8.0 s: " in printed
    assert "idm in replay: no scores beyond 16.0 s, the map ends there: " in printed
    (film,) = tmp_path.glob("*.webp")
    with Image.open(film) as pictures:  # as long as the longest episode
        assert 1 + 160 // 2 <= pictures.n_frames <= 1 + 200 // 2
    long = DriveResult.read(tmp_path / "idm-replay.parquet")
    assert long.settings.seconds == 20.0
    assert np.isfinite(long.values("nuplan_style")).all()
    assert main(["drive", "idm", *options]) == 2
    assert "another seconds" in capsys.readouterr().err
    other = DriveResult(replace(long.settings, seconds=8.0), long.table, long.missing)
    with pytest.raises(DataError, match=r"with seconds 20\.0, .* with 8\.0"):
        compare_drives(long, other)
