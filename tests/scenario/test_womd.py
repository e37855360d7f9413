from pathlib import Path

import numpy as np
import pytest

from rlftsim.errors import DataError
from rlftsim.scenario import womd_pb2
from rlftsim.scenario.types import LightState, MapFeatureType
from rlftsim.scenario.womd import find_tfrecords, read_scenarios, scenario_from_bytes


def parse(message):
    return scenario_from_bytes(message.SerializeToString())


def test_every_value_of_a_hand_built_record_arrives(make_message):
    scenario = parse(make_message())
    assert scenario.scenario_id == "0a1b"
    assert scenario.ego_index == 2
    assert scenario.tracks.object_id.tolist() == [100, 101, 102]
    assert scenario.tracks.object_type.tolist() == [1, 2, 3]
    assert scenario.tracks.position.dtype == np.float32
    # track 1 at step 20: 1000 + 10 + 0.1 * 2 * 20 = 1014
    assert scenario.tracks.position[1, 20].tolist() == [np.float32(1014.0), -200.0, 3.25]
    assert scenario.tracks.size[0, 5].tolist() == [4.5, 2.0, 1.5]
    assert scenario.tracks.velocity[2, 0].tolist() == [3.0, 0.0]
    assert scenario.tracks.valid.all()
    assert scenario.tracks_to_predict.tolist() == [0]
    assert scenario.difficulty.tolist() == [2]
    assert scenario.objects_of_interest.tolist() == [100, 101]
    assert scenario.timestamps_s[30] == 0.1 * 30
    assert scenario.lights.lane_id.tolist() == [7] * 91
    assert scenario.lights.state[0] == LightState.GO
    assert scenario.lights.stop_point[90].tolist() == [1100.0, -200.0, 3.0]


def test_world_coordinates_are_rounded_to_float32(make_message):
    message = make_message()
    message.tracks[0].states[4].center_x = 8312.3593754321
    message.map_features[0].lane.polyline[0].x = 8312.3593754321
    scenario = parse(message)
    assert scenario.tracks.position[0, 4, 0] == np.float32(8312.3593754321)
    assert scenario.map_features.points[0, 0] == np.float32(8312.3593754321)


def test_polygons_keep_what_rounding_takes_from_them(make_message):
    message, exact = make_message(), 8312.3597
    message.map_features[0].lane.polyline[0].x = exact
    message.map_features.add(id=77).crosswalk.polygon.add(x=exact, y=-0.1, z=1.5)
    features = parse(message).map_features
    place = features.feature_id.tolist().index(77)
    assert abs(exact - float(np.float32(exact))) > 1e-4
    np.testing.assert_allclose(features.polygon(place), [[exact, -0.1, 1.5]], rtol=0, atol=1e-10)
    assert (features.polygon_rest[: features.offsets[1]] == 0).all()  # the lane's


