"""Argoverse 2: the real sample against numbers measured elsewhere, and files of its shape made from other scenarios."""

import copy
import json
import re

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
import shapely
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import scenes
from av2_files import clipped_edges, crop_box, left_of_nearest, map_archive, track_rows, write_av2
from rlftsim.cli.main import main
from rlftsim.errors import ConfigError, DataError
from rlftsim.jobs.runner import Inline, Joining, Share, Unfinished
from rlftsim.realism import metric_by_name, scenario_log, score
from rlftsim.realism.from_rollouts import logged_states
from rlftsim.scenario import av2_map
from rlftsim.scenario.av2 import Av2Source, find_files, read_scenario
from rlftsim.scenario.av2_map import find_cuts, read_map
from rlftsim.scenario.convert import convert
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.inspect import verify_dataset
from rlftsim.scenario.synthetic import pack_path
from rlftsim.scenario.types import (
    CURRENT_STEP,
    LANE_TYPES,
    MEDIAN_SIZE_M,
    ROAD_EDGE_TYPES,
    MapFeatureType,
    ObjectType,
)

SAMPLE = "0a1e6f0a-1817-4a98-b02e-db8c9327d151"


def write_small(folder, name, movers=scenes.TRAFFIC, **settings):
    """A recording of a straight road, whose edges reach beyond a crop of this size."""
    return write_av2(folder, scenes.build_scenario(name, movers), name=name, **settings)


def read_one(folder, **settings):
    (found,) = read_scenario(find_files(folder)[0], Av2Source(**settings))
    return found


@pytest.fixture(scope="module")
def sample(shared):
    """Folder of the one real scenario."""
    return shared / "data" / "av2"


@pytest.fixture(scope="module")
def pack():
    return ScenarioDataset(pack_path(), "validation")


@pytest.fixture
def files(tmp_path):
    """Two small recordings of different folders of a split."""
    for name in ("aa01", "ab02"):
        write_small(tmp_path / "av2" / "val", name)
    return tmp_path / "av2"


# --- the real sample ----------------------------------------------------------------------------------------------


@pytest.mark.official
@pytest.mark.parametrize(("window", "simulated", "expected"), [("first", 19, 0.840), ("last", 17, 0.899)])
@pytest.mark.parametrize("with_cuts", [False, True])
def test_the_log_of_the_sample_scores_as_measured(sample, window, simulated, expected, with_cuts, monkeypatch):
    if with_cuts:  # as if the map were not cut out of the city's
        monkeypatch.setattr(av2_map, "find_cuts", lambda ring: np.zeros(len(ring) - 1, bool))
    scenario, num_left_out = read_one(sample, window=window)
    assert (len(scenario.simulated_indices), len(scenario.evaluated_indices), num_left_out) == (simulated, 3, 0)
    result = score(scenario_log(scenario), logged_states(scenario, num_rollouts=32), metric_by_name("2025"))
    assert float(result.meta_metric) == pytest.approx(expected, abs=0.002)
    # one of three: 139344, whose guessed width reaches over the border
    for rate in ("collision_rate", "offroad_rate"):
        assert float(result.find_score(rate)) == pytest.approx(1 / 3, abs=1e-6)
    if window == "last":
        parts = [float(result.find_score(name)) for name in ("kinematic", "interactive", "map_based")]
        assert parts == pytest.approx([0.617, 0.947, 1.0], abs=0.001)


