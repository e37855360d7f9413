"""Street plans drawn from a seed: what is built, before any simulator sees it.

A plan is a list of nodes and *directed* streets in metres around (0, 0). The shape of a street is its left border (the line between the
two directions); its lanes lie to the right of it and are listed from right to left, as SUMO counts them.
"""

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

LaneKind = Literal["sidewalk", "gutter", "parking", "bicycle", "travel"]
"""A gutter is the paved width between the outermost usable lane and the road edge; nobody may use it, as the parking strip."""
Control = Literal["traffic_light", "allway_stop", "priority_stop", "right_before_left", "priority", "dead_end"]
StreetClass = Literal["arterial", "collector", "residential", "freeway", "ramp"]

MAX_RADIUS_M = 485.0
"""No node lies farther from (0, 0)."""
_PRIORITY = {"freeway": 12, "ramp": 8, "arterial": 9, "collector": 6, "residential": 3}


@dataclass(frozen=True)
class PlannedLane:
    """One lane of a street."""

    kind: LaneKind
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
    """The opposite direction sharing the left border; None beside a median or where there is none."""

    @property
    def roadway_width_m(self) -> float:
        """Width of all lanes but sidewalks."""
        return sum(lane.width_m for lane in self.lanes if lane.kind != "sidewalk")


@dataclass(frozen=True)
class Connection:
    """Explicit link between lanes; a plan without any leaves them to the network compiler."""

    from_street: str
    to_street: str
    from_lane: int
    to_lane: int


@dataclass(frozen=True, eq=False)
class StreetPlan:
    """Everything the network compiler needs, and what it would forget."""

    kind: Literal["city", "quiet", "freeway"]
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
    """Polyline moved sideways by `left_m` metres (negative = to the right), corners mitred up to twice the distance."""
    delta = np.diff(points, axis=0)
    delta /= np.maximum(np.linalg.norm(delta, axis=1, keepdims=True), 1e-9)
    normal = np.stack([-delta[:, 1], delta[:, 0]], axis=1)
    before = np.concatenate([normal[:1], normal])
    after = np.concatenate([normal, normal[-1:]])
    bisector = before + after
    scale = np.maximum((bisector * before).sum(1, keepdims=True), 0.5)
    return points + left_m * bisector / scale


# --- city ----------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _LineProfile:
    """What all streets of one line of the grid have in common."""

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
    bicycle_share = {"arterial": 0.25, "collector": 0.33, "residential": 0.0}[street_class]
    return _LineProfile(
        street_class=street_class,
        travel_lanes=lanes,
        lane_width_m=float(rng.uniform(3.0, 3.8)),
        speed_mps=float(rng.uniform(low, high)),
        median_m=3.0 if street_class == "arterial" and rng.random() < 0.45 else 0.0,
        bicycle=bool(rng.random() < bicycle_share),
        priority=_PRIORITY[street_class] + int(is_column),
    )


