"""CommonRoad scenarios (XML 2018b or 2020a, plain or gzip) to the tables that `rlftsim convert --from tables` reads.

    python docs/commonroad_to_tables.py XML_FOLDER TABLES_FOLDER      needs numpy, pyarrow, shapely
    rlftsim convert TABLES_FOLDER data/commonroad

Only dynamic obstacles with a trajectory are taken. What the files do not have:

* an ego: the vehicle nearest to the start of the planning problem that is there for all of the first 9.1 s is taken
* heights: of vehicles and ground, both are left to the converter
* road edges: the outline of all lanelets, without its pieces where a lanelet begins or ends at the border of the map
* painted lines, crosswalks, traffic lights, speed limits on signs (2020a): left out
"""

import gzip
import math
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import shapely

LICENSE = (
    "NGSIM trajectories: U.S. Department of Transportation, open data. Maps: OpenStreetMap contributors, ODbL. "
    "The terms of the CommonRoad scenario files apply."
)
VERSIONS = ("2018b", "2020a")
KINDS = {"car": "vehicle", "truck": "vehicle", "bus": "vehicle", "taxi": "vehicle", "priorityVehicle": "vehicle",
         "motorcycle": "cyclist", "bicycle": "cyclist", "pedestrian": "pedestrian"}  # fmt: skip
STEPS = 91
SLIT_M = 0.6
"""Gaps between lanelets up to this width are closed, islands narrower than it disappear."""


def number(element, path):
    """Value of <exact>, or the middle of an interval."""
    found = element.find(path)
    if (exact := found.findtext("exact")) is not None:
        return float(exact)
    return (float(found.findtext("intervalStart")) + float(found.findtext("intervalEnd"))) / 2


def bound(lanelet, name):
    """Points of one side of a lanelet, [n, 2], without repetitions."""
    points = [(float(p.findtext("x")), float(p.findtext("y"))) for p in lanelet.find(name).iter("point")]
    return np.array([p for k, p in enumerate(points) if k == 0 or p != points[k - 1]])


