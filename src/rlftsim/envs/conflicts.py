"""Conflicts of the ego with road users that react, by what is known at the current step, before anybody drives.

Frame: map, meters, seconds.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float

from rlftsim.envs.contact import LaneSearch, lane_search
from rlftsim.envs.route import compute_headings, find_route
from rlftsim.envs.scene import Scene, build_env_scene
from rlftsim.envs.sumo_traffic import build_sumo_scene
from rlftsim.geometry import wrapped
from rlftsim.scenario.maneuver import VEHICLE_CONFLICTS
from rlftsim.scenario.polylines import arc_length, sample_line
from rlftsim.scenario.types import CURRENT_STEP, TOTAL_STEPS, ObjectType, Scenario

FOLLOWING, MERGING, CROSSING = VEHICLE_CONFLICTS
PEDESTRIAN = "pedestrian"
HEADWAY_S, HORIZON_S = 2.0, 4.0
LEAST_REACH_M = 20.0
"""Road users that stand may drive off: all look at least so far ahead."""
ON_LANE_M, ALONG_RAD = 2.0, np.radians(45.0)
"""A vehicle is on the lane within this distance that runs nearest to its way, up to this angle."""
MEETS_M, WALKS_INTO_M = 1.5, 2.0
"""Ways of vehicles meet where their middles are this near; a pedestrian's way this near to the ego's is a conflict."""
SAME_PLACE_M = 3.0
"""A way that meets the ego's route within this distance of the ego's center comes from behind it."""
MOVING_MPS = 0.5


def find_conflicts(scenario: Scenario, data: Path) -> frozenset[str]:
    """Conflicts of the ego with road users that SUMO drives: any of "following" to "pedestrian".

    Following: a vehicle less than 2 s behind the ego in the same lane. Merging and crossing: a vehicle whose lane joins
    or crosses the ego's route, where both are within 4 s at present speeds, or within 20 m. Pedestrian: a walker who is
    on the ego's route within 4 s.

    Args:
        scenario: Scenario of the data set; of the log after the current step only the ego's route counts.
        data: Folder of the data set, with the worlds.

    Raises:
        DataError: The scenario has no world.
    """
    scene = build_env_scene(scenario, TOTAL_STEPS)
    agents = build_sumo_scene(scene, data).rows
    route, search = find_route(scenario, scene.ego, "logged", TOTAL_STEPS), lane_search(scenario)
    if not len(route) or search is None:
        return frozenset()
    motion = scene.logged[:, CURRENT_STEP]
    speed = np.hypot(*motion[:, 3:].T)
    reach_m = np.maximum(HORIZON_S * speed, LEAST_REACH_M)
    begin_m = float(route.progress(motion[scene.ego : scene.ego + 1, :2])[0])
    along_m = arc_length(route.points) - begin_m
    is_ahead = (along_m >= 0) & (along_m <= reach_m[scene.ego])
    way = np.concatenate([motion[scene.ego : scene.ego + 1, :2], route.points[is_ahead]])
    way_m = np.append(0.0, along_m[is_ahead])
    heading = np.append(motion[scene.ego, 2], route.heading[is_ahead])
    conflicts = set()
    for agent in agents:
        if scene.object_type[agent] == ObjectType.PEDESTRIAN:
            times = np.linspace(0, HORIZON_S, 21)[:, None]
            walk = motion[agent, :2] + times * motion[agent, 3:]
            is_near = np.linalg.norm(walk[:, None] - way, axis=-1).min() < WALKS_INTO_M
            conflicts |= {PEDESTRIAN} if is_near and speed[agent] > MOVING_MPS else set()
            continue
        for line in _list_ways(scene, search, motion[agent], float(reach_m[agent])):
            distance = np.linalg.norm(line[:, None] - way, axis=-1)  # [n, R]
            meets = distance.min(1) < MEETS_M
            first = int(meets.argmax())
            if not meets[first] or first == 0:  # never, or ahead on the ego's route
                continue
            place = int(distance[first].argmin())
            turn = abs(float(wrapped(compute_headings(line)[[first]] - heading[place])[0]))
            if way_m[place] <= SAME_PLACE_M and turn < ALONG_RAD:
                gap_m = first - (scene.size[agent, 0] + scene.size[scene.ego, 0]) / 2
                conflicts |= {FOLLOWING} if gap_m < HEADWAY_S * speed[agent] else set()
            else:
                conflicts.add(MERGING if turn < ALONG_RAD else CROSSING)
    return frozenset(conflicts)


def _list_ways(
    scene: Scene, search: LaneSearch, motion: Float[np.ndarray, "5"], reach_m: float
) -> Iterator[Float[np.ndarray, "_ 2"]]:
    """Lines that a vehicle may drive along the lanes, a point every meter from its center on; none off the lanes."""
    points = np.array(search.tree.query_ball_point(motion[:2], ON_LANE_M), np.int64)
    turn = np.abs(wrapped(search.heading[points] - motion[2]))
    if not len(points) or turn.min() > ALONG_RAD:
        return
    lane = int(search.lane[points[turn.argmin()]])
    line = scene.graph.lines[lane][:, :2] - scene.scenario.origin
    nearest = int(((line - motion[:2]) ** 2).sum(-1).argmin())
    unfinished = [(lane, np.concatenate([motion[None, :2], line[nearest + 1 :]]))]
    while unfinished:
        lane, line = unfinished.pop()
        length_m = float(arc_length(line)[-1])
        following = scene.graph.successors[lane] if length_m < reach_m else ()
        if not following:
            sampled = sample_line(line, 1.0) if length_m >= 1.0 else line
            yield sampled[: int(reach_m) + 1]
        for successor in following:
            further = scene.graph.lines[successor][:, :2] - scene.scenario.origin
            unfinished.append((successor, np.concatenate([line, further])))
