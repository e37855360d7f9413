"""Freeway plans: two carriageways on one arc with on-ramps, off-ramps, acceleration and deceleration lanes."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rlftsim.scenario.synthetic.street_plan import (
    PRIORITY,
    Connection,
    Node,
    PlannedLane,
    Street,
    StreetPlan,
    offset_polyline,
)


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
            priority=PRIORITY["freeway"],
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
        priority=PRIORITY["ramp"],
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
