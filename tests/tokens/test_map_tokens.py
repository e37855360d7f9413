import numpy as np
import pytest
import torch

import scenes
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import MapFeatureType
from rlftsim.tokens.map_tokens import NO_MAP_POSITION_M, split_map, tokenize_map

LANE, EDGE = MapFeatureType.LANE_SURFACE_STREET, MapFeatureType.EDGE_BOUNDARY


def pieces_of(*features):
    return split_map(scenes.build_scenario("map", scenes.TRAFFIC[:1], scenes.polylines(features)))


def test_a_straight_lane_is_cut_every_five_meters():
    pieces = pieces_of((LANE, [(0.0, 0.0), (21.0, 0.0)]))  # the last of the 22 points is dropped: 20 m
    begin = pieces.points[:, 0] - scenes.EGO_POSITION_M
    np.testing.assert_allclose(begin, [[0, 0], [5, 0], [10, 0], [15, 0]], atol=1e-3)
    np.testing.assert_allclose(pieces.points[:, 2] - pieces.points[:, 0], [[5, 0]] * 4, atol=1e-3)
    np.testing.assert_allclose(pieces.heading, 0.0, atol=1e-4)


def test_what_is_left_over_becomes_a_shorter_piece():
    pieces = pieces_of((LANE, [(0.0, 0.0), (9.0, 0.0)]))  # 8 m: one whole piece and 3 m
    np.testing.assert_allclose(pieces.points[:, 2, 0] - pieces.points[:, 0, 0], [5.0, 3.0], atol=1e-3)
    assert len(pieces.windows) == 1


def test_pieces_point_along_their_polyline():
    pieces = pieces_of((EDGE, [(0.0, 0.0), (0.0, 12.0)]), (LANE, [(30.0, 0.0), (18.0, 0.0)]))
    lane, edge = pieces.heading[pieces.family == 0], pieces.heading[pieces.family == 1]
    np.testing.assert_allclose(np.abs(lane), np.pi, atol=1e-4)
    np.testing.assert_allclose(edge, np.pi / 2, atol=1e-4)


def test_lanes_come_before_edges_lines_and_polygons():
    pieces = split_map(scenes.junction_with_light())
    assert set(pieces.family.tolist()) == {0, 1, 2, 3}
    assert (np.diff(pieces.family) >= 0).all()


def test_only_the_lane_with_a_light_has_one():
    pieces = split_map(scenes.junction_with_light())  # red at the current step on feature 1, which is the first lane
    first_lane = len(pieces_of((LANE, [(-60.3, 0.1), (140.6, 0.3)])).heading)
    assert set(pieces.light[:first_lane].tolist()) == {2}
    assert not pieces.light[first_lane:].any()


def test_whole_windows_lie_in_their_own_frame():
    windows = split_map(scenes.junction_with_light()).windows
    np.testing.assert_allclose(windows[:, 0], 0.0, atol=1e-5)
    np.testing.assert_allclose(windows[:, 1], np.tile([0.5, 0.0], (len(windows), 1)), atol=1e-3)


@pytest.mark.parametrize("polyline", [[(0.0, 0.0), (0.0, 0.0)], [(0.0, 0.0), (2.0, 0.0)]])
def test_polylines_that_are_too_short_give_nothing(polyline):
    pieces = pieces_of((LANE, polyline))
    assert (pieces.points == np.float32(NO_MAP_POSITION_M)).all()


def test_a_scenario_without_map_gets_one_piece_out_of_reach(vocabulary):
    tokens = tokenize_map(collate([scenes.without_map(), scenes.straight_road()]), vocabulary.map_prototypes)
    assert tokens.token_mask[0].sum() == 1
    assert tokens.position[0, 0].norm() > 1e4


def test_a_straight_piece_is_named_by_the_straight_prototype(vocabulary):
    tokens = tokenize_map(collate([scenes.straight_road()]), vocabulary.map_prototypes)
    lanes = (tokens.family == 0) & tokens.token_mask
    assert (tokens.token_id[lanes] == 0).float().mean() > 0.9


def test_padding_in_a_batch_changes_no_token(vocabulary):
    small, large = scenes.straight_road(), scenes.junction_with_light()
    alone = tokenize_map(collate([small]), vocabulary.map_prototypes)
    both = tokenize_map(collate([small, large]), vocabulary.map_prototypes)
    count = alone.token_mask.shape[1]
    assert torch.equal(both.token_id[0, :count], alone.token_id[0])
    assert not both.token_mask[0, count:].any()
