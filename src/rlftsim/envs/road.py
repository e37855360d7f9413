"""Road edges of scenarios, and points beside the edges."""

from typing import NamedTuple, no_type_check

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64

from rlftsim.envs.compiled import compiled
from rlftsim.realism.map_based import HEIGHT_STRETCH, RoadEdges, build_road_edges
from rlftsim.realism.segment_search import PADDING_COORDINATE
from rlftsim.scenario.types import Scenario, cached_on_scenario

MAX_PAIRS = 1 << 22
"""Bounds the memory of the search for road edges."""
_ZERO, _UNIT = np.float32(0), np.float32(1)


@cached_on_scenario
def road_edges(scenario: Scenario) -> RoadEdges | None:
    """Road edges of a scenario; None without any."""
    return build_road_edges(scenario.map_features, torch.device("cpu"))


class EdgeArrays(NamedTuple):
    """Road edges of B scenarios as arrays; C chunks of 16 segments, s segments."""

    first_chunk: Int64[np.ndarray, "B"]
    low: Float32[np.ndarray, "3 B M"]
    """Lowest corner of the box of each chunk of a scenario; padding is far away."""
    high: Float32[np.ndarray, "3 B M"]
    chunk_starts: tuple[Float32[np.ndarray, "C 16"], ...]
    """x, y and z of the starts."""
    chunk_deltas: tuple[Float32[np.ndarray, "C 16"], ...]
    squared_length: Float32[np.ndarray, "C 16"]
    first_segment: Int64[np.ndarray, "C"]
    start: Float32[np.ndarray, "s 2"]
    delta: Float32[np.ndarray, "s 2"]
    previous: Int64[np.ndarray, "s"]
    next: Int64[np.ndarray, "s"]

    @classmethod
    def from_edges(cls, edges: RoadEdges) -> "EdgeArrays":
        """Arrays that share the memory of the tensors."""
        chunks = edges.segments
        return cls(
            first_chunk=chunks.first_chunk.numpy(),
            low=chunks.low.contiguous().numpy(),
            high=chunks.high.contiguous().numpy(),
            chunk_starts=tuple(axis.numpy() for axis in chunks.start),
            chunk_deltas=tuple(axis.numpy() for axis in chunks.delta),
            squared_length=chunks.squared_length.numpy(),
            first_segment=chunks.first_segment.numpy(),
            start=edges.start.numpy(),
            delta=edges.delta.numpy(),
            previous=edges.previous.numpy(),
            next=edges.next.numpy(),
        )


@compiled
@no_type_check
def measure_road_edge(points, scenario, edges, distances):
    """Signed distance of points to the nearest road edge, in bits as `compute_point_distance_to_road_edge`.

    Args:
        points: x, y, z of points [n, 3], float32, m.
        scenario: Scenario of each point [n].
        edges: Road edges of the scenarios, as `EdgeArrays`.
        distances: Array [n], float32, that takes the distances, m, negative on the road.
    """
    stretch = np.float32(HEIGHT_STRETCH)
    (start_x, start_y, start_z), (delta_x, delta_y, delta_z) = edges.chunk_starts, edges.chunk_deltas
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        min_distance, segment = np.float32(np.inf), 0
        for k in range(edges.low.shape[2]):
            low, high = edges.low[:, scenario[i], k], edges.high[:, scenario[i], k]
            gap_x, gap_y = max(low[0] - x, x - high[0], _ZERO), max(low[1] - y, y - high[1], _ZERO)
            gap_z = stretch * max(low[2] - z, z - high[2], _ZERO)
            if gap_x * gap_x + gap_y * gap_y + gap_z * gap_z > (min_distance * 1.0001 + 0.001) ** 2:
                continue
            chunk = edges.first_chunk[scenario[i]] + k
            for u in range(start_x.shape[1]):
                if low[0] >= PADDING_COORDINATE or start_x[chunk, u] >= PADDING_COORDINATE:
                    break
                dx, dy, dz = delta_x[chunk, u], delta_y[chunk, u], delta_z[chunk, u]
                to_x, to_y, to_z = x - start_x[chunk, u], y - start_y[chunk, u], z - start_z[chunk, u]
                projection = min(max((to_x * dx + to_y * dy) / edges.squared_length[chunk, u], _ZERO), _UNIT)
                to_x, to_y, to_z = to_x - projection * dx, to_y - projection * dy, (to_z - projection * dz) * stretch
                distance = np.sqrt(to_x * to_x + to_y * to_y + to_z * to_z)
                if distance < min_distance:
                    min_distance, segment = distance, edges.first_segment[chunk] + u
        distances[i] = _sign_distance(x, y, segment, edges)