@pytest.mark.official
def test_the_tracks_of_the_sample_are_counted(sample):
    table = pq.read_table(find_files(sample)[0])
    assert (table.num_rows, pc.count_distinct(table["track_id"]).as_py()) == (2434, 58)
    scenario, _ = read_one(sample, window="av2", keep_other=True)
    assert len(scenario.simulated_indices) == 25
    assert scenario.num_steps == 71
    assert not scenario.has_future
    scenario, _ = read_one(sample)
    tracks, ego = scenario.tracks, scenario.ego_index
    assert tracks.object_id[ego] == 0  # no other track has this id
    assert tracks.size[ego, CURRENT_STEP].tolist() == pytest.approx([4.87, 1.85, 1.48])
    assert tracks.object_id[scenario.tracks_to_predict].tolist() == [138951, 139344]
    assert scenario.objects_of_interest.tolist() == [138951]
    assert (scenario.source, scenario.guessed) == ("av2", {"size", "z"})
    assert not len(scenario.lights.step)
    # boxes stand on the ground, which lies at 22 to 25 m here
    bottom = (tracks.position[..., 2] - tracks.size[..., 2] / 2)[tracks.valid]
    assert (bottom.min() > 21.8, bottom.max() < 25.2) == (True, True)
    # float32 keeps a millimeter in the frame of the city
    columns = table.to_pydict()
    row = next(k for k in range(table.num_rows) if columns["track_id"][k] == "AV" and columns["timestep"][k] == 29)
    logged = [columns["position_x"][row], columns["position_y"][row]]
    assert tracks.position[ego, CURRENT_STEP, :2].tolist() == pytest.approx(logged, abs=1e-3)


@pytest.mark.official
def test_the_map_of_the_sample_is_counted(sample):
    path = next(sample.glob("*.json"))
    archive = json.loads(path.read_text())
    features, ground = read_map(path)
    kinds = features.feature_type
    assert (kinds == MapFeatureType.LANE_BIKE).sum() == 37
    assert len(features.find_indices(LANE_TYPES)) == 71
    assert features.topology.interpolating.sum() == 32
    lanes = archive["lane_segments"].values()
    sides = [
        (lane[f"{side}_lane_boundary"], lane[f"{side}_lane_mark_type"]) for lane in lanes for side in ("left", "right")
    ]
    assert (len(sides), sum(mark == "NONE" for _, mark in sides)) == (142, 92)
    shapes = {}
    for line, mark in sides:
        points = tuple((p["x"], p["y"]) for p in line)
        shapes.setdefault(min(points, points[::-1]), set()).add(mark)
    assert (len(shapes), max(map(len, shapes.values()))) == (121, 1)
    painted = sum(marks != {"NONE"} for marks in shapes.values())
    assert painted == np.isin(kinds, range(6, 14)).sum()
    assert len(features.topology.boundaries) == 50
    # links that lead out of the file are dropped
    assert sum(str(other) not in archive["lane_segments"] for lane in lanes for other in lane["successors"]) == 8
    assert len(features.topology.exit_lanes) == sum(len(lane["successors"]) for lane in lanes) - 8
    # a trap: the center lines of the file lie at height 0
    assert {point["z"] for lane in lanes for point in lane["centerline"]} == {0.0}
    assert features.points[:, 2].min() > 21.8
    # six pieces of the outline are the border of the crop
    assert len(ground.cuts.geoms) == 6
    assert ground.cuts.length == pytest.approx(61, abs=0.5)
    assert ground.cuts.length + ground.walls.length == pytest.approx(1013, abs=1)


@pytest.mark.official
def test_guessed_sizes_show_at_curbs_and_vehicles_leave_through_the_cuts(sample):
    scenario, _ = read_one(sample, window="first")
    _, ground = read_map(next(sample.glob("*.json")))
    tracks = scenario.tracks
    beyond, over = {}, {}
    for track in np.flatnonzero(tracks.object_type == ObjectType.VEHICLE):
        valid = tracks.valid[track]
        path, heading = tracks.position[track, valid, :2].astype(float), tracks.heading[track, valid].astype(float)
        corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * tracks.size[track, valid][0, :2] / 2
        turn = np.stack([np.cos(heading), -np.sin(heading), np.sin(heading), np.cos(heading)], -1).reshape(-1, 2, 2)
        places = path[:, None] + np.einsum("tij,cj->tci", turn, corners)
        outside = float(shapely.distance(ground.area, shapely.points(places)).max())
        (beyond if ground.leaves_through_cut(path) else over)[int(tracks.object_id[track])] = outside
    assert max(beyond.values()) == pytest.approx(44, abs=1)
    near_curb = {k: v for k, v in over.items() if 0.1 < v < 1.0}
    assert min(near_curb.values()) == pytest.approx(0.16, abs=0.02)
    assert max(near_curb.values()) == pytest.approx(0.67, abs=0.02)
    assert near_curb[139344] == pytest.approx(0.34, abs=0.02)


