"""Every part of the planner's score on a scene drawn by hand, with the number that follows from its definition."""

import math
from dataclasses import replace

import numpy as np
import pytest

from rlftsim.envs import EgoEnv
from rlftsim.envs.planner_scores import compute_traffic_realism, missing_scores
from rlftsim.realism import score
from rlftsim.realism.from_rollouts import logged_states
from rlftsim.scenario.types import ObjectType
from scenes import SIZES_M, Mover, build_scenario, junction_map, light, straight_map, without_map, without_road_edges

STEP_S = 0.1


def drive(movers, speeds=None, *, sideways_mps=0.0, map_features=None, steps=80, **scenario):
    """Result of an ego that drives straight ahead at given speeds, while the others do as drawn."""
    log = build_scenario("drawn", movers, map_features, **scenario)
    env = EgoEnv(scenarios=[log], traffic="replay", action="pose", stop_on=(), reward="none", max_steps=steps)
    env.reset(seed=0)
    speeds = np.full(steps, movers[0].speed_mps) if speeds is None else np.maximum(speeds, 0.0)
    for speed in speeds:
        env.step(np.array([speed * STEP_S, sideways_mps * STEP_S, 0.0], np.float32))
    return env.result()


EGO = Mover(speed_mps=9.3)


def test_a_quiet_drive_has_the_full_score():
    result = drive((EGO, Mover(x_m=-30, y_m=3.7, heading_rad=math.pi, speed_mps=8.0)))
    assert result.record.collisions == ()
    assert result.missing == {}
    scores = result.planner
    assert scores.nuplan_style == pytest.approx(1.0)
    assert scores.pdms_style == pytest.approx(1.0)
    assert scores.displacement_error == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize(
    ("movers", "sideways", "kind", "at_fault"),
    [
        ((EGO, Mover(x_m=17.3, speed_mps=2.0)), 0.0, "active_front", True),
        ((EGO, Mover(x_m=30.0, speed_mps=0.0)), 0.0, "stopped_track", True),
        ((Mover(speed_mps=2.0), Mover(x_m=-15.0, speed_mps=9.0)), 0.0, "active_rear", False),
        ((Mover(speed_mps=0.0), Mover(x_m=-15.0, speed_mps=9.0)), 0.0, "stopped_ego", False),
        # a car that drifts into the ego's lane from the left while the ego keeps its lane
        ((EGO, Mover(x_m=-1.5, y_m=4.2, heading_rad=-0.15, speed_mps=9.5)), 0.0, "active_lateral", False),
        # an ego that leaves its lane into a car beside it
        ((EGO, Mover(x_m=-1.5, y_m=3.7, speed_mps=9.3)), 0.8, "active_lateral", True),
    ],
)
def test_a_collision_has_its_type_and_fault(movers, sideways, kind, at_fault):
    result = drive(movers, sideways_mps=sideways, steps=60)
    first = result.record.collisions[0]
    assert (first.collision_type, first.at_fault, first.agent) == (kind, at_fault, 1)
    assert len(result.record.collisions) == 1  # every track counts once
    assert result.planner.no_at_fault_collision == float(not at_fault)
    assert (result.planner.nuplan_style == 0) == at_fault
    assert result.planner.hit_rate == float(not at_fault)
    assert result.traffic.blamed_others_rate == float(not at_fault)


def test_the_speed_change_of_a_collision_is_that_of_both_velocities():
    result = drive((EGO, Mover(x_m=17.3, speed_mps=2.0)))
    assert result.planner.speed_change_mps == pytest.approx(7.3, abs=0.01)
    # contact when the gap of 17.3 - 4.6 m is used up at 7.3 m/s: 1.74 s, so at the 18th step
    assert result.record.collisions[0].step == 18


