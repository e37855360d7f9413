"""Anybody's recordings: what the tables of the contract become, and what is said where they break it."""

import gzip
import os
import pickle
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from rlftsim.errors import DataError
from rlftsim.scenario.convert import convert
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.inspect import verify_dataset
from rlftsim.scenario.sources import find_source
from rlftsim.scenario.tables import TablesSource
from rlftsim.scenario.types import CURRENT_STEP, MapFeatureType, ObjectType
from table_files import MAP, car, write_tables

ROOT = Path(__file__).parents[2]


def read(folder):
    source = TablesSource()
    (unit,) = source.find(folder)
    return [item for item in source.read(unit) if not isinstance(item, int)]


def test_tables_become_a_scenario(tmp_path):
    (scenario,) = read(write_tables(tmp_path / "drive"))
    tracks = scenario.tracks
    assert (scenario.scenario_id, scenario.source, scenario.guessed) == ("one", "tables", {"size", "z"})
    assert tracks.position[scenario.ego_index, CURRENT_STEP, :2].tolist() == pytest.approx([10.0, 0.0])
    assert tracks.object_id[scenario.tracks_to_predict].tolist() == [8]
    assert tracks.valid.all()
    assert tracks.size[0, 0].tolist() == pytest.approx([4.61, 2.06, 1.59])
    assert tracks.position[0, 0, 2] == pytest.approx(1.59 / 2)
    features = scenario.map_features
    assert features.feature_type.tolist() == [2, 15, 15, 2]
    assert features.polyline(2).tolist() == [[200, 6, 0], [-50, 6, 0]]


def test_what_is_given_is_not_guessed(tmp_path):
    tracks = car(7, 0.0, z=3.5, length=5.0, width=2.0, height=1.5)
    high = [{**row, "z": 3.0} for row in MAP]
    (scenario,) = read(
        write_tables(tmp_path / "drive", tracks, [{"scenario_id": "one", "ego_id": 7, "predict": []}], high)
    )
    assert scenario.guessed == set()
    assert scenario.tracks.position[0, 0, 2] == 3.5
    # without heights of tracks the boxes stand on the map
    bare = [{k: v for k, v in row.items() if k != "z"} for row in tracks]
    (scenario,) = read(write_tables(tmp_path / "flat", bare, [{"scenario_id": "one", "ego_id": 7}], high))
    assert scenario.guessed == {"z", "predict"}
    assert scenario.tracks.position[0, 0, 2] == pytest.approx(3.75)


@pytest.mark.parametrize("step_s", [0.02, 0.04, 0.1, 0.5])
def test_any_rate_becomes_ten_hertz(tmp_path, step_s):
    steps = range(int(9.0 / step_s) + 1)
    tracks = car(7, 0.0, steps=steps, step_s=step_s)
    for row in tracks:  # a turn through pi, along the circle
        row["heading"] = float(np.remainder(3.1 + 0.2 * row["step"] * step_s + np.pi, 2 * np.pi) - np.pi)
        row["vx"], row["x"] = 0.0, 0.0
    (scenario,) = read(write_tables(tmp_path / "d", tracks, [{"scenario_id": "one", "ego_id": 7, "step_s": step_s}]))
    expected = np.remainder(3.1 + 0.02 * np.arange(91) + np.pi, 2 * np.pi) - np.pi
    assert np.abs(scenario.tracks.heading[0] - expected).max() < 1e-5
    assert scenario.tracks.valid.all()


def test_short_holes_are_filled_and_longer_ones_are_not(tmp_path):
    steps = [s for s in range(91) if s not in (31, 32, 33, 34) and not 50 <= s < 55]
    (scenario,) = read(write_tables(tmp_path / "d", [*car(7, 0.0), *car(8, 20.0, steps=steps)]))
    valid = scenario.tracks.valid[1]
    assert valid[31:35].all()
    assert not valid[50:55].any()
    assert valid.sum() == 86
    assert scenario.tracks.position[1, 33, 0] == pytest.approx(53.0)


