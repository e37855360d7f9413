"""Bridges: what is above or below a road is not on it; slopes and ramps hide nothing."""

import math
from dataclasses import replace

import numpy as np
import pytest

from rlftsim.envs import EgoEnv, EgoVectorEnv
from rlftsim.envs.planner_episode import run_planner
from rlftsim.envs.planners.registry import load_planner, read_action_settings
from rlftsim.envs.result import build_animation
from rlftsim.envs.scene import build_env_scene
from rlftsim.envs.world import Dice, begin, build_world, step_world
from rlftsim.policies.registry import load_policy
from rlftsim.rollout.entries import NoEntries
from rlftsim.rollout.open_world import add_visitors
from rlftsim.scenario.types import CURRENT_STEP, MapFeatureType
from scenes import Mover, build_scenario, junction_map, light, polylines, raised, straight_map

ROAD = slice(len(straight_map()))
CROSSING = slice(len(straight_map()), None)
EGO = Mover(speed_mps=9.3)
BELOW = Mover(x_m=43.4, y_m=0.3, heading_rad=math.pi / 2, speed_mps=0.0)
AHEAD = Mover(x_m=60.0, y_m=0.2, speed_mps=9.3)


def bridge(*movers, up=(0,), road=ROAD, height_m=6.0, **scenario):
    """The ego's road above the one that crosses it, or `road` in its place, and the tracks `up` on it."""
    drawn = build_scenario("bridge", movers, junction_map(), **scenario)
    return raised(drawn, lambda x: np.full_like(x, height_m), road, up)


def ramp(*movers):
    """The ego's road climbs by 6 m over 60 m and crosses the other one at 4.3 m; all tracks are on it."""
    drawn = build_scenario("ramp", movers, junction_map())
    return raised(drawn, lambda x: 6.0 * np.clip(x / 60.0, 0.0, 1.0), ROAD, range(len(movers)))


def driven(name, scenario):
    planner = load_planner(name)
    env = EgoEnv(scenarios=[scenario], action=read_action_settings(planner)["action"], stop_on=(), traffic="replay")
    (((result,), _),) = run_planner(env.source, planner, [scenario], seed=0, rollouts=[0])
    return result


def pushed(scenario, speed=10.0, steps=80, **settings):
    """Environment after an ego has gone straight ahead."""
    env = EgoEnv(scenarios=[scenario], traffic="replay", action="pose", stop_on=(), **settings)
    env.reset(seed=0)
    for _ in range(steps):
        env.step(np.array([speed / 10, 0.0, 0.0], np.float32))
    return env


@pytest.mark.parametrize("height_m", [6.0, 1.9])  # cars are 1.6 m high
@pytest.mark.parametrize(("road", "up"), [(ROAD, (0,)), (CROSSING, (1,))])
def test_a_parked_car_under_or_over_the_road_is_not_met(road, up, height_m):
    result = driven("replay", bridge(EGO, BELOW, road=road, up=up, height_m=height_m))
    assert result.record.collisions == ()
    assert (result.planner.time_to_collision, result.planner.least_ttc_s) == (1.0, 3.0)
    assert result.planner.nuplan_style > 0.8
    assert driven("replay", build_scenario("flat", (EGO, BELOW), junction_map())).planner.at_fault_collision_rate == 1.0


@pytest.mark.parametrize("aside_m", [2.5, -3.0])
@pytest.mark.parametrize("has_lanes", [True, False])
@pytest.mark.parametrize(("height_m", "meets"), [(0.0, True), (1.8, False), (6.0, False)])
def test_a_car_below_is_not_met_where_its_center_is_beside_the_road(aside_m, has_lanes, height_m, meets):
    beside = replace(BELOW, y_m=aside_m)
    no_lanes = polylines([(MapFeatureType.LINE_BROKEN_SINGLE_YELLOW, [(-60.0, 1.8), (140.0, 1.8)])])
    drawn = build_scenario("aside", (EGO, beside), straight_map() if has_lanes else no_lanes)
    result = driven("replay", raised(drawn, lambda x: np.full_like(x, height_m), ROAD, (0,)))
    assert (len(result.record.collisions), result.planner.least_ttc_s < 3.0) == (meets, meets)


class Busy(NoEntries):
    def expect(self, gates):
        return np.full(len(gates), 9.0)


def test_who_enters_is_on_the_level_of_the_lane():
    scenario = add_visitors(bridge(replace(EGO, speed_mps=0.0)))
    world = build_world([scenario], load_policy("demo-base"), rules={"ego": "planner"}, entries=Busy())
    state = begin(world, [Dice(0)])
    for _ in range(30):
        state = step_world(world, state, state.motion[:, 0])
    entered = np.flatnonzero(~state.has_left[-1][0])[1:]
    is_up = np.abs(state.motion[0, entered, 1] - state.motion[0, 0, 1]) < 8.0  # along the ego's road
    assert 0 < is_up.sum() < len(entered)
    ground = state.z[-1][0, entered] - world.height[0, entered] / 2
    np.testing.assert_allclose(ground, np.where(is_up, 9.0, 3.0), atol=0.1)


@pytest.mark.parametrize(("height_m", "meets"), [(1.5, True), (1.65, False), (2.4, False)])
def test_boxes_meet_where_their_heights_overlap(height_m, meets):  # all boxes are 1.6 m high
    result = driven("replay", bridge(EGO, BELOW, height_m=height_m))
    assert (len(result.record.collisions), result.planner.least_ttc_s < 3.0) == (meets, meets)


@pytest.mark.parametrize("name", ["idm", "pdm"])
def test_planners_drive_over_a_roof_just_below(name):
    below = driven(name, bridge(EGO, BELOW, height_m=1.65)).record.agent_motion
    np.testing.assert_array_equal(below, driven(name, bridge(EGO, height_m=1.65)).record.agent_motion)