def test_every_kind_of_map_feature_gets_its_type_and_points():
    features = [
        (womd_pb2.MapFeature(id=1, lane=womd_pb2.LaneCenter(type=3)), MapFeatureType.LANE_BIKE, "lane.polyline"),
        (
            womd_pb2.MapFeature(id=2, road_line=womd_pb2.RoadLine(type=0)),
            MapFeatureType.LINE_UNKNOWN,
            "road_line.polyline",
        ),
        (
            womd_pb2.MapFeature(id=3, road_line=womd_pb2.RoadLine(type=8)),
            MapFeatureType.LINE_PASSING_DOUBLE_YELLOW,
            "road_line.polyline",
        ),
        (
            womd_pb2.MapFeature(id=4, road_edge=womd_pb2.RoadEdge(type=2)),
            MapFeatureType.EDGE_MEDIAN,
            "road_edge.polyline",
        ),
        (womd_pb2.MapFeature(id=5, crosswalk=womd_pb2.Crosswalk()), MapFeatureType.CROSSWALK, "crosswalk.polygon"),
        (womd_pb2.MapFeature(id=6, speed_bump=womd_pb2.SpeedBump()), MapFeatureType.SPEED_BUMP, "speed_bump.polygon"),
        (womd_pb2.MapFeature(id=7, driveway=womd_pb2.Driveway()), MapFeatureType.DRIVEWAY, "driveway.polygon"),
    ]
    message = womd_pb2.Scenario(scenario_id="a", sdc_track_index=0)
    message.timestamps_seconds.extend(0.1 * step for step in range(11))
    message.tracks.add(id=1).states.extend([womd_pb2.ObjectState(length=4, width=2, height=2, valid=True)] * 11)
    for number, (feature, _, path) in enumerate(features):
        kind, points = path.split(".")
        for j in range(number):
            getattr(getattr(feature, kind), points).add(x=number, y=j, z=-1.0)
        message.map_features.append(feature)
    message.map_features.add(id=8).stop_sign.position.x = 5.0
    message.map_features.add(id=9)  # of a kind that is not known yet
    features_read = parse(message).map_features
    assert features_read.feature_type.tolist() == [kind for _, kind, _ in features] + [MapFeatureType.STOP_SIGN]
    assert np.diff(features_read.offsets).tolist() == [0, 1, 2, 3, 4, 5, 6, 1]
    assert features_read.polyline(3).tolist() == [[3.0, 0.0, -1.0], [3.0, 1.0, -1.0], [3.0, 2.0, -1.0]]
    assert features_read.polyline(7).tolist() == [[5.0, 0.0, 0.0]]


def test_lane_topology_arrives_in_file_order(make_message):
    message = make_message()
    lane = message.map_features[0].lane
    lane.interpolating = True
    lane.entry_lanes.extend([11, 12])
    lane.exit_lanes.append(13)
    lane.right_neighbors.add(
        feature_id=21, self_start_index=1, self_end_index=2, neighbor_start_index=3, neighbor_end_index=4
    )
    lane.left_neighbors.add(feature_id=20, self_start_index=5, self_end_index=6)
    lane.left_boundaries.add(boundary_feature_id=30, lane_start_index=7, lane_end_index=8, boundary_type=6)
    lane.right_boundaries.add(boundary_feature_id=31, lane_end_index=9)
    message.map_features.add(id=40).stop_sign.lane.extend([7, 8])
    topology = parse(message).map_features.topology
    assert topology.entry_lanes.tolist() == [[7, 11], [7, 12]]
    assert topology.exit_lanes.tolist() == [[7, 13]]
    assert topology.neighbors.tolist() == [[7, 0, 20, 5, 6, 0, 0], [7, 1, 21, 1, 2, 3, 4]]
    assert topology.boundaries.tolist() == [[7, 0, 30, 7, 8, 6], [7, 1, 31, 0, 9, 0]]
    assert topology.stop_sign_lanes.tolist() == [[40, 7], [40, 8]]
    assert topology.speed_limit_mph.tolist() == [25.0, 0.0, 0.0]
    assert topology.interpolating.tolist() == [True, False, False]


def test_a_lane_listed_twice_at_a_step_stays_listed_twice(make_message):
    message = make_message()
    message.dynamic_map_states[3].lane_states.add(lane=7, state=4)
    lights = parse(message).lights
    assert lights.state[lights.step == 3].tolist() == [6, 4]


def test_what_a_record_stores_in_invalid_states_is_kept(make_message):
    message = make_message()
    state = message.tracks[0].states[50]
    state.valid, state.center_x, state.heading = False, float("nan"), 99.0
    tracks = parse(message).tracks
    assert np.isnan(tracks.position[0, 50, 0])
    assert tracks.heading[0, 50] == 99.0


