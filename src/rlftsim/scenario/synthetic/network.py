"""The compiled network, read back: lanes, connectors through junctions, crosswalks, traffic lights."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float

from rlftsim.scenario.polylines import arc_length
from rlftsim.scenario.synthetic.street_plan import Street, StreetPlan

LaneKey = tuple[str, int]
"""Street id and lane index."""


@dataclass(frozen=True, eq=False)
class Lane:
    """A lane as compiled: on a street (`street` set) or inside a junction."""

    lane_id: str
    shape: Float[np.ndarray, "n 2"]
    length_m: float
    """Length that SUMO drives; may differ from the length of the shape."""
    width_m: float
    speed_mps: float
    lane_type: str
    """Type of the planned lane, or "internal", "crossing", "walkingarea"."""
    street: Street | None = None
    index: int = 0

    @cached_property
    def _distances(self) -> Float[np.ndarray, "n"]:
        return arc_length(self.shape)

    def points_at(self, positions_m: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m 2"]:
        """Points on the center line.

        Args:
            positions_m: Positions of SUMO, m, along the nominal length, which differs from the length of the shape.
        """
        distances = positions_m * (self._distances[-1] / max(self.length_m, 1e-3))
        return np.stack([np.interp(distances, self._distances, self.shape[:, k]) for k in range(2)], axis=1)

    def directions_at(self, positions_m: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m 2"]:
        """Unit tangents of the center line over one meter.

        Args:
            positions_m: Positions of SUMO along the nominal length, m, as in `points_at`.
        """
        reach = min(0.5, 0.4 * self.length_m)
        middle = np.clip(positions_m, reach, max(self.length_m - reach, reach))
        delta = self.points_at(middle + reach) - self.points_at(middle - reach)
        return delta / np.maximum(np.linalg.norm(delta, axis=1, keepdims=True), 1e-9)


@dataclass(frozen=True, eq=False)
class Connector:
    """A path through a junction: the internal lanes from stop line to exit, joined."""

    from_lane: LaneKey
    to_lane: LaneKey
    lane_id: str
    """Id of the first internal lane."""
    shape: Float[np.ndarray, "n 2"]
    width_m: float
    speed_mps: float
    is_bicycle: bool
    junction: str
    direction: str
    """SUMO's letter: s straight, l left, r right, t turn around, L and R partly."""
    state: str
    """SUMO's letter of the right of way; s and w mean a stop sign."""
    light: str | None
    link_index: int


@dataclass(frozen=True, eq=False)
class Network:
    """A plan as compiled by SUMO."""

    plan: StreetPlan
    lanes: dict[str, Lane]
    connectors: tuple[Connector, ...]
    junction_shapes: dict[str, Float[np.ndarray, "_ 2"]]
    crosswalks: tuple[tuple[str, Float[np.ndarray, "_ 2"], float], ...]
    """Junction, center line, width in meters."""
    lights: tuple[str, ...]

    def lane(self, key: LaneKey) -> Lane:
        """Lane of a street by index."""
        return self.lanes[f"{key[0]}_{key[1]}"]


def _points(text: str) -> Float[np.ndarray, "n 2"]:
    """Points of a shape attribute, "x,y x,y ..."; a height is dropped."""
    return np.array([[float(value) for value in pair.split(",")[:2]] for pair in text.split()])


def join_shapes(shapes: list[Float[np.ndarray, "_ 2"]]) -> Float[np.ndarray, "n 2"]:
    """Polylines put end to end, doubled points removed."""
    points = np.concatenate(shapes)
    keep = np.append(True, np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-3)
    return points[keep]


def _read_connectors(root: ElementTree.Element, lanes: dict[str, Lane]) -> Iterator[Connector]:
    """Paths of vehicles and bicycles through all junctions."""
    rows = list(root.iter("connection"))
    # rows from ":..." lead out of an internal lane, and so on to the next lane of a path
    onward = {f"{row.get('from')}_{row.get('fromLane')}": row for row in rows if row.get("from", "").startswith(":")}
    for row in rows:
        origin = lanes.get(f"{row.get('from')}_{row.get('fromLane')}")
        if origin is None or origin.street is None or not row.get("via"):
            continue
        if origin.lane_type not in ("travel", "bicycle"):
            continue
        # a path may consist of several internal lanes, e.g. where left turns wait inside the junction
        lane_ids = [row.get("via", "")]
        while onward[lane_ids[-1]].get("via"):
            lane_ids.append(onward[lane_ids[-1]].get("via", ""))
        goal = lanes[f"{row.get('to')}_{row.get('toLane')}"]
        yield Connector(
            from_lane=(origin.street.street_id, origin.index),
            to_lane=(row.get("to", ""), int(row.get("toLane", 0))),
            lane_id=lane_ids[0],
            shape=join_shapes([lanes[lane_id].shape for lane_id in lane_ids]),
            width_m=min(origin.width_m, goal.width_m),
            speed_mps=lanes[lane_ids[0]].speed_mps,
            is_bicycle="bicycle" in (origin.lane_type, goal.lane_type),
            junction=origin.street.to_node,
            direction=row.get("dir", "s"),
            state=row.get("state", "M"),
            light=row.get("tl"),
            link_index=int(row.get("linkIndex", 0)),
        )


def read_network(path: Path, plan: StreetPlan) -> Network:
    """Parse a compiled network file.

    Args:
        path: Network file that netconvert wrote, XML.
        plan: Plan that the network was compiled from, for the types of lanes.
    """
    root = ElementTree.parse(path).getroot()
    # 1. Lanes: those of streets have their types from the plan, because the compiler drops types.
    streets = {street.street_id: street for street in plan.streets}
    lanes = {}
    for edge in root.iter("edge"):
        street = streets.get(edge.get("id", ""))
        for row in edge.iter("lane"):
            index = int(row.get("index", 0))
            lane_type = street.lanes[index].lane_type if street else edge.get("function", "internal")
            lanes[row.get("id", "")] = Lane(
                lane_id=row.get("id", ""),
                shape=_points(row.get("shape", "")),
                length_m=float(row.get("length", 0)),
                width_m=float(row.get("width", 3.2)),
                speed_mps=float(row.get("speed", 0)),
                lane_type=lane_type,
                street=street,
                index=index,
            )
    # 2. Junctions and their crosswalks, whose lanes are named ":junction_number_0".
    junctions = [row for row in root.iter("junction") if row.get("type") != "internal"]
    outlines = {row.get("id", ""): row.get("shape", "") for row in junctions}
    shapes = {junction: _points(outline) for junction, outline in outlines.items() if len(outline.split()) >= 3}
    crossings = [lane for lane in lanes.values() if lane.lane_type == "crossing"]
    crosswalks = tuple((lane.lane_id[1:].rsplit("_", 2)[0], lane.shape, lane.width_m) for lane in crossings)
    lights = tuple(row.get("id", "") for row in root.iter("tlLogic"))
    return Network(plan, lanes, tuple(_read_connectors(root, lanes)), shapes, crosswalks, lights)
