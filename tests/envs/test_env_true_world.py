"""Planners in the world that made the logs: conflicts at the current step, planners with flaws, a whole experiment."""

import importlib.util
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow.parquet as pq
import pytest

from rlftsim.cli.main import main
from rlftsim.envs import conflicts, sumo_traffic, true_world
from rlftsim.envs.conflicts import CROSSING, FOLLOWING, MERGING, PEDESTRIAN, find_conflicts
from rlftsim.envs.scene import build_env_scene
from rlftsim.envs.true_world import GHOST, TRUTH, TrueWorldConfig
from rlftsim.envs.true_world_episode import Trip
from rlftsim.envs.true_world_traffic import Surroundings
from rlftsim.errors import ConfigError
from rlftsim.jobs.runner import Inline
from rlftsim.scenario.synthetic import sumo
from rlftsim.scenario.synthetic.generate import generate
from rlftsim.scenario.types import MapFeatureType, ObjectType
from scenes import Mover, build_scenario, polylines

LANE = MapFeatureType.LANE_SURFACE_STREET
MAP = (
    (LANE, [(-100, 0), (30, 0)]),
    (LANE, [(30, 0), (200, 0)]),
    (LANE, [(-100, 3.5), (200, 3.5)]),  # beside the ego's lane
    (LANE, [(15, -60), (15, 60)]),  # across it
    (LANE, [(4, -20), (15, -6), (22, -2), (30, 0)]),  # into it
)


def kinds(monkeypatch, *movers):
    """Conflicts of an ego at 8 m/s with road users of SUMO."""
    scenario = build_scenario("conflict", (Mover(speed_mps=8.0), *movers), polylines(MAP))
    scene = build_env_scene(scenario, 91)
    rows = [row for row in range(len(scene.object_id)) if row != scene.ego]
    monkeypatch.setattr(conflicts, "build_sumo_scene", lambda *_: SimpleNamespace(rows=rows))
    return find_conflicts(scenario, Path("data"))


@pytest.mark.parametrize(
    ("mover", "kind"),
    [
        (Mover(x_m=-15.0, speed_mps=9.0), {FOLLOWING}),
        (Mover(x_m=-40.0, speed_mps=9.0), set()),  # 4 s behind
        (Mover(x_m=-15.0, speed_mps=0.0), set()),  # stands
        (Mover(x_m=-15.0, y_m=3.5, speed_mps=9.0), set()),  # in the next lane
        (Mover(x_m=15.0, speed_mps=6.0), set()),  # ahead
        (Mover(x_m=15.0, y_m=-30.0, heading_rad=np.pi / 2, speed_mps=9.0), {CROSSING}),
        (Mover(x_m=15.0, y_m=-15.0, heading_rad=np.pi / 2, speed_mps=0.0), {CROSSING}),  # waits, may drive off
        (Mover(x_m=15.0, y_m=-50.0, heading_rad=np.pi / 2, speed_mps=9.0), set()),  # too far
        (Mover(x_m=15.0, y_m=20.0, heading_rad=np.pi / 2, speed_mps=9.0), set()),  # has crossed
        (Mover(x_m=4.0, y_m=-20.0, heading_rad=0.9, speed_mps=9.0), {MERGING}),
        (Mover(ObjectType.PEDESTRIAN, x_m=20.0, y_m=-4.0, heading_rad=np.pi / 2, speed_mps=1.2), {PEDESTRIAN}),
        (Mover(ObjectType.PEDESTRIAN, x_m=20.0, y_m=-4.0, heading_rad=-np.pi / 2, speed_mps=1.2), set()),
    ],
)
def test_conflicts_are_those_that_are_seen_at_the_current_step(mover, kind, monkeypatch):
    assert kinds(monkeypatch, mover) == kind


def test_models_are_named_with_a_temperature():
    assert Surroundings.parse("demo-tuned") == Surroundings("demo-tuned", "policy", "demo-tuned", 1.0)
    assert Surroundings.parse(" hot=runs/a@1.3") == Surroundings("hot", "policy", "runs/a", 1.3)
    with pytest.raises(ConfigError, match=r"write a temperature as a number, MODEL@1\.3"):
        Surroundings.parse("demo-tuned@warm")
    with pytest.raises(ConfigError, match="same name"):
        TrueWorldConfig("data", (TRUTH, GHOST, TRUTH))


@pytest.mark.parametrize(
    ("limit", "wanted", "windows"),
    [(None, 9, "a0 b0 a1 b1"), (1, 0, "a0"), (1, 1, "a0 b0"), (2, 2, "a0 b0 b1"), (2, 1, "a0 b0"), (2, 9, "a0 b0 b1")],
)
def test_conflict_windows_are_added_to_random_ones_until_there_are_enough(limit, wanted, windows, monkeypatch):
    """Of the windows in turn, a0 b0 a1 b1, b0 and b1 have a conflict of vehicles."""
    names = ["a0", "a1", "b0", "b1"]
    monkeypatch.setattr(true_world, "dataset_folder", Path)
    monkeypatch.setattr(true_world, "ScenarioDataset", lambda _: SimpleNamespace(scenario_ids=names))
    monkeypatch.setattr(
        true_world, "find_window", lambda _, name: SimpleNamespace(path=Path(name[0]), index=int(name[1]))
    )
    monkeypatch.setattr(
        true_world, "list_conflicts", lambda _, name: frozenset({"crossing" if "b" in name else "pedestrian"})
    )
    model = Surroundings("tuned", "policy")
    config = TrueWorldConfig("data", (TRUTH, model), ("log",), limit=1, num_rollouts=2)
    trips = [(trip.surroundings.name, trip.rollout, trip.name) for trip in config.trips]
    assert trips == [("truth", 0, "a0-truth-log"), ("tuned", 0, "a0-tuned-log"), ("tuned", 1, "a0-tuned-log~1")]
    config = TrueWorldConfig("data", (TRUTH,), ("log",), limit=limit, conflict_windows=wanted)
    assert " ".join(trip.window for trip in config.trips) == windows
    assert [trip.is_random for trip in config.trips] == [k < (limit or 4) for k in range(len(config.trips))]


