"""Observations say where things are."""

import numpy as np
import pytest

from rlftsim.envs import EgoEnv
from rlftsim.envs.observations import SHAPES
from scenes import junction_with_light, straight_road


def seen(scenario, steps=0, **settings):
    env = EgoEnv(scenarios=[scenario], traffic="replay", stop_on=(), **settings)
    observation, _ = env.reset(seed=0)
    for _ in range(steps):
        observation = env.step(np.zeros(2, np.float32))[0]
    return observation


def test_neighbors_come_nearest_first_in_the_frame_of_the_ego():
    observation = seen(straight_road())
    assert {name: array.shape for name, array in observation.items()} == SHAPES
    known = observation["neighbors_mask"].astype(bool)
    assert known.sum() == 5
    expected = [(-9.2, 4.6), (12.1, -6.7), (-14.9, -2.3), (17.3, 0.4), (31.7, 3.9)]
    np.testing.assert_allclose(observation["neighbors"][known, :2], expected, atol=1e-3)
    car = observation["neighbors"][3]
    np.testing.assert_allclose(car[2:9], [1, 0, 8.1, 0, 4.6, 1.9, 1], atol=1e-3)
    assert not observation["neighbors"][5:].any()
    # ten steps before, one second: 8.1 m behind where it is now
    np.testing.assert_allclose(observation["neighbors_history"][3, :2], [17.3 - 8.1, 0.4], atol=1e-3)
    np.testing.assert_allclose(observation["ego_history"][0], [-9.3, 0, 1, 0, 9.3], atol=1e-3)


def test_the_ego_knows_its_lane_and_its_route():
    observation = seen(straight_road())
    ego = observation["ego"]
    lane_y = 0.1 + 60.3 * 0.2 / 200.9  # of the lane's middle beside the ego
    np.testing.assert_allclose(ego[[0, 4, 5, 6, 8, 10, 11]], [9.3, 4.6, 1.9, 1, -lane_y, 8.0, 1], atol=5e-3)
    route = observation["route"][observation["route_mask"].astype(bool)]
    assert len(route) == 40
    np.testing.assert_allclose(np.linalg.norm(np.diff(route[:, :2], axis=0), axis=1), 2.0, atol=0.05)
    assert abs(route[-1, 1] - lane_y) < 0.2
    assert observation["goal"][2] == 1
    on_route = observation["lanes"][:, 23][observation["lanes_mask"] > 0]
    assert 0 < on_route.sum() < len(on_route)  # the lane ahead, and not the one that comes toward it


def test_edges_have_the_road_on_their_left_and_lights_their_color():
    observation = seen(junction_with_light())
    x0, y0, x1, y1 = observation["edges"][0]
    assert (x1 - x0) * (0 - y0) - (y1 - y0) * (0 - x0) > 0
    np.testing.assert_allclose(observation["lights"][0], [38.0, 0.2, 1, 0, 0, 1.0], atol=1e-3)
    green = seen(junction_with_light(), steps=41)["lights"][0]
    np.testing.assert_allclose(green[2:], [0, 0, 1, 0.1], atol=1e-3)


@pytest.mark.parametrize("steps", [0, 25])
def test_both_frames_show_the_same_scene(steps):
    own, world = seen(junction_with_light(), steps), seen(junction_with_light(), steps, frame="world")
    np.testing.assert_array_equal(own["lanes_mask"], world["lanes_mask"])
    x, y, cos, sin, _ = world["ego_history"][-1]
    for name, columns in (("neighbors", 2), ("edges", 4), ("route", 2)):
        known = own[f"{name}_mask"].astype(bool)
        points = own[name][known][:, :columns].reshape(-1, 2)
        turned = points @ np.array([[cos, sin], [-sin, cos]]) + [x, y]
        np.testing.assert_allclose(turned, world[name][known][:, :columns].reshape(-1, 2), atol=1e-3)