@pytest.mark.official
def test_guessed_sizes_are_the_medians_of_womd(shared):
    sizes = {kind: [] for kind in MEDIAN_SIZE_M}
    for path in (shared / "data" / "womd_npz" / "scenarios").glob("*.npz"):
        with np.load(path) as scenario:
            kinds, found = scenario["agent_type"], scenario["agent_size"]
        for kind, values in sizes.items():
            values.append(found[kinds == kind])
    merged = {kind: np.concatenate(values) for kind, values in sizes.items()}
    assert [len(values) for values in merged.values()] == [18_631, 2_288, 127]
    for kind, values in merged.items():
        assert np.median(values, axis=0).tolist() == pytest.approx(MEDIAN_SIZE_M[kind], abs=0.006)
    low, high = np.percentile(merged[ObjectType.VEHICLE], [5, 95], axis=0)
    assert [*low[:2], *high[:2]] == pytest.approx([4.25, 1.93, 5.70, 2.40], abs=0.006)


@pytest.mark.official
def test_the_sample_fits_into_sixty_kilobytes(sample, tmp_path):
    report = convert(sample, tmp_path / "data", split="validation", jobs=1, show_progress=False)
    assert report.converted == 1
    assert sum(shard.stat().st_size for shard in (tmp_path / "data").rglob("*.arrow")) < 60_000
    assert verify_dataset(tmp_path / "data") == []
    assert "CC BY-NC-SA 4.0" in ScenarioDataset(tmp_path / "data").manifest.license_note


# --- files of its shape -------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_synthetic_scenarios_come_back_from_files_of_this_shape(pack, tmp_path):
    rng, right, num_places, on_side, num_sides = np.random.default_rng(0), 0, 0, 0, 0
    for scenario in pack:
        place = write_av2(tmp_path, scenario)
        found, _ = read_one(place)
        # 1. Tracks.
        assert found.scenario_id == scenario.scenario_id
        rows = {int(object_id): k for k, object_id in enumerate(found.tracks.object_id)}
        for track, object_id in enumerate(scenario.tracks.object_id):
            valid = scenario.tracks.valid[track]
            if scenario.tracks.object_type[track] not in (1, 2, 3) or not valid.any():
                continue
            own = rows[0 if track == scenario.ego_index else int(object_id)]
            assert (found.tracks.valid[own] == valid).all()
            off = found.tracks.position[own, valid, :2] - scenario.tracks.position[track, valid, :2]
            turned = found.tracks.heading[own, valid] - scenario.tracks.heading[track, valid]
            assert np.abs(off).max() <= 1e-3
            assert np.abs(np.remainder(turned + np.pi, 2 * np.pi) - np.pi).max() <= 1e-4
        # 2. Links between lanes.
        topology, theirs = found.map_features.topology, scenario.map_features.topology
        for name in ("entry_lanes", "exit_lanes"):
            assert sorted(map(tuple, getattr(topology, name))) == sorted(map(tuple, getattr(theirs, name)))
        first = {(lane, side): (lane, side, other) for lane, side, other, *_ in theirs.neighbors[::-1]}
        assert {tuple(row[:3]) for row in topology.neighbors.tolist()} == set(first.values())
        # 3. The ground: random places are on the same side, and the road is left of every edge.
        _, ground = read_map(next(place.glob("*.json")))
        edges = [
            found.map_features.polyline(k)[:, :2].astype(float)
            for k in found.map_features.find_indices(ROAD_EDGE_TYPES)
        ]
        x0, y0, x1, y1 = crop_box(scenario).bounds
        places = rng.uniform((x0, y0), (x1, y1), (250, 2))  # 10 000 in all
        right += (left_of_nearest(places, edges) == left_of_nearest(places, clipped_edges(scenario))).sum()
        num_places += len(places)
        middle = np.concatenate([(edge[1:] + edge[:-1]) / 2 for edge in edges])
        along = np.concatenate([np.diff(edge, axis=0) for edge in edges])
        long = np.linalg.norm(along, axis=1) > 0.2
        normal = np.stack([-along[:, 1], along[:, 0]], 1)[long] / np.linalg.norm(along[long], axis=1)[:, None]
        kept = shapely.contains_xy(crop_box(scenario).buffer(-1.5), *middle[long].T)
        left, other = middle[long][kept] + normal[kept], middle[long][kept] - normal[kept]
        on_side += ground.covers(left).sum() + (~ground.covers(other)).sum()
        num_sides += 2 * len(left)
    assert num_places == 10_000
    assert right / num_places >= 0.999
    assert on_side / num_sides >= 0.99


