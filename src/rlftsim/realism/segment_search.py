"""Exact nearest segment among thousands, for thousands of points, without computing every distance.

Segments are cut into chunks of up to 16 neighbors of the same polyline with bounding boxes. A group of points that lie
close together (an agent's corners over a few steps) shares a list of the chunks nearest to the group's box. Each
point searches the nearest listed chunk, then every listed chunk with a box not farther than the best distance so far.
Points for which a chunk outside the list could still win look at all boxes. The result is always that of a full
search: the smallest float32 distance, the first segment in polyline-then-segment order among equals. Segments of
several scenarios may lie side by side; a point then searches those of the point's scenario.
"""

import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from rlftsim.realism.rounding import compute_largest_square, compute_sqrt

CHUNK_SEGMENTS = 16
LISTED_CHUNKS = 12
FEW_PAIRS = 1024
"""Up to so many pairs of a point and a chunk are searched at once, as lists would cost more than they save."""
PADDING_COORDINATE = 1e15
"""Coordinate of padding: never nearest, and its square is still a float32."""
_KEY_SHIFT = 32
"""Bits of a key that hold the index of the segment."""


@dataclass(frozen=True, eq=False)
class ChunkedSegments:
    """Segments of polylines in chunks; slots beyond a polyline's last segment are padding far away.

    C chunks of B scenarios, at most M in a scenario, U = 16 slots, D dimensions of the boxes.
    """

    start: tuple[Float[Tensor, "C U"], ...]
    """One tensor per coordinate: x, y and, for searches in space, z."""
    delta: tuple[Float[Tensor, "C U"], ...]
    """End minus start."""
    squared_length: Float[Tensor, "C U"]
    """In the plane; 1 where zero, so that a projection on a segment of no length is 0."""
    low: Float[Tensor, "D B M"]
    """Lowest corner of the box of each scenario's chunks: no segment of a chunk is nearer than the box. Padding is far
    away."""
    high: Float[Tensor, "D B M"]
    first_chunk: Int64[Tensor, "B"]
    """Index of each scenario's first chunk."""
    axis_scale: tuple[float, ...]
    """Weight of each axis in the distance to a box."""
    first_segment: Int64[Tensor, "C"]
    """Index of a chunk's first segment among all segments."""

    def select_scenarios(
        self, scenario: Int64[Tensor, "n"] | None
    ) -> tuple[Float[Tensor, "D _ M"], Float[Tensor, "D _ M"], Int64[Tensor, "_ 1"]]:
        """Corners of the boxes that each of n points searches, and the index of the first chunk; shared if None."""
        if scenario is None:
            return self.low, self.high, self.first_chunk[:, None]
        return self.low[:, scenario], self.high[:, scenario], self.first_chunk[scenario, None]