def test_lanes_lights_and_shared_maps(tmp_path):
    shared = [{"map_id": "m", **{k: v for k, v in row.items() if k != "scenario_id"}} for row in MAP]
    lanes = [{"map_id": "m", "lane_id": 1, "entry": [9], "exit": [4], "left": [4], "speed_limit_mph": 25.0}]
    lights = [
        {"scenario_id": "one", "step": s, "lane_id": 1, "state": "stop" if s < 5 else "go"} for s in range(0, 91, 2)
    ]
    row = [{"scenario_id": "one", "ego_id": 7, "map_id": "m", "step_s": 0.1}]
    (scenario,) = read(write_tables(tmp_path / "d", None, row, shared, lanes=lanes, lights=lights))
    topology = scenario.map_features.topology
    assert topology.exit_lanes.tolist() == [[1, 4]]
    assert not len(topology.entry_lanes)  # lane 9 is not on the map
    assert topology.neighbors.tolist() == [[1, 0, 4, 0, 1, 0, 1]]
    assert topology.speed_limit_mph.tolist() == [25.0, 0.0, 0.0, 0.0]
    assert scenario.lights.step.tolist() == list(range(0, 91, 2))
    assert scenario.lights.stop_point[0].tolist() == [-50.0, 0.0, 0.0]
    assert scenario.lights.state.tolist()[:4] == [4, 4, 4, 6]


def drop(rows, name):
    return [{k: v for k, v in row.items() if k != name} for row in rows]


def changed(rows, number, **values):
    return [{**row, **values} if k == number else row for k, row in enumerate(rows)]


def backing(rows):
    """Rows whose heading is turned for 1.5 s."""
    return [{**row, "heading": 3.1} if 20 <= row["step"] < 35 else row for row in rows]


