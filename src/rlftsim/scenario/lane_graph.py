"""Lanes of a map as a graph to drive on: center lines and links. Frame: world, meters.

Successors follow from the geometry: a lane goes on where another begins. Logs list successors, too, but many sources
lose the lists. Where a log has them, the geometry gives 99.7 % of their entries (of 25 000 on real maps), and further
links of the geometry are joined without a gap.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64

from rlftsim.geometry import wrapped
from rlftsim.scenario.types import LANE_TYPES, Scenario, cached_on_scenario

JOINT_M = 1.2
"""Largest gap between the end of a lane and the start of the next."""
JOINT_RAD = np.radians(40.0)
"""Largest bend between the end of a lane and the start of the next."""
REPEATED_M = 0.01
"""Points at most this far from the one before count as repeated."""
TANGENT_POINTS = 4
"""Number of segments over which the direction at the end of a lane is taken."""
MPS_PER_MPH = 0.44704


@dataclass(frozen=True, eq=False)
class LaneGraph:
    """The lanes that have a direction at all (two distinct points), n of them with P points in all."""

    lane_id: Int64[np.ndarray, "n"]
    """Feature ids."""
    lane_type: Int64[np.ndarray, "n"]
    """A `MapFeatureType` among `LANE_TYPES`."""
    speed_limit_mps: Float[np.ndarray, "n"]
    """Speed limits, 0 = unknown."""
    lines: tuple[Float[np.ndarray, "_ 3"], ...]
    """Center lines without repeated points."""
    successors: tuple[tuple[int, ...], ...]
    """Indices of the lanes that a lane goes on into."""
    points: Float[np.ndarray, "P 3"]
    """The points of all lines."""
    heading: Float[np.ndarray, "P"]
    """Direction of the line at each point, rad."""
    owner: Int64[np.ndarray, "P"]
    """Index of each point's lane."""
    first: Int64[np.ndarray, "n"]
    """Index of each lane's first point."""

    def __len__(self) -> int:
        return len(self.lane_id)


@cached_on_scenario
def lane_graph(scenario: Scenario) -> LaneGraph:
    """Graph of the lanes of a scenario's map; without lanes an empty graph."""
    features = scenario.map_features
    limits = features.topology.speed_limit_mph
    indices, lines, headings = [], [], []
    for index in features.find_indices(LANE_TYPES):
        line = features.polyline(index).astype(np.float64)
        line = line[np.isfinite(line).all(1)]
        if len(line) >= 2:
            # repeated points have no direction between them
            step = np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1)
            line = line[np.append(True, step > REPEATED_M)]
        if len(line) < 2:
            continue
        # direction at each point: from the point before to the point after
        next_points, last_points = np.append(line[1:], line[-1:], 0), np.append(line[:1], line[:-1], 0)
        x, y = (next_points - last_points)[:, :2].T
        indices.append(int(index))
        lines.append(line)
        headings.append(np.arctan2(y, x))
    counts = np.array([len(line) for line in lines], np.int64)
    return LaneGraph(
        lane_id=features.feature_id[indices],
        lane_type=features.feature_type[indices].astype(np.int64),
        speed_limit_mps=np.zeros(len(indices)) if limits is None else limits[indices].astype(np.float64) * MPS_PER_MPH,
        lines=tuple(lines),
        successors=_successors(lines),
        points=np.concatenate([np.zeros((0, 3)), *lines]),
        heading=np.concatenate([np.zeros(0), *headings]),
        owner=np.repeat(np.arange(len(lines)), counts),
        first=np.cumsum(counts) - counts,
    )


def _successors(lines: list[Float[np.ndarray, "_ 3"]]) -> tuple[tuple[int, ...], ...]:
    """Indices of the lines that begin where a line ends, in nearly the same direction, for each line."""
    if not lines:
        return ()
    # [n, 3] each
    starts, ends = np.stack([line[0] for line in lines]), np.stack([line[-1] for line in lines])
    into = _directions([line[: TANGENT_POINTS + 1] for line in lines])
    out_of = _directions([line[-TANGENT_POINTS - 1 :] for line in lines])
    # [n, n]: row = the lane that ends, column = the one that begins
    gap = np.linalg.norm(ends[:, None] - starts[None], axis=-1)
    bend = np.abs(wrapped(into[None] - out_of[:, None]))
    joined = (gap <= JOINT_M) & (bend <= JOINT_RAD)
    np.fill_diagonal(joined, False)  # a closed loop is no successor of the loop
    return tuple(tuple(np.flatnonzero(row).tolist()) for row in joined)


def _directions(lines: list[Float[np.ndarray, "_ 3"]]) -> Float[np.ndarray, "n"]:
    """Direction from the first to the last point of each line, rad."""
    vectors = np.stack([line[-1] - line[0] for line in lines])
    return np.arctan2(vectors[:, 1], vectors[:, 0])
