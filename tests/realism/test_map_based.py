import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from realism_drawing import draw_map, draw_street

from rlftsim.realism.agents import Trajectories
from rlftsim.realism.map_based import (
    _measure_road_edge,
    build_road_edges,
    compute_distance_to_road_edge,
    compute_point_distance_to_road_edge,
)
from rlftsim.realism.rounding import compute_sqrt
from rlftsim.realism.segment_search import CHUNK_SEGMENTS, find_nearest_segment

CPU = torch.device("cpu")
PAIRS = 1 << 14


def measure(polylines, point):
    edges = build_road_edges(draw_map([(15, points) for points in polylines]), CPU)
    return compute_point_distance_to_road_edge(torch.tensor([[point]]), edges, max_pairs=PAIRS).item()


def test_left_of_an_edge_is_on_the_road_and_negative():
    edge = [[0.0, 0, 0], [10, 0, 0]]
    assert measure([edge], [5.0, 3, 0]) == -3
    assert measure([edge], [5.0, -3, 0]) == 3
    assert measure([edge], [13.0, 4, 0]) == -5  # beyond the end: distance to the end, side of the line


def test_beyond_a_corner_both_segments_decide_the_side():
    # A sharp left turn at (10, 0). (11, 0.5) lies beyond both segments, left of the first one's line, right of the
    # second one's (cross of (1, 0.5) and (-10, 3) is 8 > 0). The road is inside the turn: off the road, distance to
    # the corner.
    left_turn = [[0.0, 0, 0], [10, 0, 0], [0, 3, 0]]
    assert measure([left_turn], [11.0, 0.5, 0]) == pytest.approx(1.25**0.5)
    # Mirrored, right of the first and left of the second: the road is outside the turn.
    right_turn = [[0.0, 0, 0], [10, 0, 0], [0, -3, 0]]
    assert measure([right_turn], [11.0, -0.5, 0]) == pytest.approx(-(1.25**0.5))


def test_heights_choose_the_edge_but_do_not_lengthen_the_distance():
    # 2 m beside an edge 5 m higher (stretched: 15 m) or 8 m beside one at the same height: the latter is chosen.
    above, level = [[0.0, 2, 5], [10, 2, 5]], [[0.0, -8, 0], [10, -8, 0]]
    assert measure([above, level], [5.0, 0, 0]) == -8
    assert measure([above], [5.0, 0, 0]) == 2


def test_only_a_closed_polyline_with_the_most_points_wraps_around():
    # A thin traffic island, clockwise, road outside. (-1, -0.5) is beyond its tip: right of the first segment's line
    # (cross of (-1, -0.5) and (10, 1) is 4), left of the last one's: together on the road, by the first alone off it.
    island = [[0.0, 0, 0], [10, 1, 0], [10, -1, 0], [0, 0, 0]]
    assert measure([island], [-1.0, -0.5, 0]) == pytest.approx(-(1.25**0.5))
    longer = [[float(x), 500, 0] for x in range(5)]
    assert measure([island, longer], [-1.0, -0.5, 0]) == pytest.approx(1.25**0.5)


def test_polylines_of_one_point_are_no_edges():
    assert build_road_edges(draw_map([(15, [[0.0, 0, 0]]), (2, [[0.0, 0, 0], [1, 0, 0]])]), CPU) is None


def test_the_corner_farthest_off_the_road_counts():
    # Street edges at y = -6 and 6; a box 4 x 2 at y = -4 turned by 90 degrees reaches y = -6: distance 0, then off by
    # 0.5.
    edges = build_road_edges(draw_street(), CPU)
    y = torch.tensor([[[-4.0, -4.5, 0.0]]])
    zero = torch.zeros_like(y)
    agents = Trajectories(zero + 1, y, zero + 0.75, zero + np.pi / 2)
    distance = compute_distance_to_road_edge(agents, torch.tensor([[[4.0, 2.0, 1.5]]]), edges, max_pairs=PAIRS)
    torch.testing.assert_close(distance, torch.tensor([[[0.0, 0.5, -4.0]]]), atol=1e-5, rtol=0)


def draw_random_edges(random, num_polylines):
    """Wiggly polylines of 1 to 60 points with repeated points, some twice (so that distances tie)."""
    polylines = []
    for _ in range(num_polylines):
        steps = random.normal(0, 1.5, (random.integers(1, 60), 3)) * [1, 1, 0.1]
        steps[random.random(len(steps)) < 0.1] = 0
        points = random.uniform(-60, 60, 3) * [1, 1, 0.05] + np.cumsum(steps, 0) + [5000, -3000, 10]
        polylines += [(15, points)] * int(random.integers(1, 3))
    return polylines


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10_000), st.integers(1, 12), st.sampled_from([1, 64, 1 << 14]))
def test_the_pruned_search_finds_what_a_full_search_finds(seed, num_polylines, max_pairs):
    random = np.random.default_rng(seed)
    edges = build_road_edges(draw_map([(15, [[0.0, 0, 0], [1, 0, 0]]), *draw_random_edges(random, num_polylines)]), CPU)
    groups = random.uniform(-90, 90, (6, 1, 3)) * [1, 1, 0.1] + random.normal(0, 3, (6, 8, 3)) + [5000, -3000, 10]
    groups[0] *= random.uniform(0, 1)  # one group far away
    groups = torch.from_numpy(groups.astype(np.float32))
    found = find_nearest_segment(groups, edges.segments, _measure_road_edge, max_pairs=max_pairs)
    points, num_chunks = groups.flatten(0, 1), len(edges.segments.first_segment)
    rows = torch.arange(len(points)).repeat_interleave(num_chunks)
    chunks = torch.arange(num_chunks).repeat(len(points))
    everything = compute_sqrt(_measure_road_edge(points[rows], edges.segments, chunks)).view(len(points), -1)
    nearest = everything.argmin(-1)
    expected = edges.segments.first_segment[nearest // CHUNK_SEGMENTS] + nearest % CHUNK_SEGMENTS
    assert torch.equal(found.flatten(), expected)