def test_a_conversion_has_splits_tallies_and_what_is_guessed(files, tmp_path):
    report = convert(files, tmp_path / "data", jobs=1, show_progress=False)
    assert report.counts == {"validation": 2}
    data = ScenarioDataset(tmp_path / "data", "validation")
    assert (data.scenario_ids, data.sources, data.guessed) == (["aa01", "ab02"], ("av2",), ("size", "z"))
    assert data["aa01"].guessed == {"size", "z"}
    assert data.manifest.provenance["av2"]["window"] == "last"


@pytest.mark.parametrize("window", ["first", "both"])
def test_another_window_converts_again(files, tmp_path, window):
    convert(files, tmp_path / "data", jobs=1, show_progress=False)
    report = convert(files, tmp_path / "data", jobs=1, show_progress=False, options={"window": window})
    assert report.shards_written == 2
    ids = ["aa01", "ab02"] if window == "first" else ["aa01-0", "aa01-19", "ab02-0", "ab02-19"]
    assert ScenarioDataset(tmp_path / "data").scenario_ids == ids


def test_shares_with_other_options_are_refused_with_both_values(files, tmp_path):
    def share(number, window):
        runner = Joining() if number is None else Share(number, 2, Inline())
        convert(files, tmp_path / "data", runner=runner, show_progress=False, options={"window": window})

    with pytest.raises(Unfinished, match="share 1/2 is done"):
        share(1, "last")
    refusal = (
        r'aa\.arrow was converted with other options \(window "last" there, "first" here\): give all shares the sam'
    )
    for number in (2, None):
        with pytest.raises(ConfigError, match=refusal):
            share(number, "first")
    assert not list(tmp_path.rglob("ab.arrow"))
    share(2, "last")
    # of the finished data set, too
    with pytest.raises(ConfigError, match=refusal):
        share(2, "first")
    assert ScenarioDataset(tmp_path / "data").scenario_ids == ["aa01", "ab02"]


@pytest.mark.slow
def test_resumed_and_parallel_conversions_give_the_same_bytes(files, tmp_path):
    def contents(folder):
        return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}

    convert(files, tmp_path / "one", jobs=1, show_progress=False)
    convert(files, tmp_path / "two", jobs=2, show_progress=False)
    # interrupted before the first of two shards was written
    (tmp_path / "two" / "INCOMPLETE").touch()
    next((tmp_path / "two").rglob("aa.arrow")).unlink()
    assert convert(files, tmp_path / "two", jobs=1, show_progress=False).shards_reused == 1
    assert contents(tmp_path / "one") == contents(tmp_path / "two")


def test_a_test_split_has_its_history_only(tmp_path):
    write_small(tmp_path / "test", "cc", num_steps=50)
    report = convert(tmp_path / "test", tmp_path / "data", jobs=1, show_progress=False)
    assert report.counts == {"testing": 1}
    assert ScenarioDataset(tmp_path / "data")["cc"].num_steps == 11