def test_map_lights_and_tracks_to_predict_may_be_missing(make_message):
    message = make_message(lights=False, num_tracks=1)
    for field in ("map_features", "tracks_to_predict", "objects_of_interest"):
        message.ClearField(field)
    scenario = parse(message)
    assert len(scenario.map_features) == 0
    assert scenario.map_features.points.shape == (0, 3)
    assert scenario.lights.stop_point.shape == (0, 3)
    assert scenario.tracks_to_predict.shape == (0,)
    assert scenario.evaluated_indices.tolist() == [0]


def test_a_record_of_a_test_split_has_11_steps(make_message):
    scenario = parse(make_message(num_steps=11))
    assert scenario.num_steps == 11
    assert not scenario.has_future


def test_more_than_128_agents_are_read(make_message):
    assert len(parse(make_message(num_tracks=200)).simulated_indices) == 200


def spoil_nan(m):
    m.tracks[1].states[17].center_y = float("nan")


def spoil_infinite(m):
    m.tracks[1].states[17].center_x = 1e300


def spoil_heading(m):
    m.tracks[1].states[17].heading = float("inf")


def spoil_size(m):
    m.tracks[1].states[17].length = float("nan")


def spoil_map(m):
    m.map_features[1].road_edge.polyline[1].z = float("nan")


def spoil_polygon(m):
    polygon = m.map_features.add(id=9).crosswalk.polygon
    for x in (1.0, 2.0, 1e300, float("inf")):
        polygon.add(x=x, y=0.0, z=0.0)


def spoil_ego(m):
    m.sdc_track_index = 3


def spoil_negative_ego(m):
    m.sdc_track_index = -1


def spoil_no_ego(m):
    m.ClearField("sdc_track_index")


def spoil_ego_invalid(m):
    m.tracks[2].states[10].valid = False


def spoil_steps(m):
    del m.tracks[1].states[50:]


def spoil_timestamps(m):
    del m.timestamps_seconds[50:]


def spoil_time_base(m):
    m.timestamps_seconds[:] = [float(step) for step in range(91)]


def spoil_one_time(m):
    m.timestamps_seconds[40:] = [t + 0.1 for t in m.timestamps_seconds[40:]]  # a frame is missing


def spoil_map_ids(m):
    m.map_features[1].id = m.map_features[0].id


def repeat_prediction(m):
    m.tracks_to_predict.add(track_index=0, difficulty=1)


def spoil_prediction(m):
    m.tracks_to_predict[0].track_index = 7


def spoil_current(m):
    m.current_time_index = 50


def spoil_ids(m):
    m.tracks[1].id = 100


def spoil_width(m):
    m.tracks[1].states[10].width = 0


def spoil_tracks(m):
    m.ClearField("tracks")


def spoil_stop_point(m):
    m.dynamic_map_states[2].lane_states[0].stop_point.y = float("inf")


def spoil_lane_far_out(m):
    m.map_features[0].lane.polyline[0].x = 1e30


BAD = [
    (spoil_lane_far_out, r"map point 0 is at \(1e\+30, "),
    (spoil_nan, "track 101 has a NaN or infinite position at step 17"),
    (spoil_infinite, "track 101 has a NaN or infinite position at step 17"),
    (spoil_heading, "track 101 has a NaN or infinite heading at step 17"),
    (spoil_size, "track 101 has a NaN or infinite size at step 17"),
    (spoil_map, r"map feature 8 has a NaN or infinite point \(its point 1\)"),
    (spoil_stop_point, r"stop point \d+ of the traffic lights is NaN or infinite"),
    (spoil_polygon, r"map feature 9 has a NaN or infinite point \(its point 2\)"),
    (spoil_ego, "no ego: sdc_track_index is 3, but there are 3 tracks"),
    (spoil_negative_ego, "no ego: sdc_track_index is -1"),
    (spoil_no_ego, "no ego: sdc_track_index is not set"),
    (spoil_ego_invalid, r"the ego \(track 102\) is not valid at the current step"),
    (spoil_steps, "track 101 has 50 states, track 100 has 91"),
    (spoil_timestamps, "50 timestamps for 91 steps"),
    (spoil_time_base, r"step 1 is 1\.000 s after step 0 instead of 0\.1 s: steps must be 0\.1 s apart"),
    (spoil_one_time, r"step 40 is 4\.100 s after step 0 instead of 4\.0 s"),
    (spoil_map_ids, "map feature id 7 belongs to 2 features"),
    (repeat_prediction, "tracks_to_predict names track index 0 2 times"),
    (spoil_prediction, "track index 7, but there are 3 tracks"),
    (spoil_current, "current_time_index is 50 instead of 10"),
    (spoil_ids, "object id 100 belongs to 2 tracks"),
    (spoil_width, "track 101: width is 0 at the current step"),
    (spoil_tracks, "it has no tracks"),
]


