"""Gates: reasons to refuse a window. Boxes and paths drawn by hand."""

import numpy as np
import pytest

from rlftsim.scenario.synthetic.windows import (
    compute_off_road_m,
    compute_overlap_s,
    moves_plausibly,
)

CAR = (4.0, 2.0, 1.5)


def along_x(speeds_mps: np.ndarray) -> np.ndarray:
    x = np.cumsum(speeds_mps) * 0.1
    return np.stack([x, np.zeros_like(x)], axis=1)


def test_overlap_counts_only_steps_at_which_both_are_valid():
    position = np.zeros((2, 10, 2))
    position[1, :, 0] = 2.0
    valid = np.ones((2, 10), bool)
    valid[1, 4:] = False
    assert compute_overlap_s(position, np.zeros((2, 10)), [CAR, CAR], valid) == pytest.approx(0.4)


def test_constant_speed_passes():
    assert moves_plausibly(along_x(np.full(30, 10.0)), np.zeros(30), is_vehicle=True)


def test_a_jump_of_position_is_refused():
    path = along_x(np.full(30, 10.0))
    path[15:, 0] += 0.5  # 0.5 m within one step is 50 m/s^2
    assert not moves_plausibly(path, np.zeros(30), is_vehicle=True)


def test_sliding_sideways_is_refused_for_vehicles_only():
    path = along_x(np.full(30, 10.0))
    sideways = np.full(30, 0.5)
    assert not moves_plausibly(path, sideways, is_vehicle=True)
    assert moves_plausibly(path, sideways, is_vehicle=False)


def test_a_jump_of_heading_is_refused():
    heading = np.where(np.arange(30) < 15, 0.0, 0.35)
    assert not moves_plausibly(np.zeros((30, 2)), heading, is_vehicle=True)


def test_off_road_distance_is_that_of_the_farthest_corner():
    shapely = pytest.importorskip("shapely")
    road = shapely.box(-10, -2, 10, 2)
    # The car's left side is at y = 1.5 + 1 = 2.5, half a metre beyond the edge.
    assert compute_off_road_m(road, np.array([[0.0, 1.5]]), np.zeros(1), CAR) == pytest.approx(0.5)
    assert compute_off_road_m(road, np.array([[0.0, 0.5]]), np.zeros(1), CAR) == 0.0
