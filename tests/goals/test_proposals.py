"""Maneuvers that the lanes allow: found, named, reachable, on the road."""

from dataclasses import replace

import numpy as np
import pytest
from junction import BACK, BESIDE, DOUBLE_LINE, LANE, driving, relative

import scenes
from rlftsim.goals import lane_paths
from rlftsim.goals.lane_paths import Pose, compute_reach, lanes_for, neighbor_lanes, path_through, paths_from
from rlftsim.goals.proposals import CurrentAgent, logged_maneuver, no_proposal_reason, propose_from_lanes
from rlftsim.scenario.lane_graph import lane_graph
from rlftsim.scenario.maneuver import Maneuver, classify_turn
from rlftsim.scenario.types import MapFeatures, ObjectType


def proposed(scenario, track=0, road_test=None):
    """Goals relative to the ego, by maneuver."""
    return {p.maneuver: relative(p.position) for p in propose_from_lanes(scenario, track, road_test)}


# ---- the lane graph ------------------------------------------------------------------------------


def test_lanes_go_on_where_others_begin():
    graph = lane_graph(driving())
    assert graph.successors == ((1, 3, 5), (2,), (), (4,), (), (6,), ())


def test_a_lane_with_many_ways_onward_leaves_room_for_the_others(monkeypatch):
    """Of the own lane's three ways two are looked at, and so is the only one of the lane beside it."""
    monkeypatch.setattr(lane_paths, "AT_MOST_PATHS", 2)
    graph = lane_graph(driving(BESIDE))
    starts = [int(graph.first[lane]) for lane in (0, len(graph) - 1)]
    pose = Pose(graph.points[starts[0]], 0.0)
    lanes = lanes_for(graph, ObjectType.VEHICLE)
    assert len(paths_from(lanes, pose, starts, length_m=120.0, ease_m=15.0)) == 3


def test_geometry_finds_the_successors_that_the_synthetic_logs_list(pack):
    listed = found = 0
    for scenario in pack:
        graph = lane_graph(scenario)
        index = {int(feature): n for n, feature in enumerate(graph.lane_id)}
        for lane, after in scenario.map_features.topology.exit_lanes.tolist():
            listed += 1
            found += index[after] in graph.successors[index[lane]]
    assert listed > 100
    assert found >= 0.99 * listed


