"""Exact nearest segment among thousands, for thousands of points, without computing every distance.

Segments are cut into chunks of up to 16 neighbors of one polyline with bounding boxes. A group of points that lie
close together (an agent's corners over a few steps) shares a list of the chunks nearest to the group's box. Each
point searches the nearest of them, then every other one whose box is not farther than the best distance so far.
Points for which a chunk outside the list could still win look at all boxes. The result is always that of a full
search: the smallest float32 distance, the first segment in polyline-then-segment order among equals.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from rlftsim.realism.rounding import compute_largest_square, compute_sqrt

CHUNK_SEGMENTS = 16
LISTED_CHUNKS = 12
_FAR = 1e15
"""Coordinate of padding: never nearest, and its square is still a float32."""
_KEY_SHIFT = 32
"""Bits of a key that hold the index of the segment."""


@dataclass(frozen=True, eq=False)
class ChunkedSegments:
    """Segments of polylines in chunks; slots beyond a polyline's last segment are padding far away.

    C chunks, U = 16 slots, D dimensions of the boxes.
    """

    start: tuple[Float[Tensor, "C U"], ...]
    """One tensor per coordinate: x, y and, for searches in space, z."""
    delta: tuple[Float[Tensor, "C U"], ...]
    """End minus start."""
    squared_length: Float[Tensor, "C U"]
    """In the plane; 1 where zero, so that a projection on a segment of no length is 0."""
    low: Float[Tensor, "D C"]
    """Lowest corner of a chunk's box: no segment of the chunk is nearer than its box."""
    high: Float[Tensor, "D C"]
    axis_scale: tuple[float, ...]
    """Weight of each axis in the distance to a box."""
    first_segment: Int64[Tensor, "C"]
    """Index of a chunk's first segment among all segments."""


DistanceRule = Callable[[Float[Tensor, "P D"], ChunkedSegments, Int64[Tensor, "P"]], Float[Tensor, "P U"]]
"""Squared distance of each point to the segments of one chunk."""


def chunk_segments(
    start: Float[np.ndarray, "s d"],
    end: Float[np.ndarray, "s d"],
    polyline: Int64[np.ndarray, "s"],
    bounds: tuple[Float[np.ndarray, "s D"], Float[np.ndarray, "s D"]],
    *,
    axis_scale: tuple[float, ...],
    device: torch.device,
) -> ChunkedSegments:
    """Segments, given in polyline-then-segment order, cut into chunks.

    Args:
        start: first points, float32.
        end: last points.
        polyline: polyline of each segment, ascending.
        bounds: lowest and highest corner of each segment's box; the distance rule of the search must never give less
            than the distance to the box.
        axis_scale: weight of each axis in the distance to a box.
        device: where the tensors go.
    """
    # 1. Chunk and slot of each segment; a chunk never spans two polylines.
    first_of_polyline = np.searchsorted(polyline, polyline)
    within = np.arange(len(polyline)) - first_of_polyline
    opens_chunk = within % CHUNK_SEGMENTS == 0
    chunk, slot = np.cumsum(opens_chunk) - 1, within % CHUNK_SEGMENTS
    num_chunks, opening = int(opens_chunk.sum()), np.flatnonzero(opens_chunk)

    # 2. Values of the segments at their slots [C, U], padding elsewhere.
    def scatter(values: np.ndarray, padding: float) -> Tensor:
        packed = np.full((num_chunks, CHUNK_SEGMENTS), padding, np.float32)
        packed[chunk, slot] = values
        return torch.from_numpy(packed).to(device)

    delta = end - start
    squared_length = delta[:, 0] * delta[:, 0] + delta[:, 1] * delta[:, 1]
    return ChunkedSegments(
        start=tuple(scatter(column, _FAR) for column in start.T),
        delta=tuple(scatter(column, 0.0) for column in delta.T),
        squared_length=scatter(np.where(squared_length > 0, squared_length, 1), 1.0),
        low=torch.from_numpy(np.minimum.reduceat(bounds[0], opening).T.copy()).to(device),
        high=torch.from_numpy(np.maximum.reduceat(bounds[1], opening).T.copy()).to(device),
        axis_scale=axis_scale,
        first_segment=torch.from_numpy(opening).to(device),
    )


def _squared_box_distance(
    points: tuple[Float[Tensor, "D ..."], Float[Tensor, "D ..."]],
    boxes: tuple[Float[Tensor, "D ..."], Float[Tensor, "D ..."]],
    axis_scale: tuple[float, ...],
) -> Float[Tensor, "..."]:
    """Squared distance between boxes, each given by its lowest and highest corners; 0 where they touch."""
    squares = []
    for axis, scale in enumerate(axis_scale):
        gap = torch.maximum(boxes[0][axis] - points[1][axis], points[0][axis] - boxes[1][axis]).clamp_(min=0.0)
        squares.append((gap if scale == 1.0 else gap.mul_(scale)).square_())
    total = squares[0]
    for square in squares[1:]:
        total.add_(square)
    return total


def _to_key(distance: Float[Tensor, "P"], segment: Int64[Tensor, "P"]) -> Int64[Tensor, "P"]:
    # The bits of a non-negative float32, read as an integer, are ordered like the number. So the minimum of one integer
    # finds the smallest distance and, among equals, the lowest index.
    return (distance.view(torch.int32).to(torch.int64) << _KEY_SHIFT) | segment


