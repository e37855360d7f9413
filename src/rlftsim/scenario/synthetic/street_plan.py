"""Street plans of cities and freeways, drawn from a seed before any simulator is involved.

A plan is a list of nodes and *directed* streets in meters around (0, 0). The shape of a street is the left border (the
line between the two directions). Lanes lie to the right of the border and are listed from right to left, as SUMO
counts.
"""

from collections import Counter
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
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
    tapers: tuple[Float[np.ndarray, "3 2"], ...] = ()
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


# --- cities: irregular, sheared and bent grids of streets of three classes ------------------------------------------


@dataclass(frozen=True)
class _LineProfile:
    """Properties that all streets of one line of the grid share."""

    street_class: StreetClass
    travel_lanes: int
    lane_width_m: float
    speed_mps: float
    median_m: float
    bicycle: bool
    priority: int


def _draw_profile(rng: np.random.Generator, street_class: StreetClass, is_column: bool, quiet: bool) -> _LineProfile:
    """Profile of a line of a class; streets of a quiet quarter have at most two lanes per direction."""
    lanes, low, high = {
        "arterial": (2 if quiet else int(rng.integers(2, 4)), 15.0, 19.5),
        "collector": (1 if quiet else int(rng.integers(1, 3)), 11.0, 15.6),
        "residential": (1, 9.5, 12.0),
    }[street_class]
    bicycle_probability = {"arterial": 0.25, "collector": 0.33, "residential": 0.0}[street_class]
    return _LineProfile(
        street_class=street_class,
        travel_lanes=lanes,
        lane_width_m=float(rng.uniform(3.0, 3.8)),
        speed_mps=float(rng.uniform(low, high)),
        median_m=3.0 if street_class == "arterial" and rng.random() < 0.45 else 0.0,
        bicycle=bool(rng.random() < bicycle_probability),
        priority=PRIORITY[street_class] + int(is_column),
    )


def _draw_classes(rng: np.random.Generator, columns: int, rows: int, quiet: bool) -> list[StreetClass]:
    """Class of every line, columns first. Two arterials cross somewhere in a city; a quiet quarter has at most one."""
    names: list[StreetClass] = ["arterial", "collector", "residential"]
    probabilities = [0.0, 0.42, 0.58] if quiet else [0.3, 0.37, 0.33]
    classes: list[StreetClass] = [names[int(k)] for k in rng.choice(3, columns + rows, p=probabilities)]
    # then overruled: a quiet quarter may get one arterial, a city gets two that cross
    if quiet and rng.random() < 0.6:
        classes[int(rng.integers(columns + rows))] = "arterial"
    if not quiet:
        classes[int(rng.integers(columns))] = "arterial"
        classes[columns + int(rng.integers(rows))] = "arterial"
    return classes


def _draw_grid(rng: np.random.Generator, columns: int, rows: int) -> Float[np.ndarray, "c r 2"]:
    """Node positions: irregular, sheared, rotated."""
    widest = 200.0 if max(columns, rows) == 3 else 150.0
    x = np.concatenate([[0.0], np.cumsum(rng.uniform(90, widest, columns - 1))])
    y = np.concatenate([[0.0], np.cumsum(rng.uniform(90, widest, rows - 1))])
    grid = np.stack(np.meshgrid(x - x.mean(), y - y.mean(), indexing="ij"), axis=-1)
    # irregular, then sheared, then turned: no two streets of a city are parallel to an axis
    grid += np.clip(rng.normal(0, 8.0, grid.shape), -14, 14)
    grid[..., 0] += rng.uniform(-0.25, 0.25) * grid[..., 1]
    return grid @ rotation_matrix(rng.uniform(0, 2 * np.pi)).T


def _draw_lanes(rng: np.random.Generator, profile: _LineProfile, gutter_m: float) -> tuple[PlannedLane, ...]:
    """Lanes of one direction from right to left."""
    parking_probability = {"arterial": 0.06, "collector": 0.4, "residential": 0.75}[profile.street_class]
    lanes = [PlannedLane("sidewalk", float(rng.uniform(1.6, 2.6))), PlannedLane("gutter", gutter_m)]
    if rng.random() < parking_probability:
        lanes.append(PlannedLane("parking", 2.3))
    if profile.bicycle:
        lanes.append(PlannedLane("bicycle", 1.6))
    lanes += [PlannedLane("travel", profile.lane_width_m)] * profile.travel_lanes
    return tuple(lanes)


