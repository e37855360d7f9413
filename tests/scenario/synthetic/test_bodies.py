"""Bodies dragged behind bumpers, lane changes, noise; all inputs drawn by hand."""

import numpy as np
import pytest

from rlftsim.scenario.synthetic.bodies import (
    BumperPath,
    add_label_noise,
    build_pedestrian,
    build_vehicle,
    drag_rear_axle,
    lane_change_offset,
    smooth_over_time,
    smoother_step,
)
from rlftsim.scenario.types import ObjectType

CAR = (4.6, 2.0, 1.6)


def straight_path(num_steps: int, speed_mps: float) -> BumperPath:
    """Along +x at constant speed."""
    x = np.arange(num_steps) * 0.1 * speed_mps
    center = np.stack([x, np.zeros(num_steps)], axis=1)
    return BumperPath(0, center, np.tile([1.0, 0.0], (num_steps, 1)), np.full(num_steps, speed_mps))


def test_body_on_a_straight_lane_is_half_a_length_behind_its_bumper():
    body = build_vehicle(straight_path(50, 10.0), ObjectType.VEHICLE, CAR)
    np.testing.assert_allclose(body.heading, 0.0, atol=1e-9)
    # In the middle, where smoothing over time does not reach the ends: bumper at 25 m, center 2.3 m behind it.
    np.testing.assert_allclose(body.position[25], [25.0 - 2.3, 0.0], atol=1e-6)
    np.testing.assert_allclose(body.velocity[25], [10.0, 0.0], atol=1e-6)


def test_standing_car_does_not_turn():
    bumper = np.tile([3.0, 4.0], (20, 1))
    np.testing.assert_allclose(drag_rear_axle(bumper, 4.6, np.array([0.0, 1.0])), np.pi / 2)


def test_heading_in_a_curve_lags_behind_the_bumper():
    # A bumper on a circle of radius R drags an axle a = 0.78 * 4.6 m behind it on a circle of radius sqrt(R^2 - a^2);
    # the body then points asin(a / R) outwards of the bumper's direction of motion, that is, it lags by this angle.
    radius, reach = 12.0, 0.78 * 4.6
    angle = np.linspace(0, 2 * np.pi, 4000)
    bumper = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    heading = drag_rear_axle(bumper, 4.6, np.array([0.0, 1.0]))
    tangent = angle + np.pi / 2
    assert heading[-1] == pytest.approx(tangent[-1] - np.arcsin(reach / radius), abs=0.01)


def test_smoother_step_rises_from_zero_to_one():
    np.testing.assert_allclose(smoother_step(np.array([-1.0, 0.0, 0.5, 1.0, 2.0])), [0.0, 0.0, 0.5, 1.0, 1.0])


def test_smoothing_keeps_straight_motion_and_standstill():
    line = np.stack([np.arange(60.0), np.full(60, 3.0)], axis=1)
    smooth = smooth_over_time(line, 0.2)
    np.testing.assert_allclose(smooth[10:-10], line[10:-10], atol=1e-9)
    np.testing.assert_allclose(smooth[:, 1], 3.0)


def test_lane_change_offset_removes_the_jump_between_lanes():
    # 10 m/s, so the change takes 30 m, from 15 m before to 15 m after step 50; the new lane is 3.5 m to the left.
    driven, speed = np.arange(100.0), np.full(100, 10.0)
    offset = lane_change_offset(driven, speed, 50, 3.5)
    lateral = offset + 3.5 * (np.arange(100) >= 50)
    assert lateral[34] == 0.0
    assert lateral[50] == pytest.approx(1.75)
    assert lateral[66] == pytest.approx(3.5)
    assert np.all(np.diff(lateral) >= 0.0)
    assert np.diff(lateral).max() < 0.25  # nowhere steeper than 3.5 m / 30 m * 1.875


def test_car_that_stops_within_a_lane_change_stands_still():
    speed = np.concatenate([np.full(20, 5.0), np.zeros(30)])
    driven = np.cumsum(speed) * 0.1
    offset = lane_change_offset(driven, speed, 18, 3.5)
    np.testing.assert_allclose(np.diff(offset[20:]), 0.0)


def test_pedestrian_keeps_the_heading_while_standing():
    y = np.concatenate([np.arange(40) * 0.12, np.full(40, 39 * 0.12)])
    body = build_pedestrian(0, np.stack([np.zeros(80), y], axis=1), 0.0, (0.9, 0.8, 1.7))
    np.testing.assert_allclose(body.heading, np.pi / 2, atol=1e-6)


def test_label_noise_leaves_standing_cars_frozen():
    rng = np.random.default_rng(0)
    position, heading, velocity = np.zeros((91, 2)), np.zeros(91), np.zeros((91, 2))
    velocity[:45, 0] = 8.0
    noisy, turned, _ = add_label_noise(rng, 0.01, position, heading, velocity)
    assert np.all(noisy[45:] == 0.0)
    assert np.all(turned[45:] == 0.0)
    assert 0.005 < noisy[:45, 0].std() < 0.02
