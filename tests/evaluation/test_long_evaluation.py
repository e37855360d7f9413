"""Long rollouts held against the log of the same world, by windows of 10 s."""

import csv
from dataclasses import replace

import numpy as np
import pytest

import rlftsim as rs
import scenes
from rlftsim.cli.main import main
from rlftsim.errors import ConfigError, DataError
from rlftsim.evaluation.motion import Motion
from rlftsim.evaluation.windows import join_samples, measure_windows
from rlftsim.scenario.types import HISTORY_STEPS


@pytest.fixture
def long_road(monkeypatch):
    """A road on which everybody keeps the speed for 20 s."""
    monkeypatch.setattr(scenes, "TOTAL_STEPS", HISTORY_STEPS + 200)
    movers = (scenes.Mover(speed_mps=5.0), scenes.Mover(x_m=20.0, speed_mps=5.0), scenes.Mover(x_m=40.0, speed_mps=0.0))
    return scenes.build_scenario("long", movers, scenes.straight_map())


def test_samples_of_a_world_that_is_known():
    steps = np.arange(200)
    x = np.stack([0.0 * steps, 20.0 + 0.2 * steps, np.full(200, 30.0)])  # the second passes the third at 5 s
    motion = Motion(
        position=np.stack([x, np.zeros_like(x)], -1),
        heading=np.zeros_like(x),
        size=np.full((3, 3), 2.0),
        z=np.zeros(3),
        valid=np.ones(x.shape, bool),
        is_vehicle=np.ones(3, bool),
        ego=0,
    )
    motion.valid[2, 100:150] = False
    first, second = measure_windows(motion, scenes.without_map())
    assert (first.density == 2).all()
    assert second.density.mean() == pytest.approx(1.5, abs=0.06)  # the third is away for half of it
    np.testing.assert_allclose(first.speed, 2.0)
    assert first.collisions.sum() == 2  # both
    assert second.collisions.sum() == 0
    assert (first.entries.sum(), second.entries.sum()) == (0, 1)
    assert first.agent_minutes.sum() == pytest.approx(0.5)
    assert first.gap.max() == pytest.approx(10.0)


def test_incidents_of_a_world_that_is_known(monkeypatch):
    monkeypatch.setattr(scenes, "TOTAL_STEPS", HISTORY_STEPS + 600)
    light = scenes.light(1, 33.7, 0.2, red_until=10**6)
    scenario = scenes.build_scenario("long", map_features=scenes.straight_map(), lights=light)
    time = np.arange(600) / 10
    movers = [  # x, y, heading
        (-30.0, 3.7, np.pi),  # stands, and the way is free
        (-22.0, 3.7, np.pi),  # stands behind it
        (30.0, 0.2, 0.0),  # waits at the red light
        (5 * time, 0.2, 0.0),  # passes it after 6.8 s
        (60.0, -2.4, 0.0),  # is parked beside the lane, half off the road
        (130 - time, 3.7 + 0.1 * time, np.pi),  # its corner is 0.3 m off the road after 14.5 s
        (20.0, -3 + time, np.pi / 2),  # a pedestrian crosses the road
    ]
    x, y, heading = (np.stack([np.broadcast_to(mover[axis], 600) for mover in movers]) for axis in range(3))
    motion = Motion(
        position=np.stack([x, y], -1) + scenes.EGO_POSITION_M - scenario.origin,
        heading=heading,
        size=np.array([*[(4.6, 1.9, 1.6)] * 6, (0.9, 0.8, 1.7)]),
        z=np.full(7, 3.8),
        valid=np.ones(x.shape, bool),
        is_vehicle=np.arange(7) < 6,
        ego=0,
    )
    windows = measure_windows(motion, scenario)
    assert [float(window.departures.sum()) for window in windows] == [0, 1, 0, 0, 0, 0]
    assert [float(window.red_lights.sum()) for window in windows] == [1, 0, 0, 0, 0, 0]
    assert [float(window.stuck.sum()) for window in windows] == [0, 0, 19, 20, 20, 20]
    # on a lane are three that stand: one drives on beyond the map's end, one off the road
    assert [window.stuck.mean() for window in windows[3:]] == pytest.approx([1 / 3] * 3)
    motion.valid[0, 400:450] = False  # is away for 5 s: whoever comes then has not stood
    assert join_samples(measure_windows(motion, scenario)[4:]).stuck.sum() == 0


