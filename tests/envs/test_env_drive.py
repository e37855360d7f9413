"""Planners that ship, planners of others, `rlftsim drive` and `rlftsim compare` on its files."""

import importlib
import json
import re
import shutil
import sys
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from full_disk import limit_files_to
from rlftsim.cli import main
from rlftsim.envs import EgoEnv
from rlftsim.envs import drive as drive_module
from rlftsim.envs.drive import drive
from rlftsim.envs.drive_films import choose_films, write_film
from rlftsim.envs.drive_scenario import DriveConfig
from rlftsim.envs.idm import IdmConfig, compute_idm_acceleration
from rlftsim.envs.planner_episode import run_planner
from rlftsim.envs.planner_scores import off_road
from rlftsim.envs.planners import pdm
from rlftsim.envs.planners.registry import PLANNERS, hash_code, load_planner, read_action_settings
from rlftsim.envs.planners.view import View
from rlftsim.envs.route import compute_headings
from rlftsim.errors import ConfigError, DataError
from rlftsim.evaluation import resumable
from rlftsim.evaluation.drive_results import (
    DriveResult,
    compare_drives,
    find_failures,
    format_drive_comparison,
    rank_scenarios,
)
from rlftsim.realism.map_based import OUTSIDE_M
from rlftsim.scenario.dataset import write_dataset
from rlftsim.scenario.open import open_dataset
from rlftsim.scenario.shards import hash_file
from rlftsim.scenario.womd import find_tfrecords, read_scenarios
from scenes import (
    NO_LIGHTS,
    Mover,
    bend,
    build_scenario,
    junction_map,
    light,
    straight_road,
    without_ego,
    without_future,
)


def driven(name, scenario, **settings):
    planner = load_planner(name)
    env = EgoEnv(
        scenarios=[scenario],
        action=read_action_settings(planner)["action"],
        stop_on=(),
        **{"traffic": "replay", **settings},
    )
    (((result,), _),) = run_planner(env.source, planner, [scenario], seed=0, rollouts=[0])
    return result


@pytest.mark.parametrize("name", ["idm", "pdm"])
def test_planners_keep_their_distance_to_a_slow_car(name):
    slow = build_scenario("slow", (Mover(speed_mps=9.3), Mover(x_m=30.0, speed_mps=3.0)))
    result = driven(name, slow)
    assert result.record.collisions == ()
    gap = result.record.motion[1, -1, 0] - result.record.agent_motion[-1, 0] - 4.6
    assert 1.0 < gap < 12.0
    assert result.planner.drivable_area == 1.0
    assert driven("constant_velocity", slow).planner.at_fault_collision_rate == 1.0


def test_constant_velocity_keeps_backing_up(tmp_path):
    write_dataset([build_scenario("backing", (Mover(speed_mps=-2.0),))], tmp_path, split="validation")
    (result,) = drive(DriveConfig("constant_velocity", data=str(tmp_path), traffic=("replay",)))
    assert result.table["displacement_error"][0].as_py() < 0.01


@pytest.mark.parametrize("name", ["idm", "pdm"])
def test_planners_stop_at_a_red_light_and_go_at_green(name):
    stays = build_scenario("red", (Mover(speed_mps=8.0),), junction_map(), light(1, 38.0, 0.2, red_until=91))
    result = driven(name, stays)
    assert result.planner.red_light_rate == 0.0
    assert 30.0 < result.record.agent_motion[-1, 0] + 2.3 < 38.5
    assert np.hypot(*result.record.agent_motion[-1, 3:]) < 0.5
    goes = build_scenario("green", (Mover(speed_mps=8.0),), junction_map(), light(1, 38.0, 0.2, red_until=11))
    assert driven(name, goes).record.agent_motion[-1, 0] > 45.0


def test_planners_follow_a_bending_lane():
    for name in ("idm", "pdm"):
        result = driven(name, replace(bend(num_agents=1), lights=NO_LIGHTS))
        assert result.planner.drivable_area == 1.0
        assert result.planner.progress > 0.9
        assert result.planner.displacement_error < 15.0


def test_boxes_that_no_proposal_comes_near_change_no_bit(monkeypatch):
    rng = np.random.default_rng(3)
    line = np.stack([np.arange(120.0), 8 * np.sin(np.arange(120.0) / 20)], -1)
    heading = np.unwrap(compute_headings(line))
    num_near = 0
    for speed in (0.0, 4.0, 12.0):
        boxes = rng.uniform([-20, -40, -4, -12, -12], [120, 40, 4, 12, 12], (40, 5))
        sizes = rng.uniform([0.6, 0.6], [12.0, 3.0], (40, 2))
        view = View(
            np.array([speed]), np.array([[4.6, 1.9]]), line[None], heading[None], np.array([13.0]), boxes[None],
            sizes[None], np.ones((1, 40), bool), np.array([np.inf]), np.zeros((1, 0, 4)),
        )  # fmt: skip
        is_near = pdm._nears_line(view)
        num_near += is_near.sum()
        proposals = pdm.simulate_proposals(view)
        with monkeypatch.context() as context:
            context.setattr(pdm, "_nears_line", lambda view: view.is_box)
            every_box = pdm.simulate_proposals(view)
        for some, of_every_box in zip(proposals, every_box, strict=True):  # motion and controls
            np.testing.assert_array_equal(some, of_every_box)
    assert 15 < num_near < 115  # some are left out, and some matter