@pytest.mark.parametrize(("spoil", "cause"), BAD, ids=[spoil.__name__[6:] for spoil, _ in BAD])
@pytest.mark.filterwarnings("error")
def test_a_bad_scenario_is_named_and_the_others_survive(tmp_path, make_message, make_tfrecord, spoil, cause):
    bad = make_message("bad")
    spoil(bad)
    path = tmp_path / "x.tfrecord"
    make_tfrecord(path, make_message("a"), bad, make_message("c"))
    with pytest.raises(DataError, match=rf"x\.tfrecord: record 1: .*{cause}"):
        list(read_scenarios(path))
    skipped = []
    scenarios = list(read_scenarios(path, "skip", report=skipped.append))
    assert [scenario.scenario_id for scenario in scenarios] == ["a", "c"]
    assert [(s.file, s.record) for s in skipped] == [(str(path), 1)]


def test_clocks_that_drift_and_jitter_like_those_of_real_logs_are_taken(make_message):
    message = make_message("a")
    times = 3.0 + 0.1002 * np.arange(91) + 0.01 * (-1.0) ** np.arange(91)
    message.timestamps_seconds[:] = times.tolist()
    assert parse(message).timestamps_s.tolist() == times.tolist()


@pytest.mark.parametrize("record", [b"", b"\xff\xff\xff", b"not a message at all", b"\x0a\x10" + bytes(16)])
def test_bytes_of_another_kind_are_refused(record):
    with pytest.raises(DataError, match="not a WOMD Scenario message"):
        scenario_from_bytes(record)


def test_an_id_that_is_no_text_is_refused(make_message):
    with pytest.raises(DataError, match="its scenario_id is b"):
        scenario_from_bytes(make_message().SerializeToString() + b"\x2a\x02\xff\xfe")


def test_twenty_second_scenarios_are_refused_with_the_way_out(make_message):
    with pytest.raises(DataError, match=r"201 steps instead of 91 .*9-second files"):
        parse(make_message(num_steps=201))


def test_skipped_records_go_to_the_log_unless_they_are_collected(tmp_path, make_message, make_tfrecord, caplog):
    make_tfrecord(tmp_path / "x.tfrecord", b"nonsense", make_message())
    assert len(list(read_scenarios(tmp_path / "x.tfrecord", "skip"))) == 1
    assert "x.tfrecord: record 0: not a WOMD Scenario message" in caplog.text


def test_files_are_found_by_folder_and_by_glob(tmp_path, make_message, make_tfrecord):
    names = ["b/validation.tfrecord-00000-of-00001", "a/training.tfrecord-00001-of-00002", "c.tfrecord"]
    for name in names:
        make_tfrecord(tmp_path / name, make_message(Path(name).name))
    (tmp_path / "a" / "training.csv").write_text("not one")
    found = [path.relative_to(tmp_path).as_posix() for path in find_tfrecords(tmp_path)]
    assert found == sorted(names)
    assert [s.scenario_id for s in read_scenarios(tmp_path / "*" / "*.tfrecord-*")] == [
        Path(name).name for name in sorted(names[:2])
    ]
    assert find_tfrecords(tmp_path / "c.tfrecord") == [tmp_path / "c.tfrecord"]


