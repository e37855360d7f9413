"""Street plans drawn from a seed, before any simulator is involved.

A plan is a list of nodes and *directed* streets in meters around (0, 0). The shape of a street is the left border (the
line between the two directions). Lanes lie to the right of the border and are listed from right to left, as SUMO
counts.
"""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float

LaneType = Literal["sidewalk", "gutter", "parking", "bicycle", "travel"]
"""A gutter is the pavement between the outermost usable lane and the road edge. No vehicle drives on a gutter."""
Control = Literal["traffic_light", "allway_stop", "priority_stop", "right_before_left", "priority", "dead_end"]
StreetClass = Literal["arterial", "collector", "residential", "freeway", "ramp"]

MAX_RADIUS_M = 485.0
"""No node lies farther from (0, 0)."""
PRIORITY: Mapping[StreetClass, int] = {"freeway": 12, "ramp": 8, "arterial": 9, "collector": 6, "residential": 3}
"""Right of way where no sign or light rules; the higher number goes first."""


@dataclass(frozen=True)
class PlannedLane:
    """One lane of a street."""

    lane_type: LaneType
    width_m: float


@dataclass(frozen=True, eq=False)
class Node:
    """A crossing, a bend or an end of the network."""

    node_id: str
    position: Float[np.ndarray, "2"]
    control: Control
    is_fringe: bool = False
    """True = traffic enters and leaves the network here."""


@dataclass(frozen=True, eq=False)
class Street:
    """One direction of a street."""

    street_id: str
    from_node: str
    to_node: str
    points: Float[np.ndarray, "n 2"]
    """Left border in driving direction."""
    street_class: StreetClass
    lanes: tuple[PlannedLane, ...]
    speed_mps: float
    priority: int
    reverse_id: str | None = None
    """The opposite direction sharing the left border; None beside a median or on a one-way street."""

    @property
    def roadway_width_m(self) -> float:
        """Width of all lanes but sidewalks."""
        return sum(lane.width_m for lane in self.lanes if lane.lane_type != "sidewalk")


@dataclass(frozen=True)
class Connection:
    """Explicit link between lanes; a plan without connections leaves the links to the network compiler."""

    from_street: str
    to_street: str
    from_lane: int
    to_lane: int


@dataclass(frozen=True, eq=False)
class StreetPlan:
    """Input of the network compiler, and the types of lanes and the tapers, which the compiler would lose."""

    network_type: Literal["city", "quiet", "freeway"]
    nodes: tuple[Node, ...]
    streets: tuple[Street, ...]
    connections: tuple[Connection, ...] = ()
    tapers: tuple[Float[np.ndarray, "3 2"], ...] = field(default=())
    """Paved triangles where a lane begins or ends beside a freeway."""

    @property
    def fringe_nodes(self) -> tuple[Node, ...]:
        """Ends of the network."""
        return tuple(node for node in self.nodes if node.is_fringe)


def offset_polyline(points: Float[np.ndarray, "n 2"], left_m: float) -> Float[np.ndarray, "n 2"]:
    """Polyline moved sideways, corners mitered up to twice the distance.

    Args:
        points: Polyline with n points, m, in driving direction.
        left_m: Distance to the left in meters; negative = to the right.
    """
    delta = np.diff(points, axis=0)
    delta /= np.maximum(np.linalg.norm(delta, axis=1, keepdims=True), 1e-9)
    normal = np.stack([-delta[:, 1], delta[:, 0]], axis=1)
    first_normal = np.concatenate([normal[:1], normal])  # of the segment that ends at a point
    bisector = first_normal + np.concatenate([normal, normal[-1:]])
    # the bisector is 2 cos(turn / 2) long, its product with a normal 2 cos(turn / 2)^2: corners keep their distance
    scale = np.maximum((bisector * first_normal).sum(1, keepdims=True), 0.5)
    return points + left_m * bisector / scale


def rotation_matrix(angle_rad: float) -> Float[np.ndarray, "2 2"]:
    """Matrix that turns column vectors counter-clockwise."""
    return np.array([[np.cos(angle_rad), -np.sin(angle_rad)], [np.sin(angle_rad), np.cos(angle_rad)]])


def find_reachable(start: Hashable, links: Sequence[tuple[Hashable, Hashable]]) -> set[Hashable]:
    """Nodes that links lead to from a node, the start included.

    Args:
        start: Node where the search begins.
        links: Pairs of nodes, each passable from the first to the second node only.
    """
    reachable, frontier = set(), [start]
    while frontier:
        node = frontier.pop()
        if node not in reachable:
            reachable.add(node)
            frontier += [target for source, target in links if source == node]
    return reachable