def test_the_intelligent_driver_model_has_its_equilibrium():
    # at the wanted gap and equal speeds the acceleration is that of the free road less the whole
    config = IdmConfig()
    free = compute_idm_acceleration(np.array([10.0]), np.array([10.0]), np.array([np.inf]), np.zeros(1), config)
    assert free == pytest.approx(0.0)
    gap = config.gap_m + 5.0 * config.headway_s
    held = compute_idm_acceleration(np.array([5.0]), np.array([10.0]), np.array([gap]), np.array([5.0]), config)
    assert held == pytest.approx(-(0.5**4), abs=1e-9)  # 1 - (v/v0)^4 - 1


def test_the_road_is_left_where_the_official_distance_says_so():
    random, data = np.random.default_rng(2), open_dataset("synthetic", "validation")
    left = []
    for index in range(6):
        env = EgoEnv(scenarios=[data[index]], traffic="replay", stop_on=(), max_steps=60)
        env.reset(seed=0)
        action = random.uniform((0.2, -0.3), (1.0, 0.3)).astype(np.float32)
        events = [env.step(action)[4]["terms"]["offroad"] for _ in range(60)]
        outside = off_road(env.result().record) >= OUTSIDE_M
        assert env.state.outside[0] == outside.any()
        if outside.any() and not outside[0]:
            assert int(np.argmax(events)) + 1 == int(outside.argmax())
        left.append(bool(outside.any()))
    assert any(left)
    assert not all(left)


def test_the_replay_planner_needs_a_future():
    with pytest.raises(DataError, match="no logged future"):
        driven("replay", without_future())


@pytest.mark.official
def test_replay_in_is_the_log_out_on_real_scenarios(shared):
    scenarios = [one for path in find_tfrecords(shared / "data" / "womd") for one in read_scenarios(path)]
    assert len(scenarios) == 7
    for scenario in scenarios:
        planner = load_planner("replay")
        env = EgoEnv(scenarios=[scenario], traffic="replay", action="pose", stop_on=(), reward="none")
        (((result,), state),) = run_planner(env.source, planner, [scenario], seed=0, rollouts=[0])
        world, track = env.source.episode([scenario]).world, np.stack(state.world.track, 2)  # [1, A, 91, 5]
        away = np.abs(track[..., :2] - world.logged[..., :2])[world.valid]
        assert away.max() < 1e-4
        assert result.planner.at_fault_collision_rate == 0.0
        assert result.planner.progress == pytest.approx(1.0, abs=1e-3)


PLANNER_FILE = """
import numpy as np
class Still:
    action = "pose"
    def reset(self, info):
        self.scenario = info["scenario"]
    def act(self, observation):
        return np.zeros(3, np.float32)
def straight(observation):
    return np.zeros(2, np.float32)
number = 3
class Far:
    action, horizon = "trajectory", 20
    def reset(self, info):
        pass
    def act(self, observation):
        return np.outer(np.arange(1, 21), [0.5, 0, 0])
class Calls:
    def __call__(self, observation):
        return np.zeros(2, np.float32)
instance = Calls()
class Needy:
    def __init__(self, wish):
        pass
class Deaf(Calls):
    def reset(self, info): pass
    def act(self): pass
class Resets(Calls):
    def reset(self): pass
    def act(self, observation): pass
class Steers(Still):
    action = "steering"
def blind(): pass
"""


def test_planners_of_others_are_found(tmp_path, monkeypatch):
    (tmp_path / "my_planners.py").write_text(PLANNER_FILE)
    monkeypatch.syspath_prepend(tmp_path)
    assert read_action_settings(load_planner("my_planners:Still"))["action"] == "pose"
    assert driven("my_planners:Still", straight_road()).planner.route_completion == pytest.approx(0.0, abs=1e-6)
    assert read_action_settings(load_planner("my_planners:straight"))["action"] == "bicycle"
    code = hash_file(tmp_path / "my_planners.py")
    assert {hash_code(f"my_planners:{name}") for name in ("Still", "straight", "instance", "Calls")} == {code}
    PLANNERS.add("mine", sys.modules["my_planners"].Still)
    assert read_action_settings(load_planner("mine"))["action"] == "pose"
    PLANNERS.remove("mine")
    (far,) = drive(DriveConfig("my_planners:Far", traffic=("replay",), limit=1))
    assert far.values("route_completion")[0] > 0
    wrong = {"my_planners:number": "is of type int", "my_planners:nothing": "cannot be imported", "idn": "mean 'idm'"}
    wrong |= {":Still": "names no module", "nowhere.at_all:Still": "cannot be imported"}
    (tmp_path / "broken.py").write_text("def (")
    wrong |= {"my_planners:Needy": "without arguments .*wish", "broken:Still": "cannot be imported"}
    wrong |= {"my_planners:Deaf": "act of planner .* observation alone", "my_planners:Resets": "reset of .* info alone"}
    wrong |= {"my_planners:Steers": "planner Steers has action = 'steering': known are bicycle"}
    wrong |= {"my_planners:blind": "planner .* cannot be called with observation alone"}
    for name, message in wrong.items():
        with pytest.raises(ConfigError, match=message):
            load_planner(name)