def _both_directions(rng: np.random.Generator, profile: _LineProfile, start: Node, end: Node) -> Iterator[Street]:
    """Both directions of a street, each with a separate strip of parking."""
    # The line between the directions is straight or bulges. The squared sine keeps both ends straight, where junctions
    # are cut out.
    direction = end.position - start.position
    length = float(np.linalg.norm(direction))
    s = np.linspace(0, 1, max(31, int(length / 4)))
    middle = start.position + s[:, None] * direction  # [n, 2]
    if rng.random() < 0.6:
        bulge = np.clip(rng.normal(0, 0.035 * length), -0.08 * length, 0.08 * length) * np.sin(np.pi * s) ** 2
        middle = middle + bulge[:, None] * (np.array([-direction[1], direction[0]]) / length)
    gutter = float(rng.uniform(0.3, 2.0))
    for tail, head, line in ((start, end, middle), (end, start, middle[::-1])):
        yield Street(
            street_id=f"{tail.node_id}to{head.node_id}",
            from_node=tail.node_id,
            to_node=head.node_id,
            points=offset_polyline(line, -profile.median_m / 2),
            street_class=profile.street_class,
            lanes=_draw_lanes(rng, profile, gutter),
            speed_mps=profile.speed_mps,
            priority=profile.priority,
            reverse_id=None if profile.median_m else f"{head.node_id}to{tail.node_id}",
        )


def _draw_links(
    rng: np.random.Generator, columns: int, rows: int, classes: list[StreetClass]
) -> list[tuple[tuple[int, int], tuple[int, int], int]]:
    """Streets of the grid as (node, node, line); minor streets dropped as long as all nodes stay connected."""
    # nodes are (column, row), lines are numbered columns first
    links = [((i, j), (i, j + 1), i) for i in range(columns) for j in range(rows - 1)]
    links += [((i, j), (i + 1, j), columns + j) for i in range(columns - 1) for j in range(rows)]
    probability = rng.uniform(0.18, 0.25)
    for link in [links[int(k)] for k in rng.permutation(len(links))]:
        if classes[link[2]] == "arterial" or rng.random() >= probability:
            continue
        remaining = [candidate for candidate in links if candidate is not link]
        # a street may go if all nodes are still connected
        directed_links = [pair for a, b, _ in remaining for pair in ((a, b), (b, a))]
        if len(find_reachable((0, 0), directed_links)) == columns * rows:
            links = remaining
    return links


def _draw_control(
    rng: np.random.Generator, crossing: tuple[StreetClass, StreetClass], degree: int, lights: float
) -> Control:
    """Right of way at a node of the grid, by the classes that cross there.

    Args:
        rng: Generator of the choice; a bend draws nothing.
        crossing: Street classes of the column and of the row.
        degree: Number of streets that meet; up to 2 make a bend.
        lights: Factor of the probability of traffic lights, 1 in a city.
    """
    # at a bend there is nothing to give way to
    if degree <= 2:
        return "priority"
    classes = frozenset(crossing)
    draw = rng.random()
    if classes == {"arterial"}:
        return "traffic_light" if draw < lights else "allway_stop"
    if classes == {"arterial", "collector"}:
        return "traffic_light" if draw < 0.55 * lights else "priority_stop"
    if classes == {"collector"}:
        return "traffic_light" if draw < 0.3 * lights else "allway_stop" if draw < 0.7 else "priority_stop"
    if classes == {"residential"}:
        return "allway_stop" if draw < 0.35 else "priority_stop" if draw < 0.65 else "right_before_left"
    return "allway_stop" if classes == {"collector", "residential"} and draw < 0.35 else "priority_stop"


def _stub_ends(
    rng: np.random.Generator, grid: Float[np.ndarray, "c r 2"], classes: list[StreetClass]
) -> list[tuple[tuple[int, int], np.ndarray, int]]:
    """Streets by which traffic enters, as (node, outer end, line): one or none at each end of every line."""
    columns, rows = grid.shape[:2]
    ends = [((i, j), (i, inner), i) for i in range(columns) for j, inner in ((0, 1), (rows - 1, rows - 2))]
    borders = ((0, 1), (columns - 1, columns - 2))
    ends += [((i, j), (inner, j), columns + j) for j in range(rows) for i, inner in borders]
    stubs = []
    for outer, inner, line in ends:
        if classes[line] != "arterial" and rng.random() < 0.25:
            continue
        direction = grid[outer] - grid[inner]
        direction /= np.linalg.norm(direction)
        stubs.append((outer, grid[outer] + direction * rng.uniform(130, 170), line))
    return stubs