def _squared_limit(key: Int64[Tensor, "..."]) -> Float[Tensor, "..."]:
    """Squared box distance beyond which no chunk can win or tie; generous against float32 rounding."""
    distance = (key >> _KEY_SHIFT).to(torch.int32).view(torch.float32)
    return (distance * 1.0001 + 0.001).square_()


def _search_chunks(
    points: Float[Tensor, "n D"],
    segments: ChunkedSegments,
    rule: DistanceRule,
    pairs: tuple[Int64[Tensor, "P"], Int64[Tensor, "P"]],
    max_pairs: int,
) -> Int64[Tensor, "P"]:
    """Key of the nearest segment of a chunk for each (point, chunk) pair."""
    keys = []
    size = max(1, max_pairs // CHUNK_SEGMENTS)
    for row, chunk in zip(pairs[0].split(size), pairs[1].split(size)):
        squared = rule(points[row], segments, chunk)
        distance = compute_sqrt(squared.amin(-1))
        # Ties are between distances, not their squares: rounding the root makes more of them equal.
        slot = (squared <= compute_largest_square(distance)[:, None]).to(torch.uint8).argmax(-1)
        keys.append(_to_key(distance, chunk * CHUNK_SEGMENTS + slot))
    return keys[0] if len(keys) == 1 else torch.cat(keys)


def _widen(
    points: Float[Tensor, "n D"],
    segments: ChunkedSegments,
    rule: DistanceRule,
    key: Int64[Tensor, "n"],
    open_rows: Int64[Tensor, "r"],
    max_pairs: int,
) -> None:
    """Search all chunks for the points whose list was too short; lowers `key` in place."""
    for rows in open_rows.split(max(1, max_pairs // segments.low.shape[1])):
        own = points[rows].T[:, :, None]  # [D, r, 1]
        boxes = (segments.low[:, None], segments.high[:, None])
        bound = _squared_box_distance((own, own), boxes, segments.axis_scale)  # [r, C]
        row, chunk = (bound <= _squared_limit(key[rows])[:, None]).nonzero().unbind(-1)
        row = rows[row]
        key.scatter_reduce_(0, row, _search_chunks(points, segments, rule, (row, chunk), max_pairs), "amin")


def _search_block(
    groups: Float[Tensor, "G Q D"], segments: ChunkedSegments, rule: DistanceRule, max_pairs: int
) -> Int64[Tensor, "n"]:
    """Keys of one block of groups, n = G Q."""
    # 1. The chunks nearest to each group's box, and the bound of the first one that is not listed.
    group_size = groups.shape[1]
    points, axes = groups.flatten(0, 1), groups.permute(2, 0, 1)
    num_chunks = segments.low.shape[1]
    listed = min(LISTED_CHUNKS, num_chunks)
    bound = _squared_box_distance(
        (axes.amin(-1)[..., None], axes.amax(-1)[..., None]),
        (segments.low[:, None], segments.high[:, None]),
        segments.axis_scale,
    )  # [G, C]
    near, chunks = bound.topk(min(listed + 1, num_chunks), largest=False)
    listed_chunks = chunks[:, :listed]  # [G, M]
    # 2. Each point searches the nearest chunk of its list.
    own = axes[..., None]  # [D, G, Q, 1]
    listed_boxes = (segments.low[:, listed_chunks][:, :, None], segments.high[:, listed_chunks][:, :, None])
    bound = _squared_box_distance((own, own), listed_boxes, segments.axis_scale).flatten(0, 1)  # [n, M]
    chunks = listed_chunks.repeat_interleave(group_size, 0)
    rows = torch.arange(len(points), device=points.device)
    first = bound.argmin(-1, keepdim=True)
    key = _search_chunks(points, segments, rule, (rows, chunks.gather(1, first).squeeze(1)), max_pairs)
    # 3. Then every other listed chunk that may still hold something nearer.
    may_win = (bound <= _squared_limit(key)[:, None]).scatter_(1, first, False)
    row, column = may_win.nonzero().unbind(-1)
    if len(row):
        key.scatter_reduce_(
            0, row, _search_chunks(points, segments, rule, (row, chunks[row, column]), max_pairs), "amin"
        )
    # 4. Points for which an unlisted chunk may hold something nearer search all boxes.
    if listed < num_chunks:
        beyond = near[:, listed].repeat_interleave(group_size)
        _widen(points, segments, rule, key, (beyond <= _squared_limit(key)).nonzero().squeeze(1), max_pairs)
    return key


def find_nearest_segment(
    groups: Float[Tensor, "G Q D"], segments: ChunkedSegments, rule: DistanceRule, *, max_pairs: int
) -> Int64[Tensor, "G Q"]:
    """Index of the nearest segment of each point, by `rule`, the first among equals.

    Args:
        groups: G groups of Q nearby points (any grouping is correct, a tight one is fast).
        segments: cut into chunks, in the same frame as the points.
        rule: squared distance of points to the segments of a chunk, never below that to the chunk's box.
        max_pairs: bound on the point-segment or group-box pairs in memory; changes no result.
    """
    num_chunks = segments.low.shape[1]
    per_group = max(num_chunks, groups.shape[1] * max(LISTED_CHUNKS, CHUNK_SEGMENTS))
    keys = [_search_block(block, segments, rule, max_pairs) for block in groups.split(max(1, max_pairs // per_group))]
    packed = torch.cat(keys).view(groups.shape[:2]) & ((1 << _KEY_SHIFT) - 1)
    return segments.first_segment[packed // CHUNK_SEGMENTS] + packed % CHUNK_SEGMENTS