def test_drive_writes_a_row_per_scenario_and_compare_reads_them(tmp_path, capsys):
    out = tmp_path / "drive"
    words = ["drive", "constant_velocity", "--data", "synthetic", "--out", str(out), "--limit", "2"]
    assert main([*words, "--traffic", "replay, constant_velocity", "--film", "first"]) == 0
    first, second = out / "constant_velocity-replay.parquet", out / "constant_velocity-constant_velocity.parquet"
    table = pq.read_table(first)
    assert table.num_rows == 2
    assert set(table["traffic"].to_pylist()) == {"replay"}
    assert {"nuplan_style", "pdms_style", "others_realism", "hit_rate"} <= set(table.schema.names)
    assert len(list(out.glob("*.webp"))) == 1
    capsys.readouterr()
    assert main(["compare", str(first), str(second)]) == 0
    text = capsys.readouterr().out
    assert "nuplan_style" in text
    assert "2 scenarios in both" in " ".join(text.split())
    assert main(["drive", "walk", "--data", "synthetic", "--out", str(out)]) == 2
    assert main([*words, "--traffic", "none"]) == 2
    assert main([*words, "--scenario", "x", "--traffic", "replay"]) == 2
    (tmp_path / "file").touch()
    assert main([*words, "--seed", "-1"]) == 2
    assert main([*words, "--traffic", "replay,replay"]) == 2
    assert main(["drive", "idm", "--data", "synthetic", "--traffic", "replay", "--out", str(tmp_path / "file")]) == 2
    assert main([*words, "--traffic", "replay", "--scenario", "x", "x"]) == 2
    errors = capsys.readouterr().err.strip().splitlines()
    assert len(errors) == 7  # no progress bar: nothing was driven
    assert "unknown planner 'walk'" in errors[0]
    assert errors[0].endswith("or MODULE:CLASS, sb3:FILE.zip.")
    assert "is a file, not a folder" in errors[5]
    assert "names one twice: x, x" in errors[6]


def test_a_smaller_drive_never_replaces_a_larger_result(tmp_path):
    config = DriveConfig("constant_velocity", traffic=("replay", "constant_velocity"), limit=2)
    (larger,) = drive(replace(config, traffic=("replay",), limit=3), tmp_path)
    before = (tmp_path / "constant_velocity-replay.parquet").read_bytes()
    ids = open_dataset("synthetic", "validation").scenario_ids
    chosen, others = (replace(config, limit=None, scenarios=tuple(some)) for some in (ids[:1], ids[2:5]))
    cases = (
        (config, "limit=2", 1), (replace(config, seed=1), "limit=2", 1), (chosen, "this choice", 2),
        (others, "this choice", 2),  # as many, but not the same
    )  # fmt: skip
    assert larger.table["scenario_id"].to_pylist() == ids[:3]
    for other, choice, count in cases:
        message = f"replay.parquet holds 3 scenarios, and {choice} would replace them without {count} of these"
        with pytest.raises(ConfigError, match=message):
            drive(other, tmp_path)
    assert (tmp_path / "constant_velocity-replay.parquet").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["constant_velocity-replay.parquet"]  # nothing was driven


FAILING_PLANNER = """
from pathlib import Path
import numpy as np
LOG = Path(__file__).with_name("driven")
class Fails:
    def reset(self, info):
        with LOG.open("a") as file:
            file.write(info["scenario"] + "\\n")
        if LOG.with_name("fail").exists() and len(LOG.read_text().split()) == 4:
            raise KeyboardInterrupt("no more")
    def act(self, observation):
        return np.zeros(2, np.float32)
"""


def test_an_interrupted_drive_goes_on_and_a_changed_planner_starts_anew(tmp_path, monkeypatch, caplog):
    (tmp_path / "fails.py").write_text(FAILING_PLANNER)
    monkeypatch.syspath_prepend(tmp_path)
    ids = tuple(open_dataset("synthetic", "validation").scenario_ids[:2])
    config = DriveConfig("fails:Fails", traffic=("replay", "constant_velocity"), scenarios=ids)
    expected = drive(config, tmp_path / "whole")

    def driven_by(config):
        (tmp_path / "driven").unlink(missing_ok=True)
        results = drive(config, tmp_path / "out")
        for result, other in zip(results, expected):
            np.testing.assert_equal(result.table.to_pydict(), other.table.to_pydict())
            assert result.table.schema.equals(other.table.schema)
        return (tmp_path / "driven").read_text().split() if (tmp_path / "driven").exists() else []

    # 1. the second scenario of the second kind of traffic fails
    (tmp_path / "fail").touch()
    with pytest.raises(KeyboardInterrupt, match="no more"):
        driven_by(config)
    (tmp_path / "fail").unlink()
    assert driven_by(config) == list(ids[1:])
    # 2. all is there
    assert driven_by(config) == []
    assert "fails.Fails-replay.parquet is finished and is read: remove it to drive anew" in caplog.text
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "fails.Fails-replay.parquet", "fails.Fails-constant_velocity.parquet"
    }  # fmt: skip
    # 3. another planner under the same name, once it is the one that drives, and a file that is not ours to replace
    (tmp_path / "fails.py").write_text(FAILING_PLANNER + "# changed\n")
    assert driven_by(config) == []
    del sys.modules["fails"]
    assert driven_by(config) == [*ids, *ids]
    assert "is of another planner_code: it will be replaced" in caplog.text
    damaged = tmp_path / "out" / "fails.Fails-replay.parquet"
    damaged.write_bytes(damaged.read_bytes()[:100])
    with pytest.raises(DataError, match=r"replay\.parquet is in the way \(cannot be read .*\): choose another --out"):
        driven_by(config)
    damaged.unlink()
    assert driven_by(config) == list(ids)