def test_planners_whose_episodes_would_share_a_file_are_refused(tmp_path, monkeypatch):
    trips = [Trip("data", "a0", "a", TRUTH, planner, 0) for planner in ("mine:Fast", "mine.Fast")]
    monkeypatch.setattr(TrueWorldConfig, "trips", trips)
    monkeypatch.setattr(true_world, "hash_manifest", lambda folder: "0")
    monkeypatch.setattr(true_world, "hash_code", lambda planner: "0")
    monkeypatch.setattr(true_world, "dataset_folder", Path)
    config = TrueWorldConfig("data", (TRUTH,), ("log",))
    with pytest.raises(ConfigError, match=r"^a0-truth-mine\.Fast names two episodes: .*leave one out\.$"):
        true_world.drive_true_world(config, tmp_path / "out", Inline())


@pytest.mark.skipif(
    not sumo.is_available() or importlib.util.find_spec("libsumo") is None,
    reason="the extra `synthetic` is not installed",
)
def test_planners_are_driven_in_the_truth_and_in_other_traffic_and_a_second_call_drives_nothing(
    tmp_path, monkeypatch, capsys
):
    generate(tmp_path / "data", num_scenarios=2, seed=77, splits={"exam": 1.0}, keep_worlds=True, show_progress=False)
    words = f"experiment true-world --data {tmp_path / 'data'} --models demo-base --planners log,hard_braker"
    command = [*words.split(), "--out", str(tmp_path / "out")]
    assert main(command) == 0
    while sumo_traffic._WORLDS:
        sumo_traffic._WORLDS.popitem()[1].close()
    table = pq.read_table(tmp_path / "out" / "rows.parquet")
    rows = {(r["window"], r["traffic"], r["planner"]): r for r in table.to_pylist()}
    assert len(rows) == len(table) == 2 * 7 * 2
    windows = sorted({window for window, _, _ in rows})
    for window in windows:
        # SUMO left alone is the log, and the logged ego stays on it
        assert rows[window, "ghost", "log"]["distance_m"] < 0.01
        assert rows[window, "ghost", "log"]["nuplan_style"] == rows[window, "replay", "log"]["nuplan_style"]
        assert rows[window, "truth", "hard_braker"]["network"] == "77-0-0-0-source"
    assert max(rows[window, "truth", "hard_braker"]["distance_m"] for window in windows) > 5
    report = (tmp_path / "out" / "report.md").read_text()
    assert "2 windows of 1 networks × 2 planners" in report
    assert (tmp_path / "out" / "figure.png").exists()
    with monkeypatch.context() as patch:
        patch.setattr("rlftsim.envs.true_world_episode.run_planner", None)  # a call would fail
        assert main(command) == 0
    assert (tmp_path / "out" / "report.md").read_text() == report
    assert main([*command, "--num-rollouts", "2", "--films", "1"]) == 0
    again = pq.read_table(tmp_path / "out" / "rows.parquet").to_pylist()
    assert [row for row in again if not row["rollout"]] == table.to_pylist()
    second = [row for row in again if row["rollout"] == 1]
    assert {row["traffic"] for row in second} == {"demo-base", "idm"}
    assert len(second) == 2 * 2 * 2
    first = [rows[row["window"], row["traffic"], row["planner"]] for row in second]
    assert any(row["nuplan_style"] != before["nuplan_style"] for row, before in zip(second, first, strict=True))
    assert main([*command, "--films", "1", "--models", ","]) == 2
    assert "films show where a model errs: name one with --models." in capsys.readouterr().err
    page = (tmp_path / "out" / "films.html").read_text()
    assert page.count("<figure") == 1
    truth = {(w, p): row["nuplan_style"] for (w, t, p), row in rows.items() if t == "truth"}
    errors = {
        (row["window"], row["planner"], row["rollout"]): abs(row["nuplan_style"] - truth[row["window"], row["planner"]])
        for row in again if row["traffic"] == "demo-base"
    }  # fmt: skip
    window, planner, rollout = max(errors, key=lambda key: errors[key])
    assert f"{planner} in {window}" in page
    for traffic in ("truth", "demo-base", "replay", "idm"):
        shown = {
            row["rollout"]: row["nuplan_style"] for row in again
            if (row["window"], row["planner"], row["traffic"]) == (window, planner, traffic)
        }  # fmt: skip
        assert f">{traffic}: {shown.get(rollout, shown[0]):.2f}" in page
