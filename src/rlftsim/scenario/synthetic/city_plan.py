"""City plans: irregular, sheared and bent grids of streets of three classes."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from rlftsim.scenario.synthetic.street_plan import (
    MAX_RADIUS_M,
    PRIORITY,
    Control,
    Node,
    PlannedLane,
    Street,
    StreetClass,
    StreetPlan,
    find_reachable,
    offset_polyline,
    rotation_matrix,
)


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


def _both_directions(rng: np.random.Generator, profile: _LineProfile, start: Node, end: Node) -> tuple[Street, Street]:
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
    degree = np.zeros((columns, rows), int)
    for a, b, _ in links:
        degree[a] += 1
        degree[b] += 1
    for a, _, _ in stubs:
        degree[a] += 1
    inner = {}
    for i, j in np.ndindex(columns, rows):
        crossing = (classes[i], classes[columns + j])
        control = _draw_control(rng, crossing, int(degree[i, j]), 0.2 if quiet else 1.0)
        inner[i, j] = Node(f"n{i}{j}", grid[i, j] * shrink, control)
    fringe = [Node(f"f{k}", end * shrink, "dead_end", is_fringe=True) for k, (_, end, _) in enumerate(stubs)]
    # 3. Both directions of every street.
    streets: list[Street] = []
    for a, b, line in links:
        streets += _both_directions(rng, profiles[line], inner[a], inner[b])
    for node, (a, _, line) in zip(fringe, stubs, strict=True):
        streets += _both_directions(rng, profiles[line], node, inner[a])
    return StreetPlan("quiet" if quiet else "city", (*inner.values(), *fringe), tuple(streets))
