"""SUMO as the traffic: left alone it is the log in every bit, its drivers react to the ego, states are values."""

import hashlib
import importlib.util
import json
import os
import signal
import subprocess
import sys
import warnings
import zipfile
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import parallel_api_test

from rlftsim.envs import EgoEnv, EgoVectorEnv, parallel_env, sumo_traffic
from rlftsim.envs.drive import drive
from rlftsim.envs.drive_scenario import DriveConfig
from rlftsim.envs.scene import build_env_scene
from rlftsim.envs.sumo_traffic import SumoWorld, advance_sumo, begin_sumo, build_sumo_scene
from rlftsim.errors import ConfigError, DataError, RlftsimError
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.synthetic import sumo
from rlftsim.scenario.synthetic.generate import generate
from rlftsim.scenario.synthetic.worlds import DOCUMENT, FORMAT, NETWORK, ROUTES, WORLDS, find_window

pytestmark = pytest.mark.skipif(
    not sumo.is_available() or importlib.util.find_spec("libsumo") is None,
    reason="the extra `synthetic` is not installed",
)

SETTINGS = {"traffic": "sumo", "split": None, "stop_on": (), "reward": "none"}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Three windows of a city that can be run again."""
    folder = tmp_path_factory.mktemp("worlds") / "data"
    generate(folder, num_scenarios=3, seed=77, splits={"validation": 1.0}, keep_worlds=True, show_progress=False)
    return folder


@pytest.fixture(autouse=True)
def no_process_is_left():
    yield
    while sumo_traffic._WORLDS:
        sumo_traffic._WORLDS.popitem()[1].close()


def others(env):
    """Motion of all agents but the ego at all steps."""
    return np.delete(np.stack([motion[0] for motion in env.state.world.track]), env.episode.world.scenes[0].ego, axis=1)


def drive_steps(env, count, action=(0.3, 0.0)):
    for _ in range(count):
        env.step(np.array(action, np.float32))


# --- a world that is run again ---------------------------------------------------------------------------------------


def test_sumo_left_alone_is_the_log_in_every_bit(data):
    for scenario in ScenarioDataset(data):
        scene = build_env_scene(scenario, 91)
        sumo_scene = build_sumo_scene(scene, data)
        state, motion, rows = begin_sumo(sumo_scene, scene), scene.logged[:, 10], list(sumo_scene.rows)
        moved = 0.0
        for step in range(11, 91):
            state, motion = advance_sumo(sumo_scene, state, motion, scene, None)
            is_valid = scene.valid[rows, step]
            np.testing.assert_array_equal(motion[rows][is_valid], scene.logged[rows, step][is_valid])
            np.testing.assert_array_equal(state.lights.state[step], scene.lights.state[step])
            np.testing.assert_array_equal(state.lights.age_s[step], scene.lights.age_s[step])
            assert not state.has_left[rows][is_valid].any()
            moved = max(moved, float(np.linalg.norm(motion[:, :2] - scene.logged[:, 10, :2], axis=1).max()))
        assert moved > 10.0  # something was driven at all
        assert state.off_lane_steps == 0


def test_two_processes_and_a_copy_in_mid_episode_answer_alike(data):
    path = find_window(data, ScenarioDataset(data).scenario_ids[0]).path
    first, second = SumoWorld(path), SumoWorld(path)
    # an ego that is moved as by an earthquake
    poses = tuple((float(5 * step), float(3 * step), 90.0) for step in range(12))
    answers = [first.step(1, poses[: step + 1]) for step in range(12)]
    assert [second.step(1, poses[: step + 1]) for step in range(12)] == answers
    # the state after 6 steps is not the latest one: another copy of the process repeats the poses
    assert [first.step(1, poses[: step + 1]) for step in range(6, 12)] == answers[6:]
    assert first.step(0, (None,)) != first.step(1, (None,))
    for world in (first, second):
        world.close()


# --- drivers react, on small networks --------------------------------------------------------------------------------

TYPES = "".join(f'<vType id="{name.lower()}" length="4.5" carFollowModel="{name}"/>' for name in ("Krauss", "EIDM"))


def build_small_world(folder, nodes, edges, routes, num_steps):
    """A world of a hand-written network in which the ego is a track, too."""
    (folder / "n.nod.xml").write_text(f"<nodes>{nodes}</nodes>")
    (folder / "n.edg.xml").write_text(f"<edges>{edges}</edges>")
    options = ("-n", folder / "n.nod.xml", "-e", folder / "n.edg.xml", "-o", folder / "n.net.xml")
    netconvert = [sumo.find_binary("netconvert"), *options, "--offset.disable-normalization"]
    subprocess.run(netconvert, check=True, capture_output=True)
    tracks = [{"sumo_id": name} for name in ("ego", "other")]
    document = {
        "format": FORMAT, "seed": 1, "options": sumo.OPTIONS,
        "windows": [{"ego": "ego", "num_steps": num_steps, "tracks": tracks, "lights": []}],
    }  # fmt: skip
    with zipfile.ZipFile(folder / "small.world", "w") as archive:
        archive.writestr(DOCUMENT, json.dumps(document))
        archive.writestr(NETWORK, (folder / "n.net.xml").read_text())
        archive.writestr(ROUTES, f"<routes>{TYPES}{routes}</routes>")
    return SumoWorld(folder / "small.world")


def run(world, poses):
    """Poses of ego and other after each of the poses [T, 2, 3]; all have to stay in the network."""
    return np.array([world.step(0, tuple(poses[: step + 1]))["poses"] for step in range(len(poses))])


def build_road(folder, driver, num_lanes):
    """A straight road along +x, on which a vehicle follows the ego at 15 m/s."""
    nodes = '<node id="a" x="0" y="0"/><node id="b" x="1500" y="0"/>'
    edges = f'<edge id="e" from="a" to="b" numLanes="{num_lanes}" speed="20" spreadType="center"/>'
    routes = "".join(
        f'<vehicle id="{name}" type="{driver}" depart="0" departPos="{position}" departSpeed="15" departLane="0">'
        '<route edges="e"/></vehicle>'
        for name, position in (("ego", 100), ("other", 60))
    )
    return build_small_world(folder, nodes, edges, routes, 20)


def braking(start, steps, left_m=0.0):
    """Poses of an ego on the road along +x that brakes with 3 m/s² from 15 m/s, and slides to the left in 3 s."""
    time = np.arange(1, steps + 1) * 0.1
    until = np.minimum(time, 5.0)
    x = start[0] + 15 * until - 1.5 * until**2
    y = start[1] + left_m * np.minimum(time / 3.0, 1.0)
    return [(float(a), float(b), 90.0) for a, b in zip(x, y)]


@pytest.mark.parametrize("driver", ["krauss", "eidm"])
def test_a_follower_stops_behind_an_ego_that_brakes(tmp_path, driver):
    world = build_road(tmp_path, driver, num_lanes=1)
    start = run(world, [None])[0, 0]
    driven = run(world, braking(start, 160))
    gap = driven[-1, 0, 0] - 4.5 - driven[-1, 1, 0]
    assert 1.5 < gap < 4.5
    assert driven[-1, 1, 0] - driven[-11, 1, 0] < 0.5  # it stands
    alone = run(world, [None] * 160)
    assert alone[-1, 1, 0] - driven[-1, 1, 0] > 100
    world.close()


@pytest.mark.parametrize("driver", ["krauss", "eidm"])
def test_a_follower_drives_on_when_the_ego_has_changed_lanes(tmp_path, driver):
    world = build_road(tmp_path, driver, num_lanes=2)
    start = run(world, [None])[0, 0]
    driven = run(world, braking(start, 160, left_m=3.2))
    assert driven[-1, 0, 1] == pytest.approx(start[1] + 3.2, abs=0.01)
    assert driven[-1, 1, 0] > driven[-1, 0, 0] + 20  # past the ego, which stands on the next lane
    world.close()


JUNCTION = (
    '<node id="w" x="-400" y="0"/><node id="c" x="0" y="0" type="priority"/><node id="e" x="400" y="0"/>'
    '<node id="s" x="0" y="-400"/><node id="n" x="0" y="400"/>',
    '<edge id="wc" from="w" to="c" priority="9" speed="20"/><edge id="ce" from="c" to="e" priority="9" speed="20"/>'
    '<edge id="sc" from="s" to="c" priority="1" speed="14"/><edge id="cn" from="c" to="n" priority="1" speed="14"/>',
)


def cross(name, edges, position, speed):
    return (
        f'<vehicle id="{name}" type="krauss" depart="0" departPos="{position}" departSpeed="{speed}">'
        f'<route edges="{edges}"/></vehicle>'
    )


def test_a_minor_road_yields_to_the_moved_ego_as_to_a_driver_of_sumo(tmp_path):
    routes = cross("ego", "wc ce", 250, 14) + cross("other", "sc cn", 300, 10)
    world = build_small_world(tmp_path, *JUNCTION, routes, 10)
    alone = run(world, [None] * 120)
    moved = run(world, [tuple(pose) for pose in alone[:, 0].tolist()])
    np.testing.assert_allclose(moved[:, 1], alone[:, 1], atol=0.01)
    # without an ego in the way it would have driven: the ego leaves at once to the north
    away = run(world, [(0.0, 300.0, 0.0)] * 120)
    assert away[90, 1, 1] > moved[90, 1, 1] + 5
    world.close()


def test_the_major_road_brakes_for_an_ego_that_runs_out_of_the_minor_road(tmp_path):
    routes = cross("ego", "sc cn", 340, 10) + cross("other", "wc ce", 250, 18)
    world = build_small_world(tmp_path, *JUNCTION, routes, 10)
    start = run(world, [None])[0, 0]
    # onto the crossing within 4 s, and there at a walk
    north = np.minimum(start[1] + 1.2 * np.arange(1, 71), -4.0) + 0.1 * np.arange(1, 71)
    driven = run(world, [(float(start[0]), float(y), 0.0) for y in north])
    speed = np.diff(driven[:, 1, 0]) / 0.1
    alone = np.diff(run(world, [None] * 70)[:, 1, 0]) / 0.1
    assert alone.min() > 16
    assert speed.min() < 13
    world.close()


# --- environments ----------------------------------------------------------------------------------------------------


def test_gymnasium_and_pettingzoo_find_nothing_to_complain_about(data):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        settings = SETTINGS | {"data": str(data), "max_steps": 5}
        check_env(gymnasium.make("rlftsim.envs:rlftsim/Ego-v0", **settings).unwrapped, skip_render_check=True)
    assert [str(w.message) for w in caught if issubclass(w.category, UserWarning)] == []
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        scenario = ScenarioDataset(data)[0]
        parallel_api_test(parallel_env(scenarios=[scenario], **settings), num_cycles=12)


def test_the_same_actions_give_the_same_bits_alone_in_a_vector_after_a_fork_and_from_a_snapshot(data):
    env = EgoEnv(data=str(data), **SETTINGS)
    env.reset(seed=1)
    drive_steps(env, 8)
    branch, braking_branch = env.fork(2)
    saved = env.snapshot()
    restored = EgoEnv(data=str(data), **SETTINGS)
    restored.restore(saved)
    for each in (env, branch, restored):
        drive_steps(each, 25)
    drive_steps(braking_branch, 25, (-1.0, 0.0))
    np.testing.assert_array_equal(others(branch), others(env))
    np.testing.assert_array_equal(others(restored), others(env))
    assert braking_branch.state.world.motion.tobytes() != env.state.world.motion.tobytes()
    vector = EgoVectorEnv(2, data=str(data), **SETTINGS)
    vector.reset(seed=0)  # slot 1 has seed 1
    for _ in range(33):
        seen, *_ = vector.step(np.tile(np.array([0.3, 0.0], np.float32), (2, 1)))
    last = env.step(np.array([0.3, 0.0], np.float32))[0]
    seen, *_ = vector.step(np.tile(np.array([0.3, 0.0], np.float32), (2, 1)))
    for name, values in last.items():
        np.testing.assert_array_equal(seen[name][1], values)


def test_another_process_drives_the_same_episode(data):
    script = (
        "import sys, hashlib, numpy as np\n"
        "from rlftsim.envs import EgoEnv\n"
        f"env = EgoEnv(data={str(data)!r}, traffic='sumo', split=None, stop_on=(), reward='none')\n"
        "env.reset(seed=2)\n"
        "for _ in range(20): env.step(np.array([-0.4, 0.1], np.float32))\n"
        "print(hashlib.sha256(np.stack(env.state.world.track).tobytes()).hexdigest())\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    env = EgoEnv(data=str(data), **SETTINGS)
    env.reset(seed=2)
    drive_steps(env, 20, (-0.4, 0.1))
    assert done.stdout.strip() == hashlib.sha256(np.stack(env.state.world.track).tobytes()).hexdigest()


def test_a_planner_is_scored_in_sumo_and_drives_again_to_the_same_scores(data, tmp_path):
    config = DriveConfig("idm", data=str(data), split="validation", traffic=("sumo", "replay"), limit=1)
    first, second = drive(config, tmp_path), drive(replace(config, traffic=("sumo",)))
    for name in first[0].table.column_names[2:]:
        np.testing.assert_array_equal(first[0].table[name], second[0].table[name])
    assert [result.settings.traffic for result in first] == ["sumo", "replay"]
    assert 0.0 <= first[0].table["nuplan_style"][0].as_py() <= 1.0


# --- mistakes --------------------------------------------------------------------------------------------------------


def test_a_process_that_was_killed_is_started_again_once(data):
    env, calm = EgoEnv(data=str(data), **SETTINGS), EgoEnv(data=str(data), **SETTINGS)
    for each in (env, calm):
        each.reset(seed=0, options={"scenario": each.source.scenario_ids[0]})
    drive_steps(calm, 12)
    drive_steps(env, 5)
    world = next(iter(sumo_traffic._WORLDS.values()))
    os.kill(world.process.pid, signal.SIGKILL)
    for channel in world.channels.values():  # its copies as well
        channel.close()
    drive_steps(env, 7)
    np.testing.assert_array_equal(others(env), others(calm))


def test_a_world_that_sumo_cannot_read_is_named_with_the_reason(data, tmp_path):
    source = find_window(data, ScenarioDataset(data).scenario_ids[0]).path
    with zipfile.ZipFile(source) as archive, zipfile.ZipFile(tmp_path / "cut.world", "w") as cut:
        cut.writestr(DOCUMENT, archive.read(DOCUMENT))
        cut.writestr(NETWORK, archive.read(NETWORK)[:5000])
        cut.writestr(ROUTES, archive.read(ROUTES))
    with pytest.raises(RlftsimError, match=r"SUMO has failed twice in .*cut.world \(.+\): free memory"):
        SumoWorld(tmp_path / "cut.world").step(0, (None,))


def test_data_without_worlds_and_other_versions_are_named(data, monkeypatch):
    with pytest.raises(DataError, match=r"has no world that SUMO can run again: .* --keep-worlds"):
        EgoEnv(traffic="sumo").reset(seed=0)
    monkeypatch.setattr(sumo_traffic.metadata, "version", lambda name: "1.99.0")
    with pytest.raises(ConfigError, match=r"made by SUMO .*, this is 1.99.0.*pip install libsumo=="):
        EgoEnv(data=str(data), **SETTINGS).reset(seed=0)


def test_a_missing_extra_and_a_system_without_forks_are_named(data, monkeypatch):
    with monkeypatch.context() as patch:
        patch.delattr(os, "fork")
        with pytest.raises(ConfigError, match="Linux or macOS"):
            EgoEnv(data=str(data), **SETTINGS)
    monkeypatch.setattr(sumo_traffic.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r'pip install "rlftsim\[synthetic\]"'):
        EgoEnv(data=str(data), **SETTINGS)


@pytest.mark.parametrize(
    "drivers", [{"vehicles": "replay"}, {"tracks_to_predict": "planner"}, {"pedestrians": "sumo", "*": "idm"}]
)
def test_sumo_drives_all_but_the_ego_or_nobody(data, drivers):
    env = EgoEnv(data=str(data), drivers=drivers, **SETTINGS)
    with pytest.raises(ConfigError, match="SUMO drives all agents but the ego"):
        env.reset(seed=0)


def test_a_damaged_world_is_named(data, tmp_path):
    (tmp_path / WORLDS).mkdir()
    (tmp_path / WORLDS / "broken.world").write_bytes(b"PK no archive")
    with pytest.raises(DataError, match=r"broken.world: no archive of a world .*--keep-worlds"):
        find_window(tmp_path, "a")