TWO = [*car(7, 0.0), *car(8, 20.0)]
ROW = {"scenario_id": "one", "ego_id": 7}
NONE = pa.table({"scenario_id": pa.array([], pa.string()), "ego_id": pa.array([], pa.int64())})
LANE = {"scenario_id": "one", "lane_id": 1}
LIGHT = {"scenario_id": "one", "step": 0, "lane_id": 1, "state": "stop"}
NAMED_MAP = [{"map_id": "m", **{k: v for k, v in row.items() if k != "scenario_id"}} for row in MAP]
BAD = {
    "NaN": ({"tracks": changed(TWO, 40, x=float("nan"))}, "tracks.parquet: row 40: x is nan"),
    "empty": ({"tracks": changed(TWO, 40, object_id=None)}, "tracks.parquet: row 40: object_id is empty"),
    "twice": ({"tracks": [*TWO, TWO[3]]}, r"tracks.parquet: row 182: object 7 has a second row for step 3"),
    "jumps": (
        {"tracks": changed(changed(TWO, 4, x=-16.0), 95, x=44.0)},
        r"tracks.parquet: positions jump in 2 of 2 tracks: track 7 moves 19.0 m from step 3 to 4: vx and",
    ),
    "backwards": (
        {"tracks": [*backing(car(7, 0.0)), *backing(car(8, 20.0))]},
        "tracks.parquet: headings contradict the motion of 2 of 2 .* track 7 backs up for more than 1 s",
    ),
    "type": ({"tracks": changed(TWO, 3, type="tram")}, "row 3: type 'tram' is none of unset, vehicle"),
    "second type": ({"tracks": changed(TWO, 3, type="cyclist")}, "object 7 has a second type"),
    "size": ({"tracks": [{**row, "width": 0.0} for row in TWO]}, "row 0: width is 0, it must be above zero"),
    "short": ({"tracks": car(7, 0.0, steps=range(50))}, "4.9 s from step 0 on, 9 s are needed"),
    "no ego": ({"scenarios": [{**ROW, "ego_id": 9}]}, "scenarios.parquet: row 0: no ego: object 9 has no rows"),
    "ego gone": ({"scenarios": [{**ROW, "first_step": -20}]}, "no ego: object 7 is not there 1 s after step -20"),
    "more rows than tracks": (
        {"scenarios": pa.table({"scenario_id": ["one"] * 200, "ego_id": [7] * 200})},
        "scenarios.parquet has 200 rows, tracks.parquet only 182: each row makes a scenario",
    ),
    "any number of rows": (
        {"scenarios": pa.table({"scenario_id": pa.repeat("one", 1_000_001), "ego_id": pa.repeat(7, 1_000_001)})},
        "scenarios.parquet has 1000001 rows, above 1000000: write several folders",
    ),
    "no rows": ({"scenarios": NONE}, "scenarios.parquet has no rows"),
    "lists": ({"scenarios": [{**ROW, "predict": [["8"]]}]}, "predict is list.*, it must have lists of whole numbers"),
    "texts": ({"lanes": [{**LANE, "exit": ["4"]}]}, "exit is list.*, it must have lists of whole numbers"),
    "guessed": ({"scenarios": [{**ROW, "guessed": [1]}]}, "guessed is list.*, it must have lists of words"),
    "map id": ({"scenarios": [{**ROW, "map_id": "n"}], "map_rows": NAMED_MAP}, "row 0: map n has no rows in map.parq"),
    "no map id": ({"map_rows": NAMED_MAP}, "scenarios.parquet has no column map_id"),
    "speed limit": ({"lanes": [{**LANE, "speed_limit_mph": np.inf}]}, "lanes.parquet: row 0: speed_limit_mph is inf"),
    "speed limit beyond float32": ({"lanes": [{**LANE, "speed_limit_mph": 1e300}]}, "speed_limit_mph is 1e\\+300"),
    "stop point": ({"lights": [{**LIGHT, "x": np.nan, "y": 0.0}]}, "lights.parquet: row 0: x is nan"),
    "predict": ({"scenarios": [{**ROW, "predict": [5]}]}, "predict lists object 5"),
    "rate": ({"scenarios": [{**ROW, "step_s": 2.0}]}, "step_s is 2, it must lie between"),
    "edge": ({"map_rows": [*MAP[:2], *MAP[3:1:-1], *MAP[4:]]}, "row 2: road edge 2 has the lanes on its right"),
    "feature": ({"map_rows": MAP[:3]}, "map.parquet: row 2: feature 2 has 1 points, it needs 2"),
    "map type": ({"map_rows": changed(MAP, 1, type="edge_median")}, "row 1: feature 1 has a second type"),
    "no heights": ({"tracks": [{**row, "z": 1.0} for row in TWO]}, "give both or neither"),
    "column": ({"tracks": drop(TWO, "vx")}, "tracks.parquet has no column vx"),
    "kind": ({"tracks": [{**row, "x": "a"} for row in TWO]}, "column x is string, it must have numbers"),
    "no map": ({"map_rows": drop(MAP, "scenario_id")}, "map.parquet has no column scenario_id or map_id"),
    "lane": ({"lanes": [{"scenario_id": "one", "lane_id": 2}]}, "lanes.parquet: row 0: lane 2 is no lane"),
    "across": ({"tracks": [{**r, "vx": 0.0, "vy": 9.0} for r in TWO]}, "tracks.parquet: velocities contradict"),
    "time base": ({"scenarios": [{**ROW, "step_s": 0.2}]}, "moves at 5.0 m/s, its velocity is 10.0 m/s and"),
    "headings": ({"tracks": [{**r, "heading": 1.4} for r in TWO]}, "tracks.parquet: headings contradict the motion"),
    "heights": (
        {"tracks": [{**r, "z": 40.0} for r in TWO], "map_rows": [{**r, "z": 0.0} for r in MAP]},
        r"tracks.parquet: heights \(z\) contradict the map near 2 of 2 moving tracks: track . is at 40.0 m",
    ),
    "predict twice": ({"scenarios": [{**ROW, "predict": [8, 8]}]}, "row 0: predict lists object 8 twice"),
    "lane twice": ({"lanes": [LANE, LANE]}, "lanes.parquet: row 1: a second row with lane_id 1"),
    "light twice": ({"lights": [LIGHT, {**LIGHT, "state": "go"}]}, "row 1: a second row with lane_id 1, step 0"),
    "light": ({"lights": [{"scenario_id": "one", "step": 0, "lane_id": 1, "state": 77}]}, "row 0: state 77"),
}  # fmt: skip


@pytest.mark.parametrize("kind", BAD)
def test_a_break_of_the_contract_is_named_with_its_row(tmp_path, kind):
    tables, cause = BAD[kind]
    write_tables(tmp_path / "d", **tables)
    with pytest.raises(DataError) as caught:
        convert(tmp_path / "d", tmp_path / "data", on_error="stop", jobs=1, show_progress=False)
    assert re.search(cause, str(caught.value)), str(caught.value)


@pytest.mark.parametrize(
    ("tracks", "detail"),
    [
        (changed(TWO, 95, x=40.0), "teleport: one: track 8 moves 17.0 m from step 3 to 4 (and 1 more)"),
        (
            [*car(7, 0.0), *backing(car(8, 20.0))],
            "backward driving: one: track 8 moves against its heading faster than 3 m/s for more than 1 s from step 19",
        ),
    ],
    ids=["jump", "backwards"],
)
def test_a_single_track_that_contradicts_itself_is_listed_and_costs_no_scenario(tmp_path, tracks, detail):
    report = convert(write_tables(tmp_path / "d", tracks), tmp_path / "data", jobs=1, show_progress=False)
    assert (report.converted, report.skipped) == (1, ())
    assert [str(finding) for finding in verify_dataset(tmp_path / "data")] == [detail]