def test_films_mark_no_overlap_of_cars_above_each_other():
    for scenario, is_marked in (
        (bridge(EGO, BELOW), False),
        (build_scenario("flat", (EGO, BELOW), junction_map()), True),
    ):
        record = driven("replay", scenario).record
        (panel,) = build_animation({"planner": record}).panels
        assert panel.trajectories.collides.any() == is_marked


@pytest.mark.parametrize("name", ["idm", "pdm"])
@pytest.mark.parametrize("lights", [{}, {"lights": light(7, 43.4, 0.3, red_until=91)}])
def test_planners_drive_over_what_is_below(name, lights):
    below = driven(name, bridge(EGO, BELOW, **lights)).record.agent_motion
    np.testing.assert_array_equal(below, driven(name, bridge(EGO)).record.agent_motion)


def test_observations_leave_out_other_levels():
    env = EgoEnv(scenarios=[bridge(EGO, BELOW, AHEAD, up=(0, 2))], traffic="replay")
    observation, _ = env.reset(seed=0)
    assert observation["neighbors"][observation["neighbors_mask"] > 0, 0] == pytest.approx([60.0])
    edges = observation["edges"][observation["edges_mask"] > 0]
    assert len(edges) > 0
    assert not np.any((np.abs(edges[:, 0] - 43.5) < 3.5) & (np.abs(np.abs(edges[:, 1]) - 12.0) < 6.0))


@pytest.mark.parametrize("name", ["idm", "pdm"])
def test_planners_stop_for_a_car_up_the_ramp(name):
    result = driven(name, ramp(EGO, Mover(x_m=28.0, y_m=0.2, speed_mps=0.0)))
    assert result.record.collisions == ()
    gap = result.record.motion[1, -1, 0] - result.record.agent_motion[-1, 0] - 4.6
    assert 0.2 < gap < 4.0


def test_an_ego_climbs_with_its_road_and_meets_what_stands_there():
    # its log stands, so that the lanes alone tell it the height
    env = pushed(ramp(Mover(speed_mps=0.0), Mover(x_m=75.0, y_m=0.2, speed_mps=0.0)))
    record = env.result().record
    np.testing.assert_allclose(record.ground[0, [0, 30, 70]] - 3.0, [0.0, 3.0, 6.0], atol=0.3)
    assert [one.agent for one in record.collisions] == [1]
    assert env.result().planner.least_ttc_s < 0.2


def test_cars_meet_on_a_steep_road_without_levels():
    drawn = build_scenario("hill", (Mover(speed_mps=0.0), Mover(x_m=60.0, y_m=0.2, speed_mps=0.0)))
    hill = raised(drawn, lambda x: 0.2 * x, ROAD, (0, 1))
    assert build_env_scene(hill, 91).levels is None
    assert len(pushed(hill).result().record.collisions) == 1


@pytest.mark.parametrize(("up", "passes"), [((0, 1), True), ((0, 1, 2), False)])
def test_idm_traffic_stops_for_cars_on_its_own_road_alone(up, passes):
    far = Mover(x_m=-50.0, y_m=0.0, speed_mps=0.0)
    world = build_world([bridge(far, EGO, BELOW, up=up)], None, rules={"ego": "planner", "vehicles": "idm"})
    state = begin(world, [Dice(0)])
    for _ in range(80):
        state = step_world(world, state, world.logged[0, :1, CURRENT_STEP])
    assert (state.motion[0, 1, 0] > state.motion[0, 2, 0]) == passes


def test_others_above_each_other_do_not_collide():
    far = Mover(x_m=-40.0, y_m=0.0, speed_mps=0.0)
    crossing = Mover(x_m=43.4, y_m=-30.0, heading_rad=math.pi / 2, speed_mps=7.0)
    for up, rate in (((0, 1), 0.0), ((0, 1, 2), 1.0)):
        assert driven("replay", bridge(far, EGO, crossing, up=up)).traffic.others_collision_rate == rate


def test_a_lane_below_says_nothing_about_the_direction_above():
    kind = MapFeatureType.LANE_SURFACE_STREET
    stacked = polylines([(kind, [(140.0, 0.1), (-60.0, 0.1)]), (kind, [(-60.0, 0.0), (140.0, 0.0)])])
    for up, direction in (((), 1.0), ((0,), 0.0)):
        log = raised(build_scenario("stacked", (EGO,), stacked), lambda x: np.full_like(x, 6.0), slice(len(up)), up)
        assert driven("replay", log).planner.driving_direction == direction


def test_heights_are_those_of_each_scene_in_a_vector():
    scenarios = [bridge(EGO, BELOW), build_scenario("flat", (EGO, BELOW), junction_map())]
    settings = {"traffic": "replay", "action": "pose", "stop_on": ()}
    vector = EgoVectorEnv(2, scenarios=scenarios, **settings)
    singles = [EgoEnv(scenarios=scenarios, **settings) for _ in scenarios]
    vector.reset(seed=1)
    for slot, env in enumerate(singles):
        env.reset(seed=1 + slot)
    assert {env.episode.world.scenes[0].scenario.scenario_id for env in singles} == {"bridge", "flat"}
    forward = np.array([0.93, 0.0, 0.0], np.float32)
    for _ in range(60):
        together, rewards, *_ = vector.step(np.tile(forward, (2, 1)))
        for slot, env in enumerate(singles):
            alone, reward, *_ = env.step(forward)
            assert rewards[slot] == reward
            for name, values in alone.items():
                np.testing.assert_array_equal(together[name][slot], values)