def test_a_quick_look_keeps_what_a_longer_drive_has_done(tmp_path, monkeypatch):
    (tmp_path / "fails.py").write_text(FAILING_PLANNER)
    monkeypatch.syspath_prepend(tmp_path)
    sys.modules.pop("fails", None)
    config = DriveConfig("fails:Fails", traffic=("replay",), limit=4)
    (tmp_path / "fail").touch()
    with pytest.raises(KeyboardInterrupt, match="no more"):
        drive(config, tmp_path / "out")
    (tmp_path / "fail").unlink()
    (tmp_path / "driven").unlink()
    drive(replace(config, limit=1), tmp_path / "out")
    drive(config, tmp_path / "out")
    # three were done before, one of which the quick look shows
    ids = open_dataset("synthetic", "validation").scenario_ids
    assert (tmp_path / "driven").read_text().split() == [ids[3]]
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["fails.Fails-replay.parquet"]


def test_a_result_that_another_drive_finished_meanwhile_is_not_replaced_by_fewer(tmp_path, monkeypatch):
    config = DriveConfig("constant_velocity", traffic=("replay",), limit=1)
    drive(replace(config, limit=2), tmp_path / "other")

    class Late(resumable.Lease):
        """The other drive ends just before this one's turn."""

        def __enter__(self):
            shutil.copy(tmp_path / "other" / "constant_velocity-replay.parquet", tmp_path)
            return super().__enter__()

    monkeypatch.setattr(resumable, "Lease", Late)
    with pytest.raises(ConfigError, match=r"replay\.parquet holds 2 scenarios, and limit=1 would replace them"):
        drive(config, tmp_path)
    assert len(DriveResult.read(tmp_path / "constant_velocity-replay.parquet").scenario_ids) == 2


def test_unfinished_parts_of_other_settings_outlive_a_repeated_drive(tmp_path, monkeypatch):
    config = DriveConfig("constant_velocity", traffic=("replay",), limit=2)
    original, calls = drive_module.drive_scenarios, []

    def second_fails(*arguments):
        calls.append(arguments)
        return original(*arguments) if len(calls) == 1 else 1 / 0

    with monkeypatch.context() as patch:
        patch.setattr(drive_module, "drive_scenarios", second_fails)
        with pytest.raises(ZeroDivisionError):
            drive(replace(config, seed=1), tmp_path)
    parts = [*(tmp_path / "constant_velocity-replay.parts").glob("*.json")]
    assert len(parts) == 1
    others = replace(config, limit=None, scenarios=(open_dataset("synthetic", "validation").scenario_ids[1],))
    for _ in range(2):
        drive(others, tmp_path)
        assert parts[0].exists()


def test_a_drive_with_other_dice_is_not_replaced(tmp_path):
    config = DriveConfig("constant_velocity", traffic=("replay",), limit=1)
    drive(config, tmp_path)
    before = (tmp_path / "constant_velocity-replay.parquet").read_bytes()
    with pytest.raises(
        ConfigError, match=r"replay\.parquet is the result of another seed \(0, not 1\): choose another --out"
    ):
        drive(replace(config, seed=1), tmp_path)
    assert (tmp_path / "constant_velocity-replay.parquet").read_bytes() == before