def test_a_file_in_place_of_its_folder_is_refused(tmp_path):
    write_tables(tmp_path / "d")
    with pytest.raises(DataError, match="no such folder; name the one"):
        convert(tmp_path / "d" / "tracks.parquet", tmp_path / "data", reader="tables", show_progress=False)


@pytest.mark.parametrize("name", ["../../outside", "a/b", "", ".."])
def test_an_id_that_is_no_file_name_costs_its_scenario(tmp_path, name):
    bad = [[{**row, "scenario_id": name} for row in rows] for rows in (TWO, [ROW], MAP)]
    write_tables(tmp_path / "d", *([*rows, *more] for rows, more in zip(bad, (TWO, [ROW], MAP))))
    report = convert(tmp_path / "d", tmp_path / "data", jobs=1, show_progress=False)
    assert report.converted == 1
    assert f"scenario id {name!r} is no file name" in str(report.skipped[0])


def test_a_column_of_licenses_may_be_empty(tmp_path):
    write_tables(tmp_path / "d", TWO, [{**ROW, "license": None, "guessed": ["ego", None]}])
    (scenario,) = read(tmp_path / "d")
    assert scenario.guessed == {"ego", "predict", "size", "z"}


def test_a_bad_scenario_costs_itself_alone(tmp_path):
    tracks = [*TWO, *car(7, 0.0, scenario_id="two", speed=float("nan"))]
    rows = [{**ROW, "scenario_id": "two"}, ROW]
    report = convert(write_tables(tmp_path / "d", tracks, rows), tmp_path / "data", jobs=1, show_progress=False)
    assert report.converted == 1
    assert str(report.skipped[0]).startswith("d: record 0: scenario two: tracks.parquet: row 182: x is nan")


def test_utm_coordinates_are_refused_where_float32_is_coarse(tmp_path):
    utm = {"x": 664_321.0, "y": 3_999_876.0}
    tracks, lines = ([{**row, **{c: row[c] + utm[c] for c in "xy"}} for row in rows] for rows in (TWO, MAP))
    where = (
        r"at \(664321, 3999876, 1\) m at step 0, where float32 resolves 0.25 m: subtract an origin near it, in whole"
    )
    with pytest.raises(DataError, match=where):
        convert(write_tables(tmp_path / "d", tracks, [ROW], lines), tmp_path / "data", jobs=1, show_progress=False)


def test_several_folders_are_several_shards_with_their_licenses(tmp_path):
    for name, note in (("training", "CC0-1.0"), ("validation", "ODbL")):
        rows = [{**car_row, "scenario_id": name} for car_row in TWO]
        write_tables(tmp_path / "all" / name, rows, [{**ROW, "scenario_id": name, "license": note, "guessed": ["ego"]}],
              [{**row, "scenario_id": name} for row in MAP])  # fmt: skip
    assert isinstance(find_source("auto", tmp_path / "all"), TablesSource)
    report = convert(tmp_path / "all", tmp_path / "data", jobs=1, show_progress=False)
    assert report.counts == {"training": 1, "validation": 1}
    data = ScenarioDataset(tmp_path / "data")
    assert data.manifest.license_note == "CC0-1.0 ODbL"
    assert data.guessed == ("ego", "predict", "size", "z")


COMMONROAD = """<commonRoad benchmarkID="X" commonRoadVersion="2018b" timeStepSize="0.1" tags="urban">
<lanelet id="5"><leftBound>{left}</leftBound><rightBound>{right}</rightBound></lanelet>
<obstacle id="1"><role>dynamic</role><type>car</type>
<shape><rectangle><length>4</length><width>2</width></rectangle></shape>{states}</obstacle>
<planningProblem><initialState><position><point><x>0</x><y>0</y></point></position></initialState></planningProblem>
</commonRoad>"""


def run_script(source, destination):
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, ROOT / "docs" / "commonroad_to_tables.py", source, destination]
    return subprocess.run(command, env=environment, capture_output=True, text=True)