def test_an_object_costs_half_and_a_pedestrian_all(monkeypatch):
    monkeypatch.setitem(SIZES_M, ObjectType.OTHER, (1.0, 1.0, 1.0))
    standing = Mover(ObjectType.OTHER, x_m=20.0, speed_mps=0.0)
    assert drive((EGO, standing)).planner.no_at_fault_collision == 0.5
    walking = Mover(ObjectType.PEDESTRIAN, x_m=20.0, speed_mps=0.0)
    assert drive((EGO, walking)).planner.no_at_fault_collision == 0.0


@pytest.mark.parametrize(("over_m", "part"), [(-0.1, 1.0), (0.2, 1.0), (0.4, 0.0)])
def test_a_corner_may_be_at_most_a_little_off_the_road(over_m, part):
    edge = -2.3 + 60.7 * 0.2 / 200.9  # height of the right edge of `straight_map` at the ego
    result = drive((Mover(y_m=edge + 0.95 - over_m, speed_mps=0.0),), steps=20)
    assert result.planner.drivable_area == part
    assert result.planner.off_road_m == pytest.approx(max(over_m, 0.0), abs=0.01)


def test_driving_against_the_lane_scores_by_meters_within_a_second():
    for speed, part in ((1.5, 1.0), (4.0, 0.5), (9.3, 0.0)):
        result = drive((Mover(y_m=3.7, speed_mps=speed),), steps=40)
        assert result.planner.driving_direction == part


def test_hard_braking_is_not_comfortable_and_costs_an_eighth():
    time = STEP_S * np.arange(80)
    soft, hard = (np.maximum(9.3 - rate * np.maximum(time - 2.0, 0), 4.0) for rate in (1.0, 6.0))
    comfortable, braking = (drive((EGO,), speeds).planner for speeds in (soft, hard))
    assert (comfortable.comfort, braking.comfort) == (1.0, 0.0)
    # weights 5, 5, 4, 2 of progress, time to collision, speed limit, comfort
    assert braking.nuplan_style == pytest.approx((5 * braking.progress + 5 + 4) / 16)


def test_progress_is_the_fraction_of_the_log_s():
    # 80 steps: the log drives 74.4 m, the planner 40 %, 10 % and nothing
    for share, making in ((0.4, 1.0), (0.1, 0.0), (0.0, 0.0)):
        scores = drive((EGO,), np.full(80, 9.3 * share)).planner
        assert scores.progress == pytest.approx(max(74.4 * share, 2.0) / 74.4, abs=0.01)
        assert scores.making_progress == making


def test_time_to_collision_is_the_time_at_present_speeds():
    # 9.3 m/s behind a car at 5 m/s; bumpers 6 m apart: 1.40 s, and it shrinks until the planner brakes
    lead = Mover(x_m=6.0 + 4.6, speed_mps=5.0)
    kept = np.where(np.arange(40) < 1, 9.3, 5.0)
    assert drive((EGO, lead), kept, steps=40).planner.time_to_collision == 1.0
    late = np.where(np.arange(40) < 9, 9.3, 5.0)
    scores = drive((EGO, lead), late, steps=40).planner
    assert scores.collision_rate == 0.0
    assert 0.4 < scores.least_ttc_s < 0.7  # 6 m less 9 steps of 0.43 m, at 4.3 m/s: 0.5 s
    assert scores.time_to_collision == 0.0


def test_going_over_the_limit_scores_by_the_mean_excess():
    road = straight_map()
    limits = np.zeros(len(road), np.float32)
    limits[0] = 8.3 / 0.44704
    road = replace(road, topology=replace(road.topology, speed_limit_mph=limits))
    scores = drive((EGO,), map_features=road, steps=40).planner
    assert scores.speed_limit == pytest.approx(1 - 1.0 / 2.23, abs=0.01)


def test_a_red_light_that_is_passed_is_counted():
    for red_until, rate in ((91, 1.0), (20, 0.0)):
        result = drive((EGO,), map_features=junction_map(), lights=light(1, 38.0, 0.2, red_until=red_until))
        assert result.planner.red_light_rate == rate


