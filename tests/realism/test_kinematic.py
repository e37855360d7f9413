import math

import pytest
import torch

from rlftsim.realism.features import compute_ground_speed, compute_kinematics, shrink_validity, wrap_angle


def test_constant_acceleration_along_a_slope_gives_speed_and_acceleration_in_space():
    # x = t², z = t² with t = 0.1 k: speed sqrt(2) * 2t (a central difference of t² is exact), acceleration sqrt(2) * 2.
    time = torch.arange(8) * 0.1
    kinematics = compute_kinematics((time**2, torch.zeros(8), time**2), torch.zeros(8))
    torch.testing.assert_close(kinematics["linear_speed"][1:-1], math.sqrt(2) * 2 * time[1:-1], atol=1e-5, rtol=0)
    torch.testing.assert_close(
        kinematics["linear_acceleration"][2:-2], torch.full((4,), 2 * math.sqrt(2)), atol=1e-4, rtol=0
    )
    torch.testing.assert_close(compute_ground_speed(time**2, torch.zeros(8))[1:-1], 2 * time[1:-1], atol=1e-5, rtol=0)


def test_speeds_lose_one_step_at_each_end_and_accelerations_two():
    kinematics = compute_kinematics((torch.arange(7.0), torch.zeros(7), torch.zeros(7)), torch.zeros(7))
    assert kinematics["linear_speed"].isnan().tolist() == [True, *[False] * 5, True]
    assert kinematics["angular_acceleration"].isnan().tolist() == [True, True, False, False, False, True, True]


def test_a_turn_through_pi_is_no_jump():
    # 0.05 rad a step through pi, stored in (-pi, pi]: 0.5 rad/s throughout.
    heading = wrap_angle(math.pi - 0.1 + 0.05 * torch.arange(6))
    still = torch.zeros(6)
    angular_speed = compute_kinematics((still, still, still), heading)["angular_speed"]
    torch.testing.assert_close(angular_speed[1:-1], torch.full((4,), 0.5), atol=1e-5, rtol=0)


def test_more_than_a_quarter_turn_a_step_is_taken_for_a_turn_back():
    # 2 rad a step: the two-step difference 4 wraps to 4 - 2 pi, half of that per step.
    still = torch.zeros(3)
    angular_speed = compute_kinematics((still, still, still), 2.0 * torch.arange(3))["angular_speed"]
    assert angular_speed[1].item() == pytest.approx((2 - math.pi) / 0.1, abs=1e-4)


def test_validity_shrinks_by_the_neighbors_and_ignores_the_step_itself():
    valid = torch.tensor([True, True, False, True, True, True])
    assert shrink_validity(valid).tolist() == [False, False, True, False, True, False]