def test_who_drives_as_the_log_has_ratios_of_one(long_road, tmp_path):
    result = rs.evaluate("constant_velocity", [long_road], num_rollouts=2, seconds=20.0, out=tmp_path)
    assert [row[:2] for row in result.rows()] == [
        [name, window] for name in ("log", "constant_velocity") for window in ("0-10", "10-20")
    ]
    for row in result.rows()[2:]:
        assert all("(1.00)" in row[column] for column in (2, 3, 4, 7))
        assert (row[5], row[10:]) == ("0.00", ["0.00", "0.00", "0.0"])
    path = tmp_path / "constant_velocity.csv"
    with path.open() as file:
        lines = list(csv.DictReader(file))
    assert [(line["world"], line["start_s"]) for line in lines] == [(row[0], row[1][:-3]) for row in result.rows()]
    assert float(lines[2]["speed_mps"]) == pytest.approx(float(lines[0]["speed_mps"])) == pytest.approx(5.0)
    before = path.read_text()
    rs.evaluate("constant_velocity", [long_road], num_rollouts=2, rollouts_per_pass=1, seconds=20.0, out=tmp_path)
    assert path.read_text() == before
    with pytest.raises(
        ConfigError, match=r"is the result of another rollouts \(2, not 1\), seed \(0, not 1\): name another --name"
    ):
        rs.evaluate("constant_velocity", [long_road], num_rollouts=1, seed=1, seconds=20.0, out=tmp_path)
    with pytest.raises(ConfigError, match="an evaluation's name becomes a file name"):
        rs.evaluate("constant_velocity", [long_road], name="../up", seconds=20.0, out=tmp_path)


def test_what_cannot_be_held_against_the_log_is_refused_in_one_line(long_road, tmp_path, capsys):
    command = ["evaluate", "constant_velocity", "--data", "synthetic", "--out", str(tmp_path / "out")]
    assert main([*command, "--seconds", "60"]) == 2
    printed = " ".join(capsys.readouterr().err.split())
    assert "its log goes on for 8.0 s, too short to hold 60 s against: rlftsim synthesize --seconds 70" in printed
    assert not (tmp_path / "out").exists()
    for settings, reason in (
        ({"seconds": 15.0}, "windows last 10 s"),
        ({"seconds": 10.0, "jobs": 2}, "jobs has no effect on long rollouts"),
        ({"entries": "none"}, "entries has no effect on 8 s: leave it out, or name the seconds"),
        ({"ego": "log"}, "ego has no effect on 8 s"),
    ):
        with pytest.raises(ConfigError, match=reason):
            rs.evaluate("constant_velocity", [long_road], **settings)
    lacking = replace(long_road, tracks=replace(long_road.tracks, valid=long_road.tracks.valid.copy()))
    lacking.tracks.valid[lacking.ego_index, 60:80] = False
    with pytest.raises(DataError, match=r"lacks the ego 5\.0 s after now"):
        rs.evaluate("constant_velocity", [lacking], seconds=10.0, ego="log")
    with pytest.raises(ConfigError, match="oracle"):
        rs.evaluate("oracle", [long_road], seconds=10.0)
    with pytest.raises(DataError, match="too short"):
        rs.evaluate("constant_velocity", [scenes.straight_road()], seconds=30.0)


def test_windows_after_the_ego_has_left_the_map_do_not_count(monkeypatch):
    monkeypatch.setattr(scenes, "TOTAL_STEPS", HISTORY_STEPS + 300)
    scenario = scenes.build_scenario("long", map_features=scenes.straight_map())
    x = np.stack([np.full(300, 10.0), 15 * np.arange(300) / 10])  # the second is 30 m off the lanes within 20 s
    motion = Motion(
        position=np.stack([x, np.zeros_like(x)], -1) + scenes.EGO_POSITION_M - scenario.origin,
        heading=np.zeros_like(x), size=np.full((2, 3), 2.0), z=np.full(2, 3.8), valid=np.ones(x.shape, bool),
        is_vehicle=np.ones(2, bool), ego=0,
    )  # fmt: skip
    stays, leaves = (measure_windows(replace(motion, ego=ego), scenario) for ego in (0, 1))
    assert [len(window.density) for window in stays] == [20, 20, 20]
    assert [len(window.density) for window in leaves] == [20, 0, 0]
    assert [len(window.entries) for window in leaves] == [1, 0, 0]


def test_a_world_in_which_nothing_moves_has_no_incidents(monkeypatch):
    monkeypatch.setattr(scenes, "TOTAL_STEPS", HISTORY_STEPS + 100)
    parked = scenes.build_scenario("parked", (scenes.Mover(), scenes.Mover(x_m=20.0)), scenes.straight_map())
    result = rs.evaluate("constant_velocity", [parked], num_rollouts=1, seconds=10.0)
    assert [row["road_departures_per_agent_min"] for row in result.values()] == [0, 0]