def test_a_source_without_files_is_refused(tmp_path):
    with pytest.raises(DataError, match="no tfrecord file in this folder"):
        find_tfrecords(tmp_path)
    with pytest.raises(DataError, match="no such file or folder"):
        find_tfrecords(tmp_path / "none*")


@pytest.mark.official
def test_a_published_scenario_reads_as_the_official_classes_read_it(shared):
    (scenario,) = read_scenarios(shared / "data/womd/motion_data_one_scenario.tfrecord")
    assert scenario.scenario_id == "637f20cafde22ff8"
    assert scenario.ego_index == 82
    assert scenario.tracks.position.shape == (83, 91, 3)
    assert len(scenario.simulated_indices) == 50
    assert scenario.tracks.object_id[scenario.evaluated_indices].tolist() == [1675, 1676, 2320, 2406]
    assert scenario.tracks_to_predict.tolist() == [72, 43, 42]
    assert scenario.difficulty.tolist() == [1, 1, 2]
    assert scenario.tracks.object_id[3] == 1588
    expected = np.float32([-7782.28662109375, -6674.74609375, -184.35128126])
    assert np.array_equal(scenario.tracks.position[3, 50], expected)
    assert scenario.tracks.heading[3, 50] == np.float32(-1.5750581)
    assert np.array_equal(scenario.tracks.size[3, 50], np.float32([4.13813782, 1.97802699, 1.7034868]))
    assert scenario.tracks.velocity[3, 50].tolist() == [0.009765625, -0.0732421875]
    assert scenario.timestamps_s[[2, 90]].tolist() == [0.20004, 9.00004]
    features, lights = scenario.map_features, scenario.lights
    assert (len(features), len(features.points)) == (301, 19636)
    topology = features.topology
    tables = (
        topology.entry_lanes,
        topology.exit_lanes,
        topology.neighbors,
        topology.boundaries,
        topology.stop_sign_lanes,
    )
    assert [len(table) for table in tables] == [193, 193, 382, 364, 8]
    assert topology.neighbors[topology.neighbors[:, 1] == 0][0].tolist() == [159, 0, 160, 0, 6, 0, 2]
    assert topology.speed_limit_mph.sum() == 6240.0
    assert len(lights.step) == 1092
    assert [(lights.lane_id[k], lights.state[k]) for k in (0, 2, -1)] == [(431, 0), (443, 4), (457, 0)]
    assert np.array_equal(lights.stop_point[-1], np.float32([-7755.70424185, -6699.60130726, -185.73017390]))


@pytest.mark.official
@pytest.mark.parametrize(
    ("name", "tracks", "features", "points", "lights", "ego_x"),
    [
        ("womd_scenario_input", 257, 215, 9257, 0, 6398.7004883513937),
        ("converted/68d5053e5693f4ca", 91, 225, 38287, 0, -291.57107654491188),
        ("converted/bada21415c031740", 15, 177, 11155, 0, -505.939267568025),
        ("converted/db4edc9bd0c9d18c", 81, 102, 5388, 0, 1782.0664723716113),
        ("converted/eb4b91b10ca94ff2", 37, 209, 27598, 637, 8312.359375),
        ("converted/ef3a8f65142f41ac", 62, 157, 10527, 0, -8336.768924409218),
    ],
)
def test_the_other_official_files_have_the_official_counts(shared, name, tracks, features, points, lights, ego_x):
    (scenario,) = read_scenarios(shared / f"data/womd/{name}.tfrecord")
    counts = (len(scenario.tracks.object_id), len(scenario.map_features), len(scenario.map_features.points))
    assert counts == (tracks, features, points)
    assert len(scenario.lights.step) == lights
    assert scenario.tracks.position[scenario.ego_index, 10, 0] == np.float32(ego_x)