def test_scores_that_a_map_cannot_give_are_left_out_and_named():
    env = EgoEnv(scenarios=[without_road_edges()], traffic="replay", max_steps=10, stop_on=())
    env.reset(seed=0)
    for _ in range(10):
        env.step(np.zeros(2, np.float32))
    result = env.result()
    edges = ("drivable_area", "off_road_m", "others_offroad_rate")
    assert missing_scores(result.record) == dict.fromkeys(edges, "the map has no road edges")
    assert math.isnan(result.planner.drivable_area)
    assert math.isnan(result.planner.off_road_m)
    assert math.isnan(result.traffic.others_offroad_rate)
    assert result.planner.nuplan_style > 0
    empty = EgoEnv(scenarios=[without_map()], traffic="replay")
    empty.reset(seed=0)
    assert math.isnan(empty.result().traffic.others_wrong_way_rate)
    assert "others_wrong_way_rate" in empty.result().missing


def test_others_that_collide_leave_the_road_or_drive_backwards_are_counted():
    parked, into = Mover(x_m=60.0, y_m=0.2, speed_mps=0.0), Mover(x_m=40.0, y_m=0.2, speed_mps=6.0)
    wrong = Mover(x_m=-20.0, y_m=3.7, speed_mps=6.0)
    off = Mover(x_m=20.0, y_m=0.0, heading_rad=-0.3, speed_mps=6.0)
    result = drive((Mover(speed_mps=0.0), parked, into, wrong, off))
    assert result.traffic.others_collision_rate == pytest.approx(2 / 4)
    assert result.traffic.others_offroad_rate == pytest.approx(1 / 4)
    assert result.traffic.others_wrong_way_rate == pytest.approx(1 / 4)


def test_others_are_not_judged_where_their_log_has_no_state():
    # a car with a gap, one that would stand in the way of the next after its last state, one that turns in a gap
    movers = (
        Mover(y_m=3.7, heading_rad=math.pi, speed_mps=1.0),
        Mover(x_m=-20.0, speed_mps=6.0, missing=tuple(range(30, 40))),
        Mover(x_m=30.0, speed_mps=6.0, missing=tuple(range(15, 91))),
        Mover(x_m=10.0, y_m=0.2, speed_mps=6.0),
        Mover(x_m=-40.0, speed_mps=6.0, turn_rate_radps=0.4, missing=tuple(range(18, 40))),
    )
    scores = drive(movers).traffic
    rates = scores.others_collision_rate, scores.others_acceleration_rate, scores.others_steering_rate
    assert rates == (0.0, 0.0, 0.0)


def test_realism_of_the_others_is_the_metric_without_the_ego():
    movers = (EGO, Mover(x_m=20.0, speed_mps=8.0), Mover(x_m=-20, y_m=3.7, heading_rad=math.pi, speed_mps=7.0))
    result = drive(movers, num_predicted=2)
    # a scenario whose ego is another agent has the first one in no evaluated set
    log = replace(
        result.record.scene.scenario,
        ego_index=1,
        tracks_to_predict=np.array([2], np.int32),
        difficulty=np.ones(1, np.int8),
    )
    expected = float(score(log, logged_states(log, num_rollouts=1)).meta_metric)
    assert compute_traffic_realism([result.record]) == pytest.approx(expected, abs=1e-3)
    braking = drive(movers, np.full(80, 1.0), num_predicted=2)
    assert compute_traffic_realism([braking.record]) < compute_traffic_realism([result.record]) + 1e-6
    assert math.isnan(compute_traffic_realism([drive(movers, steps=40, num_predicted=2).record]))
    others_end = replace(result.record.scene.scenario.tracks, valid=result.record.scene.scenario.tracks.valid.copy())
    others_end.valid[1:, 11:] = False
    scene = replace(result.record.scene, scenario=replace(result.record.scene.scenario, tracks=others_end))
    assert math.isnan(compute_traffic_realism([replace(result.record, scene=scene)]))
