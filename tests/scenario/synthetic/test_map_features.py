"""Map features of hand-drawn shapes: orientation of edges, rings cut open, crops."""

import numpy as np
import pytest

from rlftsim.scenario.synthetic.crop import Ground, MapCropper, cut_feature, on_grid
from rlftsim.scenario.synthetic.map_features import Feature, NetworkMap, oriented_rings, resample, split_ring
from rlftsim.scenario.synthetic.street_plan import offset_polyline
from rlftsim.scenario.types import MapFeatureType


def signed_area(ring: np.ndarray) -> float:
    """Positive where the ring runs counter-clockwise (shoelace formula)."""
    x, y = ring[:, 0], ring[:, 1]
    return float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum() / 2)


def test_road_lies_to_the_left_of_outer_rings_and_of_holes():
    shapely = pytest.importorskip("shapely")
    area = shapely.box(0, 0, 60, 60).difference(shapely.box(20, 20, 40, 40))
    (outer, outer_is_median), (hole, hole_is_median) = oriented_rings(area)
    assert signed_area(outer) == pytest.approx(3600)
    assert signed_area(hole) == pytest.approx(-400)
    assert (outer_is_median, hole_is_median) == (False, False)


def test_a_thin_hole_is_a_median():
    shapely = pytest.importorskip("shapely")
    area = shapely.box(0, 0, 100, 30).difference(shapely.box(10, 14, 90, 17))
    assert [is_median for _, is_median in oriented_rings(area)] == [False, True]


def test_a_whole_ring_stays_closed():
    ring = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]], float)
    (kept,) = split_ring(ring, np.ones(5, bool))
    np.testing.assert_array_equal(kept[0], kept[-1])


def test_a_ring_cut_open_continues_over_its_seam():
    ring = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]], float)
    # Without (1, 0) the rest runs (1, 1), (0, 1), (0, 0): one piece, though the seam lies within it.
    (piece,) = split_ring(ring, np.array([True, False, True, True, True]))
    np.testing.assert_array_equal(piece, [[1, 1], [0, 1], [0, 0]])


def test_offset_to_the_left_of_a_line_along_x_is_above_it():
    line = np.array([[0.0, 0.0], [5.0, 0.0], [10.0, 0.0]])
    np.testing.assert_allclose(offset_polyline(line, 2.0), line + np.array([0.0, 2.0]))


def test_offset_keeps_its_distance_at_a_corner():
    line = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0]])
    # One metre to the left of a left turn: the corner moves to (9, 1).
    np.testing.assert_allclose(offset_polyline(line, 1.0), [[0, 1], [9, 1], [9, 10]], atol=1e-12)


def test_resampled_points_are_half_a_metre_apart():
    points = resample(np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 4.0]]))
    assert len(points) == 15
    np.testing.assert_allclose(np.linalg.norm(np.diff(points, axis=0), axis=1), 0.5)


def test_lines_fall_into_pieces_and_lanes_do_not():
    points = np.stack([np.arange(10.0), np.zeros(10)], axis=1)
    inside = np.array([1, 1, 1, 0, 0, 0, 1, 1, 1, 1], bool)
    line = cut_feature(Feature(1, MapFeatureType.EDGE_BOUNDARY, points), inside)
    lane = cut_feature(Feature(2, MapFeatureType.LANE_SURFACE_STREET, points), inside)
    assert [len(piece) for piece in line] == [3, 4]
    assert [len(piece) for piece in lane] == [10]


def test_a_crop_keeps_links_between_the_lanes_it_keeps():
    lanes = [np.stack([np.arange(21.0) + 20 * k, np.zeros(21)], axis=1) for k in range(3)]
    features = tuple(Feature(k + 1, MapFeatureType.LANE_SURFACE_STREET, lanes[k], 13.4) for k in range(3))
    whole = NetworkMap(features, ((1, 2), (2, 3)), (), (), ())
    cropped = MapCropper(whole, Ground(5.0, (0.0, 0.0), ())).crop(np.array([[10.0, 0.0]]), 15.0)
    assert cropped.feature_id.tolist() == [1, 2]
    assert cropped.topology.exit_lanes.tolist() == [[1, 2]]
    assert cropped.topology.entry_lanes.tolist() == [[2, 1]]
    assert cropped.topology.speed_limit_mph.tolist() == [30.0, 30.0]
    np.testing.assert_array_equal(cropped.points[:, 2], 5.0)


def test_rounded_values_are_on_the_grid_and_never_minus_zero():
    values = on_grid(np.array([-0.0001, 0.0371, -1.3]), 512)
    assert values.dtype == np.float32
    assert not np.signbit(values[0])
    np.testing.assert_array_equal(values * 512, np.rint(values * 512))