def draw_city_plan(rng: np.random.Generator, quiet: bool = False) -> StreetPlan:
    """Irregular grid of arterials, collectors and residential streets with stubs where traffic enters.

    Args:
        rng: Generator of all choices; equal states give equal plans.
        quiet: True = a quarter of minor streets with at most one arterial and hardly any lights.

    Returns:
        A connected plan; every node but the fringe has a control that fits the classes of the streets at the node.
    """
    # 1. The grid: classes of lines, positions of nodes, streets between nodes and out of the network.
    columns, rows = int(rng.integers(3, 5)), int(rng.integers(3, 5))
    classes = _draw_classes(rng, columns, rows, quiet)
    profiles = [_draw_profile(rng, street_class, line < columns, quiet) for line, street_class in enumerate(classes)]
    grid = _draw_grid(rng, columns, rows)
    links = _draw_links(rng, columns, rows, classes)
    stubs = _stub_ends(rng, grid, classes)
    # shrunk if it is too large, so that every network fits into the same circle
    reach = max(float(np.linalg.norm(end)) for _, end, _ in stubs)
    shrink = min(1.0, MAX_RADIUS_M / reach)
    # 2. Nodes, whose control depends on the number of streets that meet there.
    degree = Counter([node for *pair, _ in links for node in pair] + [node for node, *_ in stubs])
    inner = {}
    for i, j in np.ndindex(columns, rows):
        crossing = (classes[i], classes[columns + j])
        control = _draw_control(rng, crossing, degree[i, j], 0.2 if quiet else 1.0)
        inner[i, j] = Node(f"n{i}{j}", grid[i, j] * shrink, control)
    fringe = [Node(f"f{k}", end * shrink, "dead_end", is_fringe=True) for k, (_, end, _) in enumerate(stubs)]
    # 3. Both directions of every street.
    streets: list[Street] = []
    for a, b, line in links:
        streets += _both_directions(rng, profiles[line], inner[a], inner[b])
    for node, (a, _, line) in zip(fringe, stubs, strict=True):
        streets += _both_directions(rng, profiles[line], node, inner[a])
    return StreetPlan("quiet" if quiet else "city", (*inner.values(), *fringe), tuple(streets))


# --- freeways: two carriageways on one arc, with ramps ---------------------------------------------------------------


@dataclass(frozen=True)
class _Carriageway:
    """One direction of a freeway: cuts along the arc and the properties that all segments share."""

    name: str
    curvature: float
    cuts_m: tuple[float, ...]
    lanes: int
    width_m: float
    median_half_m: float
    speed_mps: float
    gutter_m: float
    turn: Float[np.ndarray, "2 2"]

    def inner_border(self, low_m: float, high_m: float) -> Float[np.ndarray, "n 2"]:
        """Left border of a stretch, in driving direction.

        Args:
            low_m: Arc length where the stretch begins, m.
            high_m: Arc length where the stretch ends, m.
        """
        s = np.linspace(low_m, high_m, max(8, int((high_m - low_m) / 8)))
        # points of a circle through (0, 0) heading along +x; without curvature a straight line
        arc = np.stack([s, np.zeros_like(s)], axis=1)
        if abs(self.curvature) >= 1e-6:
            angle = self.curvature * s
            arc = np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1) / self.curvature
        return offset_polyline(arc, -self.median_half_m) @ self.turn.T

    def segment(self, index: int, extra_lanes: int) -> Street:
        """Street between two cuts.

        Args:
            index: Number of the cut where the street begins; the next cut ends it.
            extra_lanes: Number of lanes to the right of the through lanes.
        """
        return Street(
            street_id=f"{self.name}{index}",
            from_node=f"{self.name}n{index}",
            to_node=f"{self.name}n{index + 1}",
            points=self.inner_border(self.cuts_m[index], self.cuts_m[index + 1]),
            street_class="freeway",
            lanes=(PlannedLane("gutter", self.gutter_m),)
            + (PlannedLane("travel", self.width_m),) * (self.lanes + extra_lanes),
            speed_mps=self.speed_mps,
            priority=PRIORITY["freeway"],
        )

    def taper(self, at_m: float, towards_m: float) -> Float[np.ndarray, "3 2"]:
        """Triangle of pavement beside the through lanes, where an extra lane begins or ends.

        Args:
            at_m: Arc length where the triangle is as wide as a lane, m.
            towards_m: Arc length where the triangle has no width, m.
        """
        low, high = sorted((at_m, towards_m))
        border = self.inner_border(low, high)
        through = offset_polyline(border, -self.lanes * self.width_m - self.gutter_m + 0.2)
        widened = offset_polyline(border, -(self.lanes + 1) * self.width_m - self.gutter_m)
        at, towards = (0, -1) if at_m == low else (-1, 0)
        return np.stack([through[at], widened[at], through[towards]])