@compiled
@no_type_check
def _sign_distance(x, y, segment, edges):
    """Distance in the plane to a segment, negative on the left; beyond an end the corner of both segments decides."""
    dx, dy = edges.delta[segment, 0], edges.delta[segment, 1]
    to_x, to_y = x - edges.start[segment, 0], y - edges.start[segment, 1]
    squared_length = dx * dx + dy * dy
    projection = (to_x * dx + to_y * dy) / (squared_length if squared_length > _ZERO else _UNIT)
    clipped = min(max(projection, _ZERO), _UNIT)
    from_x, from_y = to_x - clipped * dx, to_y - clipped * dy
    distance, side, neighbor = np.sqrt(from_x * from_x + from_y * from_y), np.sign(to_x * dy - to_y * dx), segment
    if projection < _ZERO:
        neighbor = edges.previous[segment]
    elif projection > _UNIT:
        neighbor = edges.next[segment]
    if neighbor == segment:
        return side * distance
    next_dx, next_dy = edges.delta[neighbor, 0], edges.delta[neighbor, 1]
    from_x, from_y = x - edges.start[neighbor, 0], y - edges.start[neighbor, 1]
    neighbor_side, bend = np.sign(from_x * next_dy - from_y * next_dx), dx * next_dy - dy * next_dx
    if projection < _ZERO:
        bend = -bend  # from the earlier to the later segment
    return (max(side, neighbor_side) if bend > _ZERO else min(side, neighbor_side)) * distance


def nearest_edges(
    points: Float[np.ndarray, "n p 2"], edges: Float[np.ndarray, "#n e 4"]
) -> tuple[Float[np.ndarray, "n p"], Float[np.ndarray, "n p"], Bool[np.ndarray, "n p"]]:
    """Distance of each point to the nearest edge, side of that edge, and True for points beside the edge.

    Args:
        points: Points to measure, map frame, m.
        edges: Segments x0, y0, x1, y1, at least one, m; the drivable side is on the left.

    Returns:
        Distances, m; a positive number for points on the left, a negative number on the right; False for points beyond
        the end of the edge, where the side has no meaning.
    """
    edges = edges[:, None]  # [n, 1, e, 4]
    dx, dy = edges[..., 2] - edges[..., 0], edges[..., 3] - edges[..., 1]
    to_x, to_y = points[..., :1] - edges[..., 0], points[..., 1:] - edges[..., 1]  # [n, p, e]
    position = to_x * dx
    position += to_y * dy
    position /= np.maximum(dx * dx + dy * dy, 1e-9)
    clipped_position = position.clip(0.0, 1.0)
    squared = measure_square(to_x - clipped_position * dx, to_y - clipped_position * dy)
    nearest = squared.argmin(-1)[..., None]
    values = (squared, dx, dy, to_x, to_y, position)
    squared, dx, dy, to_x, to_y, position = (
        np.take_along_axis(np.broadcast_to(value, to_x.shape), nearest, -1)[..., 0] for value in values
    )
    return np.sqrt(squared), dx * to_y - dy * to_x, (position >= 0.0) & (position <= 1.0)


def measure_square(x: Float[np.ndarray, "*m"], y: Float[np.ndarray, "*m"]) -> Float[np.ndarray, "*m"]:
    """Squared lengths of vectors, which take the place of `x`; `y` is changed, too."""
    x *= x
    y *= y
    x += y
    return x
