"""Files of GPUDrive and Nocturne, written from WOMD messages by the rules of the programs that publish them."""

import json
import math
from pathlib import Path

from rlftsim.scenario import womd_pb2

OBJECTS = ("unset", "vehicle", "pedestrian", "cyclist", "other")
LIGHTS = (
    "unknown", "arrow_stop", "arrow_caution", "arrow_go", "stop", "caution", "go", "flashing_stop", "flashing_caution",
)  # fmt: skip
FIRST = {"lane": 0, "road_line": 5, "road_edge": 14, "stop_sign": 17, "crosswalk": 18, "speed_bump": 19, "driveway": 20}
FORMS = ("present", "early", "Nocturne")


def to_json(message: womd_pb2.Scenario, form: str = "present") -> dict:
    """Contents of the file of a scenario."""
    missing = 0.0001 if form == "early" else -10000.0
    axes = "xy" if form == "Nocturne" else "xyz"
    objects = [_to_object(track, form, axes, missing) for track in message.tracks]
    roads = []
    for feature in message.map_features:
        name = feature.WhichOneof("feature_data")
        data = getattr(feature, name)
        points = [data.position] if name == "stop_sign" else getattr(data, "polyline", None) or data.polygon
        road = {"geometry": [{a: getattr(p, a) for a in axes} for p in points], "type": name}
        if form != "Nocturne":
            road |= {"map_element_id": FIRST[name] + getattr(data, "type", 0), "id": feature.id}
        roads.append(road)
    lanes: dict[str, dict[str, list]] = {}
    for step, states in enumerate(message.dynamic_map_states if form != "Nocturne" else ()):
        for light in states.lane_states:
            row = {"state": LIGHTS[light.state], **{a: getattr(light.stop_point, a) for a in axes}, "time_index": step}
            row |= {"lane_id": light.lane} if form == "present" else {}
            columns = lanes.setdefault(str(light.lane), {name: [] for name in row})
            for name, value in row.items():
                columns[name].append(value)
    scene: dict = {"name": f"tfrecord-00000-of-00001_{message.scenario_id}.json"}
    scene |= {"scenario_id": message.scenario_id} if form != "Nocturne" else {}
    scene |= {"objects": objects, "roads": roads, "tl_states": lanes}
    if form == "present":
        predicted = [{"track_index": e.track_index, "difficulty": e.difficulty} for e in message.tracks_to_predict]
        scene["metadata"] = {
            "sdc_track_index": message.sdc_track_index,
            "objects_of_interest": list(message.objects_of_interest),
            "tracks_to_predict": predicted,
        }
    return scene


def _to_object(track: womd_pb2.Track, form: str, axes: str, missing: float) -> dict:
    final = [state for state in track.states if state.valid][-1]

    def heading(radians: float) -> float:
        return math.remainder(radians, math.tau) if form == "present" else math.degrees(radians)

    one = {
        "position": [
            {a: getattr(s, f"center_{a}") for a in axes} if s.valid else dict.fromkeys(axes, missing)
            for s in track.states
        ],
        "width": final.width,
        "length": final.length,
        "heading": [heading(s.heading) if s.valid else missing for s in track.states],
        "velocity": [
            {"x": s.velocity_x, "y": s.velocity_y} if s.valid else {"x": missing, "y": missing} for s in track.states
        ],
        "valid": [s.valid for s in track.states],
        "goalPosition": {a: getattr(final, f"center_{a}") for a in axes},
        "type": OBJECTS[track.object_type],
    }
    one |= {"height": final.height} if form != "Nocturne" else {}
    return one | ({"id": track.id, "mark_as_expert": False} if form == "present" else {})


def write_file(folder: Path, message: womd_pb2.Scenario, form: str = "present") -> Path:
    """Write the file of a scenario."""
    scene = to_json(message, form)
    path = folder / scene["name"]
    folder.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(scene))
    return path