def _ramp(rng: np.random.Generator, road: _Carriageway, on: bool) -> Street:
    """On-ramp that ends where segment 1 begins, or off-ramp that begins where segment 3 ends.

    The ramp touches the carriageway tangentially.
    """
    joint = road.cuts_m[1] if on else road.cuts_m[4]
    length, spread = rng.uniform(160, 200), rng.uniform(34, 48)
    low, high = (joint - length, joint) if on else (joint, joint + length)
    border = offset_polyline(road.inner_border(low, high), -road.lanes * road.width_m)
    # distance from the carriageway grows with a power above 2: neither a kink nor a jump of curvature at the joint
    share = np.linspace(1.0, 0.0, len(border)) if on else np.linspace(0.0, 1.0, len(border))
    points = border + spread * (share**2.2)[:, None] * (offset_polyline(border, -1.0) - border)
    name = road.name
    inner, outer = (f"{name}n1", f"{name}on") if on else (f"{name}n4", f"{name}off")
    return Street(
        street_id=f"{outer}ramp",
        from_node=outer if on else inner,
        to_node=inner if on else outer,
        points=points,
        street_class="ramp",
        lanes=(PlannedLane("gutter", road.gutter_m), PlannedLane("travel", road.width_m)),
        speed_mps=float(rng.uniform(16, 20)),
        priority=PRIORITY["ramp"],
    )


def draw_freeway_plan(rng: np.random.Generator) -> StreetPlan:
    """Two carriageways on one arc, each with an on-ramp, an acceleration lane, a deceleration lane and an off-ramp."""
    curvature = float(np.clip(rng.normal(0, 1 / 1200), -1 / 800, 1 / 800))
    angle = rng.uniform(0, 2 * np.pi)
    width, gutter = float(rng.uniform(3.5, 3.8)), float(rng.uniform(1.2, 3.0))
    median_half, speed = float(rng.uniform(2.0, 6.0)), float(rng.uniform(24.6, 27.5))
    nodes: list[Node] = []
    streets: list[Street] = []
    links: list[Connection] = []
    tapers: list[np.ndarray] = []
    # the second carriageway follows the same arc the other way: turned by 180 degrees, with the opposite curvature
    for name, flip in (("a", 1.0), ("b", -1.0)):
        turn = rotation_matrix(angle) * flip
        on, off = rng.uniform(-190, -130), rng.uniform(130, 190)
        cuts = (-470.0, on, on + rng.uniform(130, 170), off - rng.uniform(90, 120), off, 470.0)
        lanes = int(rng.integers(3, 5))
        carriageway = _Carriageway(name, flip * curvature, cuts, lanes, width, median_half, speed, gutter, turn)
        # a node at every cut; at both ends traffic enters and leaves
        for index, cut in enumerate(cuts):
            position = carriageway.inner_border(cut, cut + 1)[0]
            end = index in (0, len(cuts) - 1)
            nodes.append(Node(f"{name}n{index}", position, "dead_end" if end else "priority", is_fringe=end))
        segments = [carriageway.segment(k, 1 if k in (1, 3) else 0) for k in range(5)]
        on_ramp, off_ramp = _ramp(rng, carriageway, on=True), _ramp(rng, carriageway, on=False)
        nodes.append(Node(f"{name}on", on_ramp.points[0], "dead_end", is_fringe=True))
        nodes.append(Node(f"{name}off", off_ramp.points[-1], "dead_end", is_fringe=True))
        streets += [*segments, on_ramp, off_ramp]
        # through lanes go straight on; lane 1 (lane 0 is the gutter) of segments 1 and 3 belongs to the ramps
        for lane in range(1, carriageway.lanes + 1):
            numbers = (lane, lane + 1, lane, lane + 1, lane)
            links += [Connection(f"{name}{k}", f"{name}{k + 1}", numbers[k], numbers[k + 1]) for k in range(4)]
        links += [Connection(f"{name}onramp", f"{name}1", 1, 1), Connection(f"{name}3", f"{name}offramp", 1, 1)]
        tapers += [carriageway.taper(cuts[2], cuts[2] + 60), carriageway.taper(cuts[3], cuts[3] - 60)]
    return StreetPlan("freeway", tuple(nodes), tuple(streets), tuple(links), tuple(tapers))