DistanceRule = Callable[[Float[Tensor, "P D"], ChunkedSegments, Int64[Tensor, "P"]], Float[Tensor, "P U"]]
"""Squared distance of each point to the segments of a chunk."""


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
        start: First point of each segment, float32, m.
        end: Last point of each segment, float32, m.
        polyline: Index of each segment's polyline, ascending.
        bounds: Lowest and highest corner of each segment's box; the distance rule of the search must never give less
            than the distance to the box.
        axis_scale: Weight of each of the D axes in the distance to a box.
        device: Device of the tensors, that of the points to be searched for.
    """
    # 1. Chunk and slot of each segment; a chunk never spans two polylines.
    slot = (np.arange(len(polyline)) - np.searchsorted(polyline, polyline)) % CHUNK_SEGMENTS
    chunk, first_segment = np.cumsum(slot == 0) - 1, np.flatnonzero(slot == 0)

    # 2. Values of the segments at their slots [C, U], padding elsewhere.
    def scatter(values: np.ndarray, padding: float) -> Tensor:
        slots = np.full((len(first_segment), CHUNK_SEGMENTS), padding, np.float32)
        slots[chunk, slot] = values
        return torch.from_numpy(slots).to(device)

    delta = end - start
    squared_length = delta[:, 0] * delta[:, 0] + delta[:, 1] * delta[:, 1]
    return ChunkedSegments(
        start=tuple(scatter(column, PADDING_COORDINATE) for column in start.T),
        delta=tuple(scatter(column, 0.0) for column in delta.T),
        squared_length=scatter(np.where(squared_length > 0, squared_length, 1), 1.0),
        low=torch.from_numpy(np.minimum.reduceat(bounds[0], first_segment).T[:, None].copy()).to(device),
        high=torch.from_numpy(np.maximum.reduceat(bounds[1], first_segment).T[:, None].copy()).to(device),
        first_chunk=torch.zeros(1, dtype=torch.int64, device=device),
        axis_scale=axis_scale,
        first_segment=torch.from_numpy(first_segment).to(device),
    )


def join_chunks(maps: Sequence[ChunkedSegments | None], num_segments: Sequence[int]) -> ChunkedSegments:
    """Segments of several scenarios side by side.

    Args:
        maps: Segments of each scenario, at least one not None; None = a scenario without segments, never searched.
        num_segments: Number of segments in each scenario, padding not counted.
    """
    joined = [segments for segments in maps if segments is not None]
    first_chunk = _compute_starts([0 if segments is None else len(segments.squared_length) for segments in maps])
    first_segment = zip(maps, _compute_starts(num_segments))
    empty = joined[0].low.new_zeros(0, len(joined[0].low))

    def pad(name: str) -> Tensor:
        """Corners of the boxes of all scenarios: [D, B, M]."""
        corners = [empty if segments is None else getattr(segments, name)[:, 0].T for segments in maps]  # [M, D] each
        return pad_sequence(corners, batch_first=True, padding_value=PADDING_COORDINATE).permute(2, 0, 1)

    return ChunkedSegments(
        start=tuple(torch.cat(columns) for columns in zip(*(segments.start for segments in joined))),
        delta=tuple(torch.cat(columns) for columns in zip(*(segments.delta for segments in joined))),
        squared_length=torch.cat([segments.squared_length for segments in joined]),
        low=pad("low"),
        high=pad("high"),
        first_chunk=torch.tensor(first_chunk, device=empty.device),
        axis_scale=joined[0].axis_scale,
        first_segment=torch.cat([segments.first_segment + first for segments, first in first_segment if segments]),
    )


def _compute_starts(counts: Sequence[int]) -> list[int]:
    """Index of the first item of each group."""
    return [0, *itertools.accumulate(counts)][:-1]


def _squared_box_distance(
    points: tuple[Float[Tensor, "D ..."], Float[Tensor, "D ..."]],
    boxes: tuple[Float[Tensor, "D ..."], Float[Tensor, "D ..."]],
    axis_scale: tuple[float, ...],
) -> Float[Tensor, "..."]:
    """Squared distance between boxes, each given by the lowest and highest corners; 0 where the boxes touch."""
    squares = []
    for axis, scale in enumerate(axis_scale):
        gap = torch.maximum(boxes[0][axis] - points[1][axis], points[0][axis] - boxes[1][axis]).clamp_(min=0.0)
        squares.append((gap if scale == 1.0 else gap.mul_(scale)).square_())
    return functools.reduce(Tensor.add_, squares)


def _squared_limit(key: Int64[Tensor, "..."]) -> Float[Tensor, "..."]:
    """Squared box distance beyond which no chunk can win or tie; generous against float32 rounding."""
    distance = (key >> _KEY_SHIFT).to(torch.int32).view(torch.float32)
    return (distance * 1.0001 + 0.001).square_()


@dataclass(frozen=True, eq=False)
class _Search:
    """A search for the nearest segments of points [n, D], by a rule."""

    segments: ChunkedSegments
    rule: DistanceRule
    max_pairs: int

    def search_chunks(
        self, points: Float[Tensor, "n D"], rows: Int64[Tensor, "P"], chunks: Int64[Tensor, "P"]
    ) -> Int64[Tensor, "P"]:
        """Key of the nearest segment of a chunk, for each pair of a point and a chunk."""
        keys = []
        size = max(1, self.max_pairs // CHUNK_SEGMENTS)
        for row, chunk in zip(rows.split(size), chunks.split(size)):
            squared = self.rule(points[row], self.segments, chunk)
            distance = compute_sqrt(squared.amin(-1))
            # Ties are between distances, not their squares: rounding the root makes more of them equal.
            slot = (squared <= compute_largest_square(distance)[:, None]).to(torch.uint8).argmax(-1)
            # The bits of a non-negative float32, read as an integer, are ordered like the number. So the minimum of one
            # integer finds the smallest distance and, among equals, the lowest index.
            bits = distance.view(torch.int32).to(torch.int64)
            keys.append((bits << _KEY_SHIFT) | (chunk * CHUNK_SEGMENTS + slot))
        return keys[0] if len(keys) == 1 else torch.cat(keys)

    def widen(
        self,
        points: Float[Tensor, "n D"],
        key: Int64[Tensor, "n"],
        open_rows: Int64[Tensor, "r"],
        scenario: Int64[Tensor, "n"] | None,
    ) -> None:
        """Search all chunks for the points with too short a list; lowers `key` in place."""
        for rows in open_rows.split(max(1, self.max_pairs // self.segments.low.shape[-1])):
            position = points[rows].T[:, :, None]  # [D, r, 1]
            low, high, first_chunk = self.segments.select_scenarios(None if scenario is None else scenario[rows])
            bound = _squared_box_distance((position, position), (low, high), self.segments.axis_scale)  # [r, M]
            row, chunk = (bound <= _squared_limit(key[rows])[:, None]).nonzero().unbind(-1)
            chunk = chunk + first_chunk.expand(len(rows), 1)[row, 0]
            row = rows[row]
            key.scatter_reduce_(0, row, self.search_chunks(points, row, chunk), "amin")

    def search_block(self, groups: Float[Tensor, "G Q D"], scenario: Int64[Tensor, "G"] | None) -> Int64[Tensor, "n"]:
        """Keys of a block of groups, n = G Q."""
        segments = self.segments
        # 1. The chunks nearest to each group's box, and the bound of the first one that is not listed.
        num_groups, group_size, num_axes = groups.shape
        points, axes = groups.flatten(0, 1), groups.permute(2, 0, 1)
        low, high, first_chunk = segments.select_scenarios(scenario)
        num_chunks = low.shape[-1]
        if scenario is None and len(points) * num_chunks <= FEW_PAIRS:
            row, chunk = torch.ones(len(points), num_chunks, device=points.device).nonzero().unbind(-1)
            return self.search_chunks(points, row, chunk).view(len(points), num_chunks).amin(1)
        num_listed = min(LISTED_CHUNKS, num_chunks)
        group_box = (axes.amin(-1)[..., None], axes.amax(-1)[..., None])
        group_bound = _squared_box_distance(group_box, (low, high), segments.axis_scale)  # [G, M]
        group_bound, chunks = group_bound.topk(min(num_listed + 1, num_chunks), largest=False)
        chunks = chunks[:, :num_listed]  # [G, L]
        # 2. Each point searches the nearest chunk of its list.
        position, index = axes[..., None], chunks.expand(num_axes, -1, -1)  # [D, G, Q, 1], [D, G, L]
        low, high = (corner.expand(-1, num_groups, -1).gather(-1, index)[:, :, None] for corner in (low, high))
        bound = _squared_box_distance((position, position), (low, high), segments.axis_scale).flatten(0, 1)  # [n, L]
        # Indices of padding may lie beyond the last chunk; only points of scenarios without any search it.
        chunks = (chunks + first_chunk).clamp_(max=len(segments.squared_length) - 1).repeat_interleave(group_size, 0)
        rows = torch.arange(len(points), device=points.device)
        nearest_chunk = bound.argmin(-1, keepdim=True)
        key = self.search_chunks(points, rows, chunks.gather(1, nearest_chunk).squeeze(1))
        # 3. Then every other listed chunk that may still hold something nearer.
        may_win = (bound <= _squared_limit(key)[:, None]).scatter_(1, nearest_chunk, False)
        row, column = may_win.nonzero().unbind(-1)
        if len(row):
            key.scatter_reduce_(0, row, self.search_chunks(points, row, chunks[row, column]), "amin")
        # 4. Points for which an unlisted chunk may hold something nearer search all boxes.
        if num_listed < num_chunks:
            unlisted_bound = group_bound[:, num_listed].repeat_interleave(group_size)
            open_rows = (unlisted_bound <= _squared_limit(key)).nonzero().squeeze(1)
            point_scenario = None if scenario is None else scenario.repeat_interleave(group_size)
            self.widen(points, key, open_rows, point_scenario)
        return key


def find_nearest_segment(
    groups: Float[Tensor, "G Q D"],
    segments: ChunkedSegments,
    rule: DistanceRule,
    *,
    max_pairs: int,
    scenario: Int64[Tensor, "G"] | None = None,
) -> Int64[Tensor, "G Q"]:
    """Index of the nearest segment of each point, by `rule`, the first among equals.

    Args:
        groups: G groups of Q nearby points (any grouping is correct, a tight grouping is fast).
        segments: Segments cut into chunks, in the same frame as the points.
        rule: Squared distance of points to the segments of a chunk, never below that to the chunk's box.
        max_pairs: Bound on the point-segment or group-box pairs in memory; changes no result.
        scenario: Scenario of each group, where the segments are those of several scenarios.
    """
    num_chunks = segments.low.shape[-1]
    size = max(1, max_pairs // max(num_chunks, groups.shape[1] * max(LISTED_CHUNKS, CHUNK_SEGMENTS)))
    blocks = groups.split(size)
    scenarios = [None] * len(blocks) if scenario is None else scenario.split(size)
    search = _Search(segments, rule, max_pairs)
    keys = [search.search_block(block, rows) for block, rows in zip(blocks, scenarios)]
    slot = torch.cat(keys).view(groups.shape[:2]) & ((1 << _KEY_SHIFT) - 1)
    return segments.first_segment[slot // CHUNK_SEGMENTS] + slot % CHUNK_SEGMENTS
