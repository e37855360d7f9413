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
    rotation_matrix,
)


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
