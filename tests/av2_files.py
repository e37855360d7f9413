"""Files shaped like those of Argoverse 2, written from any scenario: the data set itself may not be part of a test."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import shapely

from rlftsim.scenario.av2 import RECORDED_STEPS
from rlftsim.scenario.polylines import Heights
from rlftsim.scenario.types import CURRENT_STEP, LANE_TYPES, ROAD_EDGE_TYPES, TOTAL_STEPS, MapFeatureType, Scenario

GRID_M = 30.0
REACH_M = 30.0
"""The crop reaches at least so far from the ego; road edges must not end inside it."""
CLOSED_M = 1.0
"""Ends of road edges that are nearer than this belong together."""
LANE_WIDTH_M = 3.5
LEAD = RECORDED_STEPS - TOTAL_STEPS
"""Steps before the first of the scenario, as the window "last" cuts them off again."""
KINDS = {1: "vehicle", 2: "pedestrian", 3: "cyclist"}


def write_av2(
    folder: Path,
    scenario: Scenario,
    *,
    name: str | None = None,
    num_steps: int = RECORDED_STEPS,
    reach_m: float = REACH_M,
) -> Path:
    """Write a scenario as `scenario_NAME.parquet` and its map; returns the folder of the two."""
    name = name or scenario.scenario_id
    place = folder / name
    place.mkdir(parents=True, exist_ok=True)
    rows = track_rows(scenario, name, num_steps)
    pq.write_table(pa.Table.from_pylist(rows), place / f"scenario_{name}.parquet")
    (place / f"log_map_archive_{name}.json").write_text(json.dumps(map_archive(scenario, reach_m)))
    return place


def track_rows(scenario: Scenario, name: str, num_steps: int = RECORDED_STEPS) -> list[dict]:
    """Rows of the Parquet file; the ego stands still before the first step of the scenario."""
    tracks, rows = scenario.tracks, []
    predicted = scenario.tracks_to_predict.tolist()
    for track in range(len(tracks.object_id)):
        is_ego = track == scenario.ego_index
        for step in range(num_steps):
            source = max(step - LEAD, 0)
            if not tracks.valid[track, source] or (step < LEAD and not is_ego):
                continue
            x, y = tracks.position[track, source, :2].astype(float)
            vx, vy = tracks.velocity[track, source].astype(float)
            category = (3 if track == predicted[0] else 2) if track in predicted else 1
            rows.append({
                "observed": step < 50, "track_id": "AV" if is_ego else str(tracks.object_id[track]),
                "object_type": KINDS.get(int(tracks.object_type[track]), "static"), "object_category": category,
                "timestep": step, "position_x": x, "position_y": y, "heading": float(tracks.heading[track, source]),
                "velocity_x": vx, "velocity_y": vy, "scenario_id": name, "start_timestamp": 3e17,
                "end_timestamp": 3e17 + 1e8 * (num_steps - 1), "num_timestamps": num_steps, "focal_track_id": "0",
                "city": "synthetic", "map_id": 1, "slice_id": "",
            })  # fmt: skip
    return rows


def crop_box(scenario: Scenario, reach_m: float = REACH_M):
    """Rectangle on lines of the 30 m grid around the ego, as the data set crops its maps."""
    low = np.floor((scenario.tracks.position[scenario.ego_index, CURRENT_STEP, :2] - reach_m) / GRID_M) * GRID_M
    high = np.ceil((scenario.tracks.position[scenario.ego_index, CURRENT_STEP, :2] + reach_m) / GRID_M) * GRID_M
    return shapely.box(*low.astype(float), *high.astype(float))


def clipped_edges(scenario: Scenario, reach_m: float = REACH_M) -> list[np.ndarray]:
    """Road edges inside the crop, each with the road on its left."""
    features, box = scenario.map_features, crop_box(scenario, reach_m)
    pieces = []
    for index in features.find_indices(ROAD_EDGE_TYPES):
        line = shapely.LineString(features.polyline(index)[:, :2].astype(float))
        inside = shapely.line_merge(shapely.intersection(line, box))
        pieces += [shapely.get_coordinates(part) for part in shapely.get_parts(inside) if part.length > 0]
    # Pieces that go on in another one, or in themselves, a step further are joined.
    joined = True
    while joined:
        joined = False
        for first in range(len(pieces)):
            for second in range(len(pieces)):
                gap = np.linalg.norm(pieces[first][-1] - pieces[second][0])
                on_border = box.exterior.distance(shapely.Point(pieces[first][-1])) < 1e-6
                if not on_border and (0 < gap < CLOSED_M or (gap == 0 and first != second)):
                    tail = pieces[second][:1] if first == second else pieces[second]
                    pieces[first] = np.concatenate([pieces[first], tail])
                    pieces = pieces if first == second else [p for k, p in enumerate(pieces) if k != second]
                    joined = True
                    break
            if joined:
                break
    return pieces


def left_of_nearest(places: np.ndarray, edges: list[np.ndarray]) -> np.ndarray:
    """True where a place is left of the edge piece nearest to it; at a joint of two the turn decides."""
    start = np.concatenate([edge[:-1] for edge in edges])
    end = np.concatenate([edge[1:] for edge in edges])
    tree = shapely.STRtree(shapely.linestrings(np.stack([start, end], 1)))
    pairs = tree.query_nearest(shapely.points(places), all_matches=True)
    along, to = (end - start)[pairs[1]], places[pairs[0]] - start[pairs[1]]
    side = along[:, 0] * to[:, 1] - along[:, 1] * to[:, 0]
    # of two pieces that share their nearest point the one that the place is more clearly beside counts
    clear = side / np.maximum(np.linalg.norm(along, axis=1), 1e-12)
    best = np.zeros(len(places))
    for place, value in zip(pairs[0], clear):
        best[place] = value if abs(value) > abs(best[place]) else best[place]
    return best > 0


def drivable_tiles(scenario: Scenario, reach_m: float = REACH_M) -> list[np.ndarray]:
    """Rings of the ground inside the crop, in tiles along the 30 m grid, none with a hole."""
    box, edges = crop_box(scenario, reach_m), clipped_edges(scenario, reach_m)
    lines = shapely.union_all([*(shapely.LineString(edge) for edge in edges), box.exterior])
    faces = np.array(list(shapely.get_parts(shapely.polygonize([*shapely.get_parts(lines)]))))
    inner = shapely.get_coordinates(shapely.point_on_surface(faces))
    area = shapely.union_all(faces[left_of_nearest(inner, edges)])
    x0, y0, x1, y1 = box.bounds
    tiles = []
    for x in np.arange(x0, x1, GRID_M):
        for y in np.arange(y0, y1, GRID_M):
            waiting = [*shapely.get_parts(shapely.intersection(area, shapely.box(x, y, x + GRID_M, y + GRID_M)))]
            while waiting:
                part = waiting.pop()
                if part.geom_type == "Polygon" and part.interiors:
                    # cut in two through the hole
                    middle = part.interiors[0].centroid.x
                    halves = shapely.box(x, y, middle, y + GRID_M), shapely.box(middle, y, x + GRID_M, y + GRID_M)
                    waiting += [p for half in halves for p in shapely.get_parts(shapely.intersection(part, half))]
                elif part.geom_type == "Polygon" and part.area > 1e-4:
                    tiles.append(shapely.get_coordinates(part.exterior)[:-1])
    return tiles


def map_archive(scenario: Scenario, reach_m: float = REACH_M) -> dict:
    """Contents of the JSON file."""
    features, topology = scenario.map_features, scenario.map_features.topology
    heights = Heights(features.points.astype(float))

    def points(line: np.ndarray) -> list[dict]:
        z = heights.at(line[:, :2])
        return [{"x": float(x), "y": float(y), "z": float(h)} for (x, y), h in zip(line[:, :2], z)]

    def links(rows: np.ndarray, lane: int) -> list[int]:
        return [int(other) for own, other in rows if own == lane]

    lanes = {}
    for index in features.find_indices(LANE_TYPES):
        lane_id, center = int(features.feature_id[index]), features.polyline(index)[:, :2].astype(float)
        along = np.gradient(center, axis=0)
        normal = np.stack([-along[:, 1], along[:, 0]], 1) / np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
        beside = [[int(r[2]) for r in topology.neighbors if r[0] == lane_id and r[1] == side] for side in (0, 1)]
        is_bike = features.feature_type[index] == MapFeatureType.LANE_BIKE
        lanes[str(lane_id)] = {
            "id": lane_id, "lane_type": "BIKE" if is_bike else "VEHICLE",
            "is_intersection": bool(topology.interpolating[index]) if topology.interpolating is not None else False,
            "left_lane_boundary": points(center + normal * LANE_WIDTH_M / 2),
            "right_lane_boundary": points(center - normal * LANE_WIDTH_M / 2),
            "left_lane_mark_type": "DASHED_WHITE", "right_lane_mark_type": "NONE",
            "left_neighbor_id": next(iter(beside[0]), None), "right_neighbor_id": next(iter(beside[1]), None),
            "predecessors": links(topology.entry_lanes, lane_id), "successors": links(topology.exit_lanes, lane_id),
            "centerline": [],
        }  # fmt: skip
    crossings = {}
    for index in features.find_indices((MapFeatureType.CROSSWALK,)):
        corner = features.polyline(index)[:, :2].astype(float)
        if len(corner) >= 4:
            number = str(features.feature_id[index])
            crossings[number] = {"id": int(number), "edge1": points(corner[:2]), "edge2": points(corner[[3, 2]])}
    areas = {
        str(k): {"id": k, "area_boundary": points(ring)} for k, ring in enumerate(drivable_tiles(scenario, reach_m))
    }
    return {"lane_segments": lanes, "pedestrian_crossings": crossings, "drivable_areas": areas}