def test_a_file_of_sizes_replaces_guesses(tmp_path):
    place = write_small(tmp_path, "aa")
    (tmp_path / "sizes.json").write_text('{"vehicle": [5.0, 2.2, 1.5]}')
    scenario, _ = read_one(place, sizes=tmp_path / "sizes.json")
    assert scenario.tracks.size[1, CURRENT_STEP].tolist() == pytest.approx([5.0, 2.2, 1.5])
    for text, cause in (
        ("[]", "are written like"),
        ('{"tram": [1, 1, 1]}', "no kind 'tram'"),
        ('{"bus": [1, 0, 1]}', "size of bus"),
    ):
        (tmp_path / "sizes.json").write_text(text)
        with pytest.raises(ConfigError, match=cause):
            Av2Source(sizes=tmp_path / "sizes.json")
    with pytest.raises(ConfigError, match="data source 'womd' has no option 'window': it takes none"):
        convert(tmp_path, tmp_path / "data", reader="womd", options={"window": "last"})


def test_pieces_along_the_grid_are_cuts_and_short_ones_are_not():
    ring = np.array([[-10, 10], [30, 10], [30, 12], [30, 25], [20, 30.0], [19.5, 30.0], [-10, 28], [-10, 10]])
    assert find_cuts(ring).tolist() == [False, True, True, False, False, False, False]
    assert find_cuts(ring + np.array([0, 0.02])).tolist() == find_cuts(ring).tolist()
    assert not find_cuts(ring + np.array([0.02, 0])).any()
    # a piece that begins before the ring's first point
    assert find_cuts(np.concatenate([ring[2:], ring[1:3]])).tolist() == [True, False, False, False, False, False, True]


def test_a_track_that_leaves_through_a_cut_is_not_evaluated(tmp_path):
    # The map ends 50 m ahead of the ego and 40 m behind it: the two cars in motion drive on. The pedestrian is beside
    # the road from the beginning, which is no fault of the map.
    scenario = scenes.build_scenario("cut", num_predicted=5)
    place = write_av2(tmp_path / "val", scenario, name="aa")
    found, num_left_out = read_one(place)
    assert num_left_out == 2
    assert found.tracks.object_id[found.tracks_to_predict].tolist() == scenario.tracks.object_id[3:6].tolist()
    report = convert(tmp_path / "val", tmp_path / "data", jobs=1, show_progress=False)
    assert list(report.tallies.values()) == [2]
    assert convert(tmp_path / "val", tmp_path / "data", jobs=1, show_progress=False).tallies == report.tallies


# --- bad files ----------------------------------------------------------------------------------------------------


def edit_rows(place, change):
    path = next(place.glob("*.parquet"))
    pq.write_table(pa.Table.from_pylist(change(pq.read_table(path).to_pylist())), path)


def edit_each(place, **values):
    """Set columns of all rows; None drops one."""
    edit_rows(place, lambda rows: [{k: v for k, v in (row | values).items() if v is not None} for row in rows])


def edit_map(place, change):
    path = next(place.glob("*.json"))
    archive = json.loads(path.read_text())
    change(archive, next(iter(archive["lane_segments"].values())))
    path.write_text(json.dumps(archive))