def test_a_planner_object_is_known_by_the_module_that_makes_it_too(tmp_path, monkeypatch):
    (tmp_path / "library.py").write_text(
        "class Cruise:\n    def __init__(self, a): self.a = a\n    def __call__(self, o): return [self.a, 0.0]\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    seen = set()
    for number in ("0.0", "-5.0"):
        (tmp_path / "own.py").write_text(
            f"import functools\nfrom library import Cruise\nfast = Cruise({number})\n"
            f"part = functools.partial(lambda a, o: [a, 0.0], {number})\n"
        )
        sys.modules.pop("own", None)
        importlib.invalidate_caches()
        for name in ("own:fast", "own:part"):
            assert hash_code(name) == hash_code(name)
            seen.add(hash_code(name))
    assert len(seen) == 4
    del sys.modules["own"], sys.modules["library"]


def test_a_data_set_may_move_between_drives(tmp_path, monkeypatch, caplog):
    write_dataset([straight_road("one"), straight_road("two")], tmp_path / "data", split="validation")
    config = DriveConfig("constant_velocity", data=str(tmp_path / "data"), traffic=("replay",))
    first = drive(config, tmp_path / "out")
    (tmp_path / "data").rename(tmp_path / "moved")
    caplog.clear()
    moved = drive(replace(config, data=str(tmp_path / "moved")), tmp_path / "out")
    assert "is finished and is read" in caplog.text
    assert all(one.difference == 0 for one in compare_drives(first[0], moved[0]) if one.count)


QUITTING_PLANNER = """
import sys
from pathlib import Path
import numpy as np
class Quits:
    def reset(self, info):
        self.first = info["scenario"] == Path(__file__).with_name("first").read_text()
    def act(self, observation):
        return np.zeros(2, np.float32) if self.first else exit()
class Unmade:
    def __init__(self):
        sys.exit("no license")
"""


def test_a_planner_that_quits_fails_like_any_other(tmp_path, monkeypatch, capsys):
    (tmp_path / "quits.py").write_text(QUITTING_PLANNER)
    (tmp_path / "script.py").write_text("import sys\nsys.exit(3)\n")
    monkeypatch.syspath_prepend(tmp_path)
    ids = open_dataset("synthetic", "validation").scenario_ids[:2]
    (tmp_path / "first").write_text(ids[0])
    out = tmp_path / "out"
    words = ["--data", "synthetic", "--out", str(out), "--limit", "2", "--traffic", "replay"]
    messages = {
        "quits:Unmade": "planner 'quits:Unmade' calls exit('no license') when it is made: let it raise an error",
        "script:Any": "planner 'script:Any' cannot be imported (SystemExit: 3)",
    }
    for planner, message in messages.items():
        capsys.readouterr()
        assert main(["drive", planner, *words]) == 2
        assert capsys.readouterr().err.splitlines()[-1].startswith(f"rlftsim: {message}")
    assert main(["drive", "quits:Quits", *words]) == 1
    assert f"planner Quits fails at step 0 of scenario {ids[1]}: exit(None)" in capsys.readouterr().out
    assert [*DriveResult.read(out / "quits.Quits-replay.parquet").failures] == [ids[1]]


WEAK_PLANNER = """
import numpy as np
class Weak:
    def __init__(self, throttle=1.0, *, breaks_at=None):
        if throttle > 1:
            raise ValueError("throttle above 1")
        self.throttle, self.breaks_at = throttle, breaks_at
    def reset(self, info):
        self.step, self.breaks = 0, info["scenario"] == self.breaks_at
    def act(self, observation):
        self.step += 1
        if self.breaks and self.step == 4:
            raise IndexError("no lane")
        return np.array([self.throttle, 0.3], np.float32)
def steer(observation, turn=0.0):
    return np.array([0.0, turn], np.float32)
"""


def test_a_planner_that_fails_in_a_scenario_drives_the_others(tmp_path, monkeypatch, capsys):
    (tmp_path / "weak.py").write_text(WEAK_PLANNER)
    monkeypatch.syspath_prepend(tmp_path)
    ids = open_dataset("synthetic", "validation").scenario_ids[:3]
    planner = f"weak:Weak(throttle=1.0, breaks_at='{ids[1]}')"
    words = ["drive", planner, "--data", "synthetic", "--limit", "3", "--traffic", "replay"]
    assert main([*words, "--out", str(tmp_path / "out"), "--film", "worst:2"]) == 1
    text = capsys.readouterr().out
    assert f"planner Weak fails at step 3 of scenario {ids[1]}: IndexError: no lane (weak.py:13 in act)" in text
    assert "failed in 1 of 3 scenarios, which the means leave out" in text
    assert "leaves the road" in text
    (path,) = (tmp_path / "out").glob("*.parquet")
    result = DriveResult.read(path)
    assert np.isnan(result.values("nuplan_style")).tolist() == [False, True, False]
    assert {film.stem for film in (tmp_path / "out").glob("*.webp")} == {ids[0], ids[2]}
    # the same rows where it does not fail
    (whole,) = drive(DriveConfig("weak:Weak", traffic=("replay",), limit=3))
    assert whole.failures == {}
    np.testing.assert_equal(result.values("progress")[[0, 2]], whole.values("progress")[[0, 2]])
    title = str(format_drive_comparison(compare_drives(whole, result)).title)
    assert title.endswith("2 scenarios in both, without 1 in which a planner failed")


def test_an_ego_that_is_not_valid_now_costs_its_scenario_alone(tmp_path, capsys):
    refused = "scenario no-ego: its ego, track 100, is not valid at the current step (10) and cannot be driven: leave"
    with pytest.raises(DataError, match=re.escape(refused)):
        EgoEnv(scenarios=[without_ego()], traffic="replay", split=None).reset()
    write_dataset([straight_road("a"), without_ego(), straight_road("b")], tmp_path / "data", split="validation")
    words = ["constant_velocity", "--data", str(tmp_path / "data"), "--traffic", "replay"]
    assert main(["drive", *words, "--out", str(tmp_path / "drive")]) == 1
    text = capsys.readouterr().out
    assert refused in text
    assert "failed in 1 of 3 scenarios, which the means leave out" in text
    words += ["--particles", "2", "--budget", "16000", "--films", "0"]
    assert main(["failures", *words, "--out", str(tmp_path / "failures")]) == 0
    assert f"left out: {refused}" in capsys.readouterr().out


def test_options_of_a_planner_are_written_behind_its_name(tmp_path, monkeypatch):
    (tmp_path / "weak.py").write_text(WEAK_PLANNER)
    monkeypatch.syspath_prepend(tmp_path)
    sys.modules.pop("weak", None)
    assert load_planner("weak:Weak(throttle=0.5)").throttle == 0.5
    assert load_planner("weak:steer(turn=0.25)").act({})[1] == 0.25
    assert hash_code("weak:Weak(throttle=0.5)") == hash_code("weak:steer(turn=1)") == hash_file(tmp_path / "weak.py")
    wrong = {
        "weak:Weak(0.5)": "write options by keyword",
        "weak:Weak(throttle=open('x'))": "write options by keyword",
        "weak:Weak(throttle=": "write options by keyword",
        "weak:Weak(speed=3)": r"cannot be made with speed \(TypeError: .*speed",
        "weak:Weak(throttle=2)": r"cannot be made with throttle \(ValueError: throttle above 1",
        "weak:steer(gain=2)": "cannot be made with gain",
        "idm(speed=3)": "cannot be made with speed",
    }
    for name, message in wrong.items():
        with pytest.raises(ConfigError, match=message):
            load_planner(name)


def test_the_worst_scenarios_are_named_with_what_the_planner_does_there(tmp_path):
    names = ("free", "slow")
    movers = {"free": (Mover(speed_mps=9.3),), "slow": (Mover(speed_mps=9.3), Mover(x_m=30.0, speed_mps=3.0))}
    write_dataset([build_scenario(name, movers[name]) for name in names], tmp_path, split="validation")
    results = drive(DriveConfig("constant_velocity", data=str(tmp_path), traffic=("replay", "constant_velocity")))
    worst, *_ = rank_scenarios(results)
    assert (worst.scenario_id, worst.score) == ("slow", 0.0)
    assert "at fault for a collision" in worst.causes
    assert choose_films(results, "failures") == ["slow"]
    assert choose_films(results, "worst:9") == ["slow", "free"]
    for wrong in ("worst", "worst:0", "best"):
        with pytest.raises(ConfigError, match="film must be first, failures, or worst:N"):
            DriveConfig("idm", film=wrong)


def test_a_full_disk_is_noticed_before_anything_is_driven(tmp_path, monkeypatch):
    monkeypatch.setattr("rlftsim.envs.drive_scenario.run_planner", None)
    config = DriveConfig("constant_velocity", traffic=("replay",), limit=1)
    with limit_files_to(10), pytest.raises(DataError, match=r"cannot write .*\.lock .*: make room or choose another"):
        drive(config, tmp_path / "out")


def test_a_rollout_without_a_value_leaves_it_to_the_others(monkeypatch, tmp_path):
    # from the second rollout on a car stands in the planner's way
    rollouts = iter(["free", "blocked", "rammed"])
    movers = {"free": (), "blocked": (Mover(x_m=30.0, speed_mps=0.0),), "rammed": (Mover(x_m=-15.0, speed_mps=15.0),)}
    results = {name: driven("constant_velocity", build_scenario(name, (Mover(), *movers[name]))) for name in movers}

    def drive_next(*_, **__):
        return (([results[name]], None) for name in rollouts)

    for module in ("drive_scenario", "drive_films"):
        monkeypatch.setattr(f"rlftsim.envs.{module}.run_planner", drive_next)
    (row,) = drive(DriveConfig("constant_velocity", traffic=("replay",), limit=1, num_rollouts=3))
    assert row.values("blamed_others_rate")[0] == 0.5
    assert row.values("others_collision_rate")[0] == 0.0  # NaN where the planner is alone
    assert results["free"].planner.least_ttc_s == 3.0
    assert 1.0 < row.values("least_ttc_s")[0] < 3.0
    # a crash in one rollout of three is a failure, and the film shows that rollout
    assert find_failures(row) == row.scenario_ids == choose_films([row], "failures")
    rollouts, filmed = iter(["free", "blocked", "rammed"]), {}
    monkeypatch.setattr("rlftsim.envs.drive_films.build_animation", lambda records, _: filmed.update(records))
    monkeypatch.setattr("rlftsim.envs.drive_films.to_film", lambda *_, **__: None)
    config = DriveConfig("constant_velocity", traffic=("replay",), num_rollouts=3, film="failures")
    write_film(config, row.scenario_ids[0], tmp_path)
    assert filmed == {"constant_velocity in replay": results["blocked"].record}


def test_results_survive_their_file_and_pair_by_scenario(tmp_path):
    config = DriveConfig("constant_velocity", traffic=("replay",), limit=2)
    (result,) = drive(config)
    result.write(tmp_path / "a.parquet")
    again = DriveResult.read(tmp_path / "a.parquet")
    assert again.table.schema.equals(result.table.schema)
    np.testing.assert_equal(again.table.to_pydict(), result.table.to_pydict())
    assert again.settings == result.settings
    assert all(row.count == 0 or row.difference == 0 for row in compare_drives(result, again))
    (more,) = drive(DriveConfig("constant_velocity", traffic=("replay",), limit=1, num_rollouts=2))
    other_dice, other_data = (
        replace(result, settings=replace(result.settings, **new))
        for new in ({"seed": 1}, {"manifest_sha256": "0" * 64})
    )
    for other in (more, other_dice, other_data):
        with pytest.raises(DataError, match="drive both alike"):
            compare_drives(result, other)
    models = [replace(result, settings=replace(result.settings, model=model)) for model in ("none", "first", "second")]
    titles = [str(format_drive_comparison(compare_drives(models[a], models[b])).title) for a, b in ((0, 1), (1, 2))]
    assert ["models differ" in title for title in titles] == [False, True]
    with pytest.raises(DataError, match="no such result"):
        DriveResult.read(tmp_path / "none.parquet")


@pytest.fixture(scope="module")
def result_path(tmp_path_factory):
    """A result of one scenario."""
    out = tmp_path_factory.mktemp("drive")
    drive(DriveConfig("constant_velocity", traffic=("replay",), limit=1), out)
    return out / "constant_velocity-replay.parquet"


def about_of(table):
    return json.loads(table.schema.metadata[b"rlftsim"])


def with_settings(table, **changes):
    about = about_of(table)
    return with_metadata(table, {**about, "settings": {**about["settings"], **changes}})


def with_metadata(table, about):
    return table.replace_schema_metadata({"rlftsim": about if isinstance(about, str) else json.dumps(about)})


EDITS = {
    "no JSON": (lambda table: with_metadata(table, "{"), "not JSON, line 1"),
    "JSON of another kind": (lambda table: with_metadata(table, [1]), "holds a list instead of an object"),
    "no settings": (lambda table: with_metadata(table, {"format": "rlftsim-drive-1"}), "it lacks settings"),
    "no reasons": (
        lambda table: with_metadata(table, {n: v for n, v in about_of(table).items() if n != "missing"}),
        "it lacks missing",
    ),
    "a reason of another kind": (
        lambda table: with_metadata(table, {**about_of(table), "missing": {"x": 3}}),
        "a value in it is of another type",
    ),
    "a seed in letters": (lambda table: with_settings(table, seed="one"), "seed must be a whole number, got 'one'"),
    "no column of ids": (lambda table: table.drop_columns(["scenario_id"]), "it lacks column scenario_id"),
    "no column of a score": (lambda table: table.drop_columns(["comfort"]), "it lacks column comfort"),
    "a score that is no score": (
        lambda table: table.set_column(2, "nuplan_style", pa.array([1e200])),
        "column nuplan_style has a number beyond 1e+07",
    ),
    "a score in letters": (
        lambda table: table.set_column(2, "nuplan_style", pa.array(["high"])),
        "column nuplan_style has empty cells or those of another type",
    ),
}


@pytest.mark.parametrize("name", EDITS)
def test_an_edited_result_is_named_in_one_line(name, result_path, tmp_path, capsys):
    edit, cause = EDITS[name]
    edited = tmp_path / "edited.parquet"
    pq.write_table(edit(pq.read_table(result_path)), edited)
    for pair in ((result_path, edited), (edited, result_path)):
        assert main(["compare", *map(str, pair)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"rlftsim: {edited}: ")
        assert "not a result of `rlftsim drive`" in line
        assert cause in line or "Type-check error" in line  # where annotations are checked, that comes first
        assert line.endswith("drive again.")
    assert main(["compare", str(edited), str(edited)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert str(edited) in line


def test_a_cut_result_is_named_in_one_line(result_path, tmp_path, capsys):
    cut = tmp_path / "cut.parquet"
    cut.write_bytes(result_path.read_bytes()[:500])
    assert main(["compare", str(result_path), str(cut)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"rlftsim: {cut}: cannot be read (")


def drive_idm(**settings):
    return drive(DriveConfig("idm", **{"traffic": ("replay",), **settings}))[0].table.to_pydict()


@pytest.mark.parametrize("name", ["idm", "pdm", "rlftsim.envs.planners.flawed:LateBraker"])
def test_scenarios_side_by_side_have_the_scores_of_each_alone(name, monkeypatch):
    config = DriveConfig(name, traffic=("replay", "policy"), limit=3, num_rollouts=2)
    # the maps of the others end at different times
    longer = DriveConfig(name, traffic=("replay",), limit=4, seconds=20.0)
    assert config.count_side_by_side("replay", 3) == 3
    together = [*drive(config), *drive(longer)]
    monkeypatch.setattr(DriveConfig, "count_side_by_side", lambda *_: 1)
    for result, alone in zip(together, [*drive(config), *drive(longer)]):
        np.testing.assert_equal(result.table.to_pydict(), alone.table.to_pydict())
        assert result.missing == alone.missing


BATCH_PLANNERS = """
import numpy as np
from rlftsim.envs.planners.idm import IdmPlanner
class Fails(IdmPlanner):
    fails_in = {id!r}
    def __init__(self):
        self.scenarios = []
    def reset(self, info):
        self.scenarios.append(info["scenario"])
    def act_batch(self, observe):
        action = super().act_batch(observe)
        if self.fails_in in self.scenarios:
            raise ValueError("not here")
        return action
class NotANumber(Fails):
    def act_batch(self, observe):
        action = IdmPlanner.act_batch(self, observe)
        action[np.array(self.scenarios) == self.fails_in] = np.nan
        return action
class Stands(IdmPlanner):
    def act(self, observation):
        return np.array([-1.0, 0.0], np.float32)
"""


def test_a_scenario_in_which_the_planner_fails_leaves_the_others_their_scores(tmp_path, monkeypatch):
    second = open_dataset("synthetic", "validation").scenario_ids[1]
    (tmp_path / "batches.py").write_text(BATCH_PLANNERS.format(id=second))
    monkeypatch.syspath_prepend(tmp_path)
    expected = drive_idm(limit=3)
    for name, cause in (("Fails", "ValueError: not here"), ("NotANumber", "is nan")):
        (result,) = drive(DriveConfig(f"batches:{name}", traffic=("replay",), limit=3))
        assert result.failures.keys() == {second}
        assert f"planner {name} fails at step 0 of scenario {second}: " in result.failures[second]
        assert cause in result.failures[second]
        for column, values in result.table.to_pydict().items():
            np.testing.assert_equal(values[::2], expected[column][::2])
    # who defines `act` alone is not driven by the batches of the class above
    (stands,) = drive(DriveConfig("batches:Stands", traffic=("replay",), limit=2))
    assert max(stands.values("route_completion")) < min(expected["route_completion"][:2])


def test_an_interrupted_drive_side_by_side_does_what_is_missing(tmp_path, monkeypatch):
    expected = drive_idm(limit=4)
    original, driven = drive_module.drive_scenarios, []

    def drive_two(*arguments):
        driven.extend(arguments[-1])
        return original(*arguments) if arguments[-1][0] == 0 else 1 / 0

    config = DriveConfig("idm", traffic=("replay",), limit=4)
    with monkeypatch.context() as patch:
        patch.setattr(DriveConfig, "count_side_by_side", lambda *_: 2)
        patch.setattr(drive_module, "drive_scenarios", drive_two)
        with pytest.raises(ZeroDivisionError):
            drive(config, tmp_path)
    driven.clear()
    monkeypatch.setattr(drive_module, "drive_scenarios", lambda *a: driven.extend(a[-1]) or original(*a))
    (result,) = drive(config, tmp_path)  # four at once, of which two are done
    assert driven == [2, 3]
    np.testing.assert_equal(result.table.to_pydict(), expected)
    assert [path.name for path in tmp_path.iterdir()] == ["idm-replay.parquet"]


def test_processes_share_scenarios_that_are_driven_side_by_side():
    assert DriveConfig("idm", jobs=2).count_side_by_side("replay", 4) == 2
    np.testing.assert_equal(drive_idm(limit=4, jobs=2), drive_idm(limit=4))


def test_a_planner_that_follows_a_plan_asks_for_no_observation():
    env, planner, seen = EgoEnv(data="synthetic", traffic="replay"), load_planner("pdm"), []
    observation, info = env.reset(seed=0)

    def observe():
        seen.append(1)
        return {name: array[None] for name, array in observation.items()}

    planner.reset(info)
    for _ in range(11):
        assert planner.act_batch(observe).shape == (1, 2)
    assert len(seen) == 3


def test_edited_rows_of_an_unfinished_drive_are_driven_anew(tmp_path, monkeypatch):
    config = DriveConfig("constant_velocity", traffic=("replay",), limit=2)
    (whole,) = drive(config, tmp_path / "whole")
    first, second = whole.table["scenario_id"].to_pylist()
    driven = []
    original = drive_module.drive_scenarios
    monkeypatch.setattr(drive_module, "drive_scenarios", lambda *a: driven.extend(a[-1]) or original(*a))
    for number, edit in enumerate((
        lambda row: row,  # as it was: only the other scenario is driven
        lambda row: row.pop("comfort"),
        lambda row: row.update(comfort="high"),
        lambda row: row.update(comfort=None),
        lambda row: row.update(scenario_id=second),
        lambda row: row.clear(),
    )):  # fmt: skip
        out = tmp_path / str(number)
        parts = out / "constant_velocity-replay.parts"
        parts.mkdir(parents=True)
        row = whole.table.to_pylist()[0]
        edit(row)
        settings = whole.settings.what_counts()
        (parts / f"{first}.json").write_text(json.dumps({"settings": settings, "row": row, "missing": {}}))
        driven.clear()
        (again,) = drive(config, out)
        assert driven == ([0, 1] if number else [1])
        np.testing.assert_equal(again.table.to_pydict(), whole.table.to_pydict())


def test_an_error_of_the_world_is_not_the_planners(monkeypatch):
    def advance(*_):
        raise RuntimeError("a defect of ours")

    monkeypatch.setattr("rlftsim.envs.planner_episode.advance", advance)
    with pytest.raises(RuntimeError, match="a defect of ours"):
        driven("idm", straight_road())