def at_fractions(points, count):
    """Points of a line at equal fractions of its length."""
    along = np.append(0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    at = np.linspace(0, along[-1], count)
    return np.column_stack([np.interp(at, along, points[:, k]) for k in range(2)])


def read_tracks(root, name):
    """Rows of tracks.parquet."""
    # 2018b names the role inside, 2020a by the element
    moving = [obstacle for obstacle in root.iter("obstacle") if obstacle.findtext("role") == "dynamic"]
    for obstacle in [*moving, *root.iter("dynamicObstacle")]:
        if obstacle.find("trajectory") is None:
            continue
        shape = obstacle.find("shape/rectangle")
        length, width = (float(shape.findtext(side)) for side in ("length", "width")) if shape is not None else (
            [2 * float(obstacle.findtext("shape/circle/radius"))] * 2
        )  # fmt: skip
        for state in [obstacle.find("initialState"), *obstacle.iter("state")]:
            heading, speed = number(state, "orientation"), number(state, "velocity")
            yield {
                "scenario_id": name, "object_id": int(obstacle.get("id")),
                "type": KINDS.get(obstacle.findtext("type"), "other"),
                "step": round(number(state, "time")), "x": float(state.findtext("position/point/x")),
                "y": float(state.findtext("position/point/y")), "heading": heading,
                "vx": speed * math.cos(heading), "vy": speed * math.sin(heading),
                "length": length, "width": width,
            }  # fmt: skip


def read_map(root, name):
    """Rows of map.parquet and lanes.parquet."""
    tags = [*root.get("tags", "").split(), *(tag.tag for tag in root.findall("scenarioTags/*"))]
    kind = "lane_freeway" if "highway" in tags else "lane_surface_street"
    points, lanes, areas, ends = [], [], [], []
    lanelets = list(root.findall("lanelet"))
    for lanelet in lanelets:
        left, right = bound(lanelet, "leftBound"), bound(lanelet, "rightBound")
        count = max(2, math.ceil(max(np.linalg.norm(np.diff(b, axis=0), axis=1).sum() for b in (left, right)) / 0.5))
        center = (at_fractions(left, count) + at_fractions(right, count)) / 2
        points += [(int(lanelet.get("id")), kind, x, y) for x, y in center]
        areas.append(shapely.Polygon(np.concatenate([right, left[::-1]])).buffer(0))
        ends += [] if lanelet.findall("predecessor") else [(left[0], right[0])]
        ends += [] if lanelet.findall("successor") else [(left[-1], right[-1])]
        beside = {side: lanelet.find(f"adjacent{side}") for side in ("Left", "Right")}
        lanes.append({
            "scenario_id": name, "lane_id": int(lanelet.get("id")),
            "entry": [int(other.get("ref")) for other in lanelet.findall("predecessor")],
            "exit": [int(other.get("ref")) for other in lanelet.findall("successor")],
            **{side.lower(): [int(other.get("ref"))] if other is not None and other.get("drivingDir") == "same" else []
               for side, other in beside.items()},
            "speed_limit_mph": float(lanelet.findtext("speedLimit") or 0) * 2.236936,
        })  # fmt: skip
    road = shapely.union_all(areas).buffer(SLIT_M / 2, join_style="mitre").buffer(-SLIT_M / 2, join_style="mitre")
    border = shapely.union_all([shapely.LineString(end).buffer(SLIT_M) for end in ends])
    next_id = max(int(lanelet.get("id")) for lanelet in lanelets) + 1
    for polygon in shapely.get_parts(road):
        for k, ring in enumerate([polygon.exterior, *polygon.interiors]):
            if shapely.Polygon(ring).area < SLIT_M**2:
                continue
            # outer outlines counter-clockwise, islands clockwise: the road is on the left
            ring = ring if ring.is_ccw == (k == 0) else ring.reverse()
            for piece in shapely.get_parts(shapely.line_merge(ring.difference(border))):
                line = piece.segmentize(1.0).coords
                points += [(next_id, "edge_boundary", x, y) for x, y in line]
                next_id += 1
    names = ("feature_id", "type", "x", "y")
    return [{"scenario_id": name, **dict(zip(names, point))} for point in points], lanes


def choose_ego(root, tracks):
    """The vehicle nearest to the start of the planning problem, of those that are there for all 91 steps."""
    start = root.find("planningProblem/initialState/position/point")
    goal = np.array([float(start.findtext("x")), float(start.findtext("y"))])
    steps, first = {}, {}
    for row in tracks:
        steps[row["object_id"]] = steps.get(row["object_id"], 0) + (row["step"] < STEPS)
        first.setdefault(row["object_id"], np.hypot(row["x"] - goal[0], row["y"] - goal[1]))
    return min((i for i in first if steps[i] == max(steps.values())), key=first.get)


def main(source, destination):
    """Write the tables of all scenarios of a folder."""
    tables = {"tracks": [], "map": [], "lanes": [], "scenarios": []}
    for path in sorted([*Path(source).glob("*.xml"), *Path(source).glob("*.xml.gz")]):
        root = ElementTree.fromstring(gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes())
        if root.get("commonRoadVersion") not in VERSIONS:
            sys.exit(
                f"{path}: CommonRoad version {root.get('commonRoadVersion')}, only {' and '.join(VERSIONS)} are read."
            )
        name = root.get("benchmarkID")
        tracks = list(read_tracks(root, name))
        points, lanes = read_map(root, name)
        tables["tracks"] += tracks
        tables["map"] += points
        tables["lanes"] += lanes
        tables["scenarios"].append({
            "scenario_id": name, "ego_id": choose_ego(root, tracks), "first_step": 0, "guessed": ["ego", "edges"],
            "step_s": float(root.get("timeStepSize")), "license": LICENSE,
        })  # fmt: skip
    Path(destination).mkdir(parents=True, exist_ok=True)
    for name, rows in tables.items():
        pq.write_table(pa.Table.from_pylist(rows), Path(destination) / f"{name}.parquet")


if __name__ == "__main__":
    main(*sys.argv[1:3])