def _draw_classes(rng: np.random.Generator, columns: int, rows: int, quiet: bool) -> list[StreetClass]:
    """Class of every line, columns first. Two arterials cross somewhere in a city; a quiet quarter has at most one."""
    names: list[StreetClass] = ["arterial", "collector", "residential"]
    shares = [0.0, 0.42, 0.58] if quiet else [0.3, 0.37, 0.33]
    classes = [names[int(k)] for k in rng.choice(3, columns + rows, p=shares)]
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
    grid += np.clip(rng.normal(0, 8.0, grid.shape), -14, 14)
    grid[..., 0] += rng.uniform(-0.25, 0.25) * grid[..., 1]
    angle = rng.uniform(0, 2 * np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return grid @ turn.T


def _curve(rng: np.random.Generator, start: np.ndarray, end: np.ndarray) -> Float[np.ndarray, "n 2"]:
    """Straight or bulging line; the squared sine keeps both ends straight, where a junction is cut out."""
    length = float(np.linalg.norm(end - start))
    s = np.linspace(0, 1, max(31, int(length / 4)))
    points = start + s[:, None] * (end - start)
    if rng.random() >= 0.6:
        return points
    direction = (end - start) / length
    bulge = np.clip(rng.normal(0, 0.035 * length), -0.08 * length, 0.08 * length) * np.sin(np.pi * s) ** 2
    return points + bulge[:, None] * np.array([-direction[1], direction[0]])


def _draw_lanes(rng: np.random.Generator, profile: _LineProfile, gutter_m: float) -> tuple[PlannedLane, ...]:
    parking_share = {"arterial": 0.06, "collector": 0.4, "residential": 0.75}[profile.street_class]
    lanes = [PlannedLane("sidewalk", float(rng.uniform(1.6, 2.6))), PlannedLane("gutter", gutter_m)]
    if rng.random() < parking_share:
        lanes.append(PlannedLane("parking", 2.3))
    if profile.bicycle:
        lanes.append(PlannedLane("bicycle", 1.6))
    lanes += [PlannedLane("travel", profile.lane_width_m)] * profile.travel_lanes
    return tuple(lanes)


def _both_directions(rng: np.random.Generator, profile: _LineProfile, start: Node, end: Node) -> tuple[Street, Street]:
    """The two directions of one street, each with its own strip of parking."""
    middle = _curve(rng, start.position, end.position)
    gutter = float(rng.uniform(0.3, 2.0))
    ids = (f"{start.node_id}to{end.node_id}", f"{end.node_id}to{start.node_id}")
    forward = Street(
        street_id=ids[0],
        from_node=start.node_id,
        to_node=end.node_id,
        points=offset_polyline(middle, -profile.median_m / 2),
        street_class=profile.street_class,
        lanes=_draw_lanes(rng, profile, gutter),
        speed_mps=profile.speed_mps,
        priority=profile.priority,
        reverse_id=None if profile.median_m else ids[1],
    )
    backward = replace(
        forward,
        street_id=ids[1],
        from_node=end.node_id,
        to_node=start.node_id,
        points=offset_polyline(middle[::-1], -profile.median_m / 2),
        lanes=_draw_lanes(rng, profile, gutter),
        reverse_id=None if profile.median_m else ids[0],
    )
    return forward, backward


def _is_connected(nodes: set[str], links: list[tuple[str, str]]) -> bool:
    reached, frontier = set(), [next(iter(nodes))]
    while frontier:
        here = frontier.pop()
        if here in reached:
            continue
        reached.add(here)
        frontier += [b if a == here else a for a, b in links if here in (a, b)]
    return reached >= nodes


def _draw_links(
    rng: np.random.Generator, columns: int, rows: int, classes: list[StreetClass]
) -> list[tuple[tuple[int, int], tuple[int, int], int]]:
    """Streets of the grid as (node, node, line); some minor ones dropped as long as all nodes stay connected."""
    links = [((i, j), (i, j + 1), i) for i in range(columns) for j in range(rows - 1)]
    links += [((i, j), (i + 1, j), columns + j) for i in range(columns - 1) for j in range(rows)]
    share = rng.uniform(0.18, 0.25)
    nodes = {f"{i}.{j}" for i in range(columns) for j in range(rows)}
    for link in [links[int(k)] for k in rng.permutation(len(links))]:
        if classes[link[2]] == "arterial" or rng.random() >= share:
            continue
        rest = [other for other in links if other is not link]
        if _is_connected(nodes, [(f"{a[0]}.{a[1]}", f"{b[0]}.{b[1]}") for a, b, _ in rest]):
            links = rest
    return links


def _draw_control(
    rng: np.random.Generator, crossing: tuple[StreetClass, StreetClass], degree: int, lights: float
) -> Control:
    """Who gives way at a node of the grid; `lights` scales how eager the quarter is to build lights."""
    if degree <= 2:
        return "priority"
    kinds = frozenset(crossing)
    draw = rng.random()
    if kinds == {"arterial"}:
        return "traffic_light" if draw < lights else "allway_stop"
    if kinds == {"arterial", "collector"}:
        return "traffic_light" if draw < 0.55 * lights else "priority_stop"
    if kinds == {"collector"}:
        return "traffic_light" if draw < 0.3 * lights else "allway_stop" if draw < 0.7 else "priority_stop"
    if kinds == {"residential"}:
        return "allway_stop" if draw < 0.35 else "priority_stop" if draw < 0.65 else "right_before_left"
    return "allway_stop" if kinds == {"collector", "residential"} and draw < 0.35 else "priority_stop"


def _stub_ends(
    rng: np.random.Generator, grid: Float[np.ndarray, "c r 2"], classes: list[StreetClass]
) -> list[tuple[tuple[int, int], np.ndarray, int]]:
    """Where traffic enters: (node, outer end, line) for the two ends of every line."""
    columns, rows = grid.shape[:2]
    ends = [((i, j), (i, inner), i) for i in range(columns) for j, inner in ((0, 1), (rows - 1, rows - 2))]
    ends += [
        ((i, j), (inner, j), columns + j) for j in range(rows) for i, inner in ((0, 1), (columns - 1, columns - 2))
    ]
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
        rng: decides everything.
        quiet: a quarter of minor streets, at most one arterial, hardly any lights.

    Returns:
        A connected plan; every node but the fringe has a control fitting the classes that meet there.
    """
    columns, rows = int(rng.integers(3, 5)), int(rng.integers(3, 5))
    classes = _draw_classes(rng, columns, rows, quiet)
    profiles = [_draw_profile(rng, kind, line < columns, quiet) for line, kind in enumerate(classes)]
    grid = _draw_grid(rng, columns, rows)
    links = _draw_links(rng, columns, rows, classes)
    stubs = _stub_ends(rng, grid, classes)
    reach = max(float(np.linalg.norm(end)) for _, end, _ in stubs)
    shrink = min(1.0, MAX_RADIUS_M / reach)
    degree = np.zeros((columns, rows), int)
    for a, b, _ in links:
        degree[a] += 1
        degree[b] += 1
    for a, _, _ in stubs:
        degree[a] += 1
    inner = {
        (i, j): Node(
            f"n{i}{j}",
            grid[i, j] * shrink,
            _draw_control(rng, (classes[i], classes[columns + j]), int(degree[i, j]), 0.2 if quiet else 1.0),
        )
        for i in range(columns)
        for j in range(rows)
    }
    fringe = [Node(f"f{k}", end * shrink, "dead_end", is_fringe=True) for k, (_, end, _) in enumerate(stubs)]
    streets: list[Street] = []
    for a, b, line in links:
        streets += _both_directions(rng, profiles[line], inner[a], inner[b])
    for node, (a, _, line) in zip(fringe, stubs, strict=True):
        streets += _both_directions(rng, profiles[line], node, inner[a])
    return StreetPlan("quiet" if quiet else "city", (*inner.values(), *fringe), tuple(streets))


# --- freeway -------------------------------------------------------------------------------------------------------------------


def _arc(curvature: float, s: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 2"]:
    """Points at arc lengths `s` of a circle through (0, 0) heading along +x."""
    if abs(curvature) < 1e-6:
        return np.stack([s, np.zeros_like(s)], axis=1)
    return np.stack([np.sin(curvature * s), 1 - np.cos(curvature * s)], axis=1) / curvature


@dataclass(frozen=True)
class _Carriageway:
    """One direction of a freeway: cuts along the arc and what the segments have in common."""

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
        """Left border between two arc lengths, driving direction."""
        s = np.linspace(low_m, high_m, max(8, int((high_m - low_m) / 8)))
        return offset_polyline(_arc(self.curvature, s), -self.median_half_m) @ self.turn.T

    def segment(self, index: int, extra_lanes: int) -> Street:
        """Stretch between two cuts."""
        return Street(
            street_id=f"{self.name}{index}",
            from_node=f"{self.name}n{index}",
            to_node=f"{self.name}n{index + 1}",
            points=self.inner_border(self.cuts_m[index], self.cuts_m[index + 1]),
            street_class="freeway",
            lanes=(PlannedLane("gutter", self.gutter_m),)
            + (PlannedLane("travel", self.width_m),) * (self.lanes + extra_lanes),
            speed_mps=self.speed_mps,
            priority=_PRIORITY["freeway"],
        )

    def taper(self, at_m: float, towards_m: float) -> Float[np.ndarray, "3 2"]:
        """Triangle beside the through lanes, full width at `at_m`, nothing at `towards_m`."""
        low, high = sorted((at_m, towards_m))
        border = self.inner_border(low, high)
        through = offset_polyline(border, -self.lanes * self.width_m - self.gutter_m + 0.2)
        widened = offset_polyline(border, -(self.lanes + 1) * self.width_m - self.gutter_m)
        at, towards = (0, -1) if at_m == low else (-1, 0)
        return np.stack([through[at], widened[at], through[towards]])


def _ramp(rng: np.random.Generator, way: _Carriageway, on: bool) -> Street:
    """On-ramp ending where segment 1 begins, or off-ramp beginning where segment 3 ends; leaves the carriageway tangentially."""
    joint = way.cuts_m[1] if on else way.cuts_m[4]
    length, spread = rng.uniform(160, 200), rng.uniform(34, 48)
    low, high = (joint - length, joint) if on else (joint, joint + length)
    border = offset_polyline(way.inner_border(low, high), -way.lanes * way.width_m)
    away = np.linspace(1.0, 0.0, len(border)) if on else np.linspace(0.0, 1.0, len(border))
    points = border + spread * (away**2.2)[:, None] * (offset_polyline(border, -1.0) - border)
    inner, outer = (f"{way.name}n1", f"{way.name}on") if on else (f"{way.name}n4", f"{way.name}off")
    return Street(
        street_id=f"{way.name}{'on' if on else 'off'}ramp",
        from_node=outer if on else inner,
        to_node=inner if on else outer,
        points=points,
        street_class="ramp",
        lanes=(PlannedLane("gutter", way.gutter_m), PlannedLane("travel", way.width_m)),
        speed_mps=float(rng.uniform(16, 20)),
        priority=_PRIORITY["ramp"],
    )


def _carriageway_connections(way: _Carriageway) -> list[Connection]:
    """Through lanes straight on; lane 1 (lane 0 is the gutter) of segments 1 and 3 belongs to the ramps."""
    name = way.name
    links = []
    for lane in range(1, way.lanes + 1):
        links.append(Connection(f"{name}0", f"{name}1", lane, lane + 1))
        links.append(Connection(f"{name}1", f"{name}2", lane + 1, lane))
        links.append(Connection(f"{name}2", f"{name}3", lane, lane + 1))
        links.append(Connection(f"{name}3", f"{name}4", lane + 1, lane))
    links.append(Connection(f"{name}onramp", f"{name}1", 1, 1))
    links.append(Connection(f"{name}3", f"{name}offramp", 1, 1))
    return links


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
    for name, flip in (("a", 1.0), ("b", -1.0)):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) * flip
        on, off = rng.uniform(-190, -130), rng.uniform(130, 190)
        cuts = (-470.0, on, on + rng.uniform(130, 170), off - rng.uniform(90, 120), off, 470.0)
        way = _Carriageway(
            name, flip * curvature, cuts, int(rng.integers(3, 5)), width, median_half, speed, gutter, turn
        )
        for index, cut in enumerate(cuts):
            place = way.inner_border(cut, cut + 1)[0]
            end = index in (0, len(cuts) - 1)
            nodes.append(Node(f"{name}n{index}", place, "dead_end" if end else "priority", is_fringe=end))
        segments = [way.segment(k, 1 if k in (1, 3) else 0) for k in range(5)]
        on_ramp, off_ramp = _ramp(rng, way, on=True), _ramp(rng, way, on=False)
        nodes.append(Node(f"{name}on", on_ramp.points[0], "dead_end", is_fringe=True))
        nodes.append(Node(f"{name}off", off_ramp.points[-1], "dead_end", is_fringe=True))
        streets += [*segments, on_ramp, off_ramp]
        links += _carriageway_connections(way)
        tapers += [way.taper(cuts[2], cuts[2] + 60), way.taper(cuts[3], cuts[3] - 60)]
    return StreetPlan("freeway", tuple(nodes), tuple(streets), tuple(links), tuple(tapers))