@pytest.mark.parametrize("version", ["2018b", "2020a"])
def test_the_commonroad_script_writes_the_tables(tmp_path, version):
    def points(*places):
        return "".join(f"<point><x>{x}</x><y>{y}</y></point>" for x, y in places)

    def state(tag, step):
        return (
            f"<{tag}><position>{points((10 + step, 0))}</position><orientation><exact>0</exact></orientation>"
            f"<time><exact>{step}</exact></time><velocity><exact>10</exact></velocity></{tag}>"
        )

    states = (
        state("initialState", 0) + "<trajectory>" + "".join(state("state", k) for k in range(1, 95)) + "</trajectory>"
    )
    text = COMMONROAD.format(left=points((0, 2), (150, 2)), right=points((0, -2), (150, -2)), states=states)
    if version == "2020a":
        text = text.replace("2018b", "2020a").replace("<role>dynamic</role>", "").replace("obstacle", "dynamicObstacle")
    (tmp_path / "xml").mkdir()
    (tmp_path / "xml" / "x.xml.gz").write_bytes(gzip.compress(text.encode()))
    assert run_script(tmp_path / "xml", tmp_path / "tables").returncode == 0
    (scenario,) = read(tmp_path / "tables")
    assert scenario.guessed == {"ego", "edges", "predict", "size", "z"}
    features = scenario.map_features
    # the curbs right and left of the lane, without its two ends
    edges = [features.polyline(k) for k in features.find_indices((MapFeatureType.EDGE_BOUNDARY,))]
    assert sorted(float(edge[0, 1]) for edge in edges) == [-2.0, 2.0]
    assert {float(edge[0, 1]): edge[-1, 0] > edge[0, 0] for edge in edges} == {-2.0: True, 2.0: False}


def test_the_commonroad_script_names_a_version_that_it_does_not_read(tmp_path):
    (tmp_path / "x.xml").write_text('<commonRoad benchmarkID="X" commonRoadVersion="2017a"/>')
    done = run_script(tmp_path, tmp_path / "tables")
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.endswith("x.xml: CommonRoad version 2017a, only 2018b and 2020a are read.")


@pytest.mark.official
@pytest.mark.slow
def test_recorded_commonroad_scenarios_convert(shared, tmp_path):
    run_script(shared / "data" / "commonroad_ngsim", tmp_path / "tables")
    report = convert(tmp_path / "tables", tmp_path / "data", split="validation", jobs=1, show_progress=False)
    assert (report.converted, report.skipped) == (14, ())
    data = ScenarioDataset(tmp_path / "data")
    assert data.guessed == ("edges", "ego", "predict", "size", "z")
    assert verify_dataset(tmp_path / "data") == []
    assert all((scenario.tracks.object_type == ObjectType.VEHICLE).all() for scenario in data)


def test_the_scenarionet_script_writes_the_tables(tmp_path):
    def state(x, speed):
        steps = np.arange(91)
        place = np.stack([x + 0.1 * speed * steps, np.zeros(91), np.full(91, 1.0)], 1)
        flat = np.ones((91, 1))
        return {
            "position": place, "heading": np.zeros(91), "velocity": np.tile([speed, 0.0], (91, 1)),
            "valid": np.ones(91, bool), "length": 4.5 * flat, "width": 2 * flat, "height": 1.5 * flat,
        }  # fmt: skip

    line_points = np.array([[-50.0, 0, 0.25], [200, 0, 0.25]])
    scenario = {
        "id": "sn", "metadata": {"sdc_id": "ego", "ts": 0.1 * np.arange(91), "tracks_to_predict": {"12": {}}},
        "tracks": {"ego": {"type": "VEHICLE", "state": state(0, 10)}, "12": {"type": "CYCLIST", "state": state(20, 5)}},
        "map_features": {
            "5": {"type": "LANE_SURFACE_STREET", "polyline": line_points},
            "6": {"type": "ROAD_EDGE_BOUNDARY", "polyline": line_points - [0, 3, 0]},
        },
        "dynamic_map_states": {"5": {"lane": "5", "state": {"object_state": ["TRAFFIC_LIGHT_RED"] * 91}}},
    }  # fmt: skip
    (tmp_path / "sn").mkdir()
    (tmp_path / "sn" / "sd_x_1.pkl").write_bytes(pickle.dumps(scenario))
    command = [sys.executable, ROOT / "docs" / "scenarionet_to_tables.py", tmp_path / "sn", tmp_path / "tables"]
    subprocess.run(command, check=True)
    (found,) = read(tmp_path / "tables")
    assert (found.guessed, found.num_steps, len(found.lights.step)) == (set(), 91, 91)
    assert found.tracks.object_type[found.tracks_to_predict].tolist() == [ObjectType.CYCLIST]
