"""Rollouts as JSON files for GPUDrive, PufferDrive and the viewers of both."""

import json
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rlftsim.jobs.files import write_text
from rlftsim.realism import SimulatedStates
from rlftsim.rollout.types import FARTHEST_STEP_M
from rlftsim.scenario.gpudrive import ROAD_TYPES
from rlftsim.scenario.types import HISTORY_STEPS, POLYGON_TYPES, STEP_S, LightState, ObjectType, Scenario

INVALID = -10000.0
"""Stands for every value of a step at which an object is not valid."""


def write_gpudrive(scenario: Scenario, states: SimulatedStates, folder: Path) -> Path:
    """Write FOLDER/tfrecord-SCENARIO_N.json for each rollout N; returns a pattern of these files.

    Args:
        scenario: Scenario with the history, the map and the lights.
        states: Rollouts of the scenario, world frame.
        folder: Folder in which the files are written.

    Raises:
        DataError: A file that cannot be written.
    """
    simulated = scenario.simulated_indices
    tracks = scenario.tracks.select(simulated)
    order = states.find_rows(tracks.object_id)
    poses = torch.stack([states.x, states.y, states.z, states.heading], -1)[:, order].cpu().numpy()
    presence, history = states.presence[:, order].cpu().numpy(), slice(HISTORY_STEPS)
    index = {track: row for row, track in enumerate(simulated.tolist())}
    rows = [row for row, track in enumerate(scenario.tracks_to_predict.tolist()) if track in index]
    for number, future in enumerate(poses):  # [A, 80, 4]
        position = np.concatenate([tracks.position[:, history], future[..., :3]], 1)
        velocity = np.diff(position[:, HISTORY_STEPS - 1 :, :2], axis=1) / np.float32(STEP_S)
        is_elsewhere = np.linalg.norm(velocity, axis=-1) * STEP_S > FARTHEST_STEP_M  # the first step of who enters
        velocity[is_elsewhere] = np.roll(velocity, -1, axis=1)[is_elsewhere]
        motion = replace(
            tracks,
            position=position,
            heading=np.concatenate([tracks.heading[:, history], future[..., 3]], 1),
            velocity=np.concatenate([tracks.velocity[:, history], velocity], 1),
            size=np.repeat(tracks.size[:, HISTORY_STEPS - 1 : HISTORY_STEPS], position.shape[1], 1),
            valid=np.concatenate([tracks.valid[:, history], presence[number]], 1),
        )
        rollout = replace(
            scenario,
            tracks=motion,
            ego_index=index[scenario.ego_index],
            tracks_to_predict=np.array([index[track] for track in scenario.tracks_to_predict[rows].tolist()], np.int32),
            difficulty=scenario.difficulty[rows],
        )
        name = f"tfrecord-{scenario.scenario_id}_{number}.json"
        write_text(folder / name, json.dumps({"name": name, **to_gpudrive(rollout)}))
    return folder / f"tfrecord-{scenario.scenario_id}_*.json"


def to_gpudrive(scenario: Scenario) -> dict[str, Any]:
    """Contents of a JSON file of the present form, but for the name. Links between lanes have no place there."""
    tracks, features, lights = scenario.tracks, scenario.map_features, scenario.lights
    objects = []
    for track, is_valid in enumerate(tracks.valid):
        last = int(np.flatnonzero(is_valid)[-1]) if is_valid.any() else 0
        length, width, height = tracks.size[track, last].tolist()
        position = np.where(is_valid[:, None], tracks.position[track], INVALID).tolist()
        velocity = np.where(is_valid[:, None], tracks.velocity[track], INVALID).tolist()
        objects.append({
            "position": [dict(zip("xyz", point)) for point in position],
            "width": width, "length": length, "height": height,
            "heading": np.where(is_valid, tracks.heading[track], INVALID).tolist(),
            "velocity": [dict(zip("xy", point)) for point in velocity],
            "valid": is_valid.tolist(),
            "goalPosition": dict(zip("xyz", position[last])),
            "type": ObjectType(tracks.object_type[track]).name.lower(),
            "id": int(tracks.object_id[track]),
            "mark_as_expert": False,
        })  # fmt: skip
    roads = []
    for road, road_type in enumerate(features.feature_type.tolist()):
        line = (features.polygon if road_type in POLYGON_TYPES else features.polyline)(road).tolist()
        roads.append({
            "geometry": [dict(zip("xyz", point)) for point in line],
            "type": next(name for name, types in ROAD_TYPES.items() if road_type in types),
            "map_element_id": road_type,
            "id": int(features.feature_id[road]),
        })  # fmt: skip
    lanes: dict[int, dict[str, list[Any]]] = defaultdict(lambda: defaultdict(list))
    for step, lane, state, point in zip(lights.step.tolist(), lights.lane_id.tolist(), lights.state, lights.stop_point):
        row = {"state": LightState(state).name.lower(), **dict(zip("xyz", point.tolist())), "time_index": step}
        for name, value in {**row, "lane_id": lane}.items():
            lanes[lane][name].append(value)
    predicted = zip(scenario.tracks_to_predict.tolist(), scenario.difficulty.tolist())
    metadata = {
        "sdc_track_index": int(scenario.ego_index),
        "objects_of_interest": scenario.objects_of_interest.tolist(),
        "tracks_to_predict": [{"track_index": track, "difficulty": level} for track, level in predicted],
    }
    scene = {"scenario_id": scenario.scenario_id, "objects": objects, "roads": roads}
    return {**scene, "tl_states": lanes, "metadata": metadata}