def test_geometry_finds_the_neighbors_that_the_synthetic_logs_list(pack):
    listed = found = 0
    for scenario in pack:
        graph, features = lane_graph(scenario), scenario.map_features
        lanes = lanes_for(graph, ObjectType.VEHICLE)
        index = {int(feature): n for n, feature in enumerate(graph.lane_id)}
        for lane, side, beside, start, stop, *_ in features.topology.neighbors.tolist():
            if not lanes.usable[index[beside]] or not lanes.usable[index[lane]]:
                continue  # a bicycle lane
            line = graph.lines[index[lane]]
            middle = min((start + stop) // 2, len(line) - 2)
            x, y = (line[middle + 1] - line[middle])[:2]
            pose = Pose(line[middle], float(np.arctan2(y, x)))
            points = neighbor_lanes(lanes, pose, side=1 if side == 0 else -1)
            listed += 1
            found += index[beside] in graph.owner[points]
    assert listed > 30
    assert found >= 0.97 * listed


# ---- maneuvers -----------------------------------------------------------------------------------


def test_every_maneuver_of_the_junction_is_found_where_a_usual_driver_is_in_time():
    goals = proposed(driving(BESIDE))
    assert set(goals) == {Maneuver.STRAIGHT, Maneuver.LEFT, Maneuver.RIGHT, Maneuver.LANE_CHANGE_LEFT}
    # from 8 m/s with 1.2 m/s2 to the usual 13 m/s of a street: 4.17 s and 43.75 m, then 3.83 s at 13 m/s: 93.6 m
    assert goals[Maneuver.STRAIGHT] == pytest.approx([93, 0], abs=1.0)
    assert goals[Maneuver.LEFT][0] == pytest.approx(32, abs=0.3)
    assert goals[Maneuver.LEFT][1] > 12
    assert goals[Maneuver.RIGHT][0] == pytest.approx(28, abs=0.3)
    assert goals[Maneuver.RIGHT][1] < -8
    assert goals[Maneuver.LANE_CHANGE_LEFT][1] == pytest.approx(3.5, abs=0.2)


def test_u_turns_need_an_opposite_lane_and_no_lane_to_the_left():
    goals = proposed(driving(BACK))
    assert goals[Maneuver.LEFT_UTURN][1] == pytest.approx(14, abs=0.3)
    assert goals[Maneuver.LEFT_UTURN][0] < 20
    assert Maneuver.LEFT_UTURN not in proposed(driving(BACK, BESIDE))
    narrow = (LANE, [(140, 4), (-60, 4)])  # a half circle of 2 m radius
    assert Maneuver.LEFT_UTURN not in proposed(driving(narrow))


def test_a_turn_that_cannot_be_completed_is_not_proposed():
    """At 19 m/s a corner of 8 m radius that is 20 m away cannot be taken."""
    fast = proposed(driving(BESIDE, speed_mps=19.0))
    assert Maneuver.RIGHT not in fast
    assert Maneuver.LEFT not in fast
    assert fast[Maneuver.STRAIGHT][0] > 19 * 8 * 0.8


def test_a_goal_that_ends_in_a_turn_is_pushed_to_its_end():
    """A usual driver from a standstill is 38 m on, the arc of the left turn from 20 m to 38.8 m."""
    goals = proposed(driving(speed_mps=0.0))
    assert goals[Maneuver.LEFT][1] >= 12
    assert goals[Maneuver.STRAIGHT] == pytest.approx([38, 0], abs=1.0)


def test_a_solid_double_line_is_not_crossed():
    assert Maneuver.LANE_CHANGE_LEFT in proposed(driving(BESIDE))
    assert Maneuver.LANE_CHANGE_LEFT not in proposed(driving(BESIDE, DOUBLE_LINE))


def test_what_leaves_the_road_is_not_proposed():
    def only_the_street(way, heading, size):
        return np.abs(relative(way[:, :2])[:, 1]) - 6.0

    assert set(proposed(driving(BESIDE), road_test=only_the_street)) == {Maneuver.STRAIGHT, Maneuver.LANE_CHANGE_LEFT}


def test_a_cyclist_turns_but_does_not_change_lanes():
    goals = proposed(driving(BESIDE, BACK, kind=ObjectType.CYCLIST, speed_mps=4.0))
    assert set(goals) == {Maneuver.STRAIGHT, Maneuver.LEFT, Maneuver.RIGHT}


def test_lanes_in_short_pieces_and_in_circles_end_the_search():
    pieces = [(LANE, [(x, 0), (x + 2, 0)]) for x in range(-10, 200, 2)]
    circle = [(LANE, [(200, 0), (203, 3), (200, 6), (197, 3), (199.5, 0.2)])]
    scenario = scenes.build_scenario("pieces", scenes.TRAFFIC[:1], scenes.polylines([*pieces, *circle, *pieces]))
    assert set(proposed(scenario)) == {Maneuver.STRAIGHT}


@pytest.mark.parametrize(
    ("scenario", "reason"),
    [
        (scenes.without_map(), "no lane within 2.5 m"),
        (driving(y_m=9.0), "no lane within 2.5 m"),
        (driving(heading_rad=3.0), "no lane within 2.5 m runs in its direction of travel"),
        (driving(y_m=-1.9, speed_mps=0.0), "probably parked"),
        (driving(kind=ObjectType.PEDESTRIAN), "a pedestrian does not follow lanes"),
    ],
)
def test_agents_without_proposals_get_the_reason(scenario, reason):
    assert propose_from_lanes(scenario, 0) == ()
    assert reason in (no_proposal_reason(scenario, 0) or "")


def test_broken_lanes_are_survived():
    """A lane of one point, one whose points are all the same, and one with a hole of NaN."""
    whole = driving(BESIDE)
    features = whole.map_features
    odd = np.array([[0, 0, 3], [5, 5, 3], [5, 5, 3], [1000, -200, 3], [np.nan, 0, 3], [1004, -200, 3]], np.float32)
    broken = MapFeatures(
        feature_id=np.append(features.feature_id, [90, 91, 92]),
        feature_type=np.append(features.feature_type, [2, 2, 2]).astype(np.int8),
        points=np.concatenate([features.points, odd]),
        offsets=np.append(features.offsets, features.offsets[-1] + np.array([1, 3, 6])),
    )
    assert Maneuver.STRAIGHT in proposed(replace(whole, map_features=broken))


# ---- how far -------------------------------------------------------------------------------------


def line(length_m, limit_mps=13.0):
    points = np.stack([np.arange(length_m + 1.0), np.zeros(length_m + 1), np.zeros(length_m + 1)], -1)
    return path_through(points, 0.0, np.full(len(points), limit_mps))


def test_reach_on_a_straight_road_is_what_the_formulas_say():
    reach = compute_reach(line(300), 10.0)
    assert reach.min_m == pytest.approx(100 / 8)  # v2 / 2b with b = 4
    # 1.2 m/s2 up to 13: 2.5 s, 28.75 m; then 5.5 s: 71.5 m
    assert reach.usual_m == pytest.approx(100.25, abs=0.3)
    # 2.5 m/s2 up to 1.2 * 13 = 15.6: 2.24 s, 28.67 m; then 5.76 s: 89.86 m
    assert reach.max_m == pytest.approx(118.5, abs=0.5)


def test_a_curve_that_is_taken_too_fast_is_the_end():
    bend = np.radians(np.arange(0, 90, 5.7))
    arc = np.stack([20 + 10 * np.sin(bend), 10 - 10 * np.cos(bend), 0 * bend], -1)
    points = np.concatenate([line(20).points, arc[1:]])
    path = path_through(points, 0.0, np.full(len(points), 30.0))
    assert 15 <= compute_reach(path, 20.0).max_m <= 22
    assert compute_reach(path, 8.0).max_m > 30


@pytest.mark.parametrize(
    ("degrees", "name"),
    [(0, "straight"), (29, "straight"), (31, "left"), (-31, "right"), (134, "left"), (136, "left_uturn"), (-150, None)],
)
def test_paths_are_named_by_their_turn(degrees, name):
    assert classify_turn(np.radians(degrees)) == name


# ---- the log -------------------------------------------------------------------------------------


def test_logged_maneuvers_are_named_as_the_proposals_are():
    def name(**mover):
        found = logged_maneuver(driving(BESIDE, **mover), 0)
        return found and found.maneuver.value

    assert name() == "straight"
    assert name(turn_rate_radps=0.2) == "left"  # 1.6 rad in 8 s
    assert name(turn_rate_radps=-0.2) == "right"
    assert name(turn_rate_radps=0.35) == "left_uturn"
    assert name(speed_mps=0.2) is None
    assert logged_maneuver(driving(), 1) is None  # a pedestrian
    # 8 m/s at 3.1 degrees: 3.5 m to the left after 64 m
    assert name(heading_rad=0.0547) == "lane_change_left"


def test_without_a_future_nothing_is_logged():
    assert logged_maneuver(scenes.without_future(), 0) is None


def test_drivers_stand_on_the_ground():
    driver = CurrentAgent.from_track(driving(), 0)
    assert driver.pose.position[2] == pytest.approx(3.0 - 0.8)  # half of 1.6 m below the box's center
    assert driver.speed_mps == pytest.approx(8.0)