BAD = {
    "no map": (lambda p: next(p.glob("*.json")).unlink(), "there is no log_map_archive_aa.json beside it"),
    "no ego": (lambda p: edit_rows(p, lambda r: [x for x in r if x["track_id"] != "AV"]), "no track AV"),
    "109 steps": (lambda p: edit_rows(p, lambda r: [x for x in r if x["timestep"] < 109]), "has 109 steps instead"),
    "NaN": (lambda p: edit_rows(p, lambda r: [{**r[0], "heading": float("nan")}, *r[1:]]), "row 0: .* NaN"),
    "twice": (lambda p: edit_rows(p, lambda r: [r[0], *r]), "has two rows for timestep"),
    "column": (lambda p: edit_each(p, lidar=1), "the unknown column lidar"),
    "no column": (lambda p: edit_each(p, heading=None), "no column heading"),
    "kind": (lambda p: edit_each(p, object_type="tram"), "unknown object_type 'tram'"),
    "mark": (lambda p: edit_map(p, lambda a, lane: lane.update(left_lane_mark_type="PINK")), "lane mark 'PINK'"),
    "lane": (lambda p: edit_map(p, lambda a, lane: lane.update(lane_type="RAIL")), "unknown lane type 'RAIL'"),
    "part": (lambda p: edit_map(p, lambda a, lane: a.pop("drivable_areas")), "has no drivable_areas"),
    "text": (lambda p: next(p.glob("*.json")).write_text("{"), "not JSON, line 1"),
    "time": (lambda p: edit_each(p, end_timestamp=3e17 + 1.2e10), "110 steps last 12"),
}  # fmt: skip


@pytest.mark.parametrize("kind", BAD)
def test_bad_files_are_left_out_with_their_cause(tmp_path, kind, capsys):
    spoil, cause = BAD[kind]
    place = write_small(tmp_path / "val", "aa", scenes.TRAFFIC[:2])
    write_small(tmp_path / "val", "ab", scenes.TRAFFIC[:2])
    spoil(place)
    report = convert(tmp_path / "val", tmp_path / "data", reader="av2", jobs=1, show_progress=False)
    assert report.converted == 1
    assert re.search(cause, str(report.skipped[0]))
    with pytest.raises(DataError, match=cause):
        convert(tmp_path / "val", tmp_path / "other", reader="av2", on_error="stop", jobs=1, show_progress=False)


def test_the_command_stops_with_an_exit_code(tmp_path, capsys):
    place = write_small(tmp_path / "val", "aa")
    next(place.glob("*.json")).unlink()
    line = ["convert", str(tmp_path / "val"), str(tmp_path / "data"), "--from", "av2", "--jobs", "1"]
    assert main([*line, "--on-error", "stop"]) == 1
    assert "no log_map_archive_aa.json" in capsys.readouterr().err


JUNK = st.one_of(
    st.none(), st.booleans(), st.integers(-(10**30), 10**30), st.floats(), st.text(max_size=4), st.just([]), st.just({})
)


@pytest.fixture(scope="module")
def small_files(tmp_path_factory):
    scenario = scenes.lone_agent()
    place = write_av2(tmp_path_factory.mktemp("small"), scenario, name="aa")
    return place, map_archive(scenario), track_rows(scenario, "aa")


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_files_never_end_in_a_traceback(small_files, data):
    """Any value of either file replaced by anything else: a scenario or a `DataError`."""
    place, archive, rows = small_files
    archive, rows = copy.deepcopy(archive), [dict(row) for row in rows]
    if data.draw(st.booleans()):
        value, path = archive, []
        while isinstance(value, dict | list) and value and (len(path) < 2 or data.draw(st.integers(0, 3))):
            keys = list(value) if isinstance(value, dict) else list(range(len(value)))
            path.append((value, data.draw(st.sampled_from(keys))))
            value = path[-1][0][path[-1][1]]
        holder, key = path[-1]
        holder[key] = data.draw(JUNK)
    else:
        name, junk = data.draw(st.sampled_from(list(rows[0]))), data.draw(JUNK)
        chosen = rows if data.draw(st.booleans()) else [data.draw(st.sampled_from(rows))]
        for row in chosen:
            row[name] = junk
    (place / "log_map_archive_aa.json").write_text(json.dumps(archive))
    try:
        pq.write_table(pa.Table.from_pylist(rows), place / "scenario_aa.parquet")
    except (pa.ArrowException, OverflowError, ValueError, TypeError):
        return  # no such file can be written
    try:
        scenario, _ = read_one(place)
    except DataError:
        return
    scenario.check_finite_arrays()
