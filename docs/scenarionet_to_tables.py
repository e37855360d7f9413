"""ScenarioNet's scenario files to the tables that `rlftsim convert --from tables` reads.

    python docs/scenarionet_to_tables.py FOLDER_WITH_sd_FILES TABLES_FOLDER      needs numpy and pyarrow
    rlftsim convert TABLES_FOLDER data/scenarionet

Run it in the environment that made the files: opening a pickle runs the code in it. Their coordinates are those of the
original data, with the ego's first position taken off in some. ScenarioNet makes no road edges for some data sets (its
Argoverse 2 files have none): those scenarios can be simulated, not scored.
"""

import pickle
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

OBJECTS = {"VEHICLE": "vehicle", "PEDESTRIAN": "pedestrian", "CYCLIST": "cyclist"}
FEATURES = {
    "LANE_FREEWAY": "lane_freeway", "LANE_SURFACE_STREET": "lane_surface_street", "LANE_BIKE_LANE": "lane_bike",
    "LANE_UNKNOWN": "lane_undefined", "ROAD_EDGE_BOUNDARY": "edge_boundary", "ROAD_EDGE_MEDIAN": "edge_median",
    "UNKNOWN_LINE": "line_unknown", "ROAD_LINE_BROKEN_SINGLE_WHITE": "line_broken_single_white",
    "ROAD_LINE_SOLID_SINGLE_WHITE": "line_solid_single_white",
    "ROAD_LINE_SOLID_DOUBLE_WHITE": "line_solid_double_white",
    "ROAD_LINE_BROKEN_SINGLE_YELLOW": "line_broken_single_yellow", "CROSSWALK": "crosswalk", "DRIVEWAY": "driveway",
    "ROAD_LINE_BROKEN_DOUBLE_YELLOW": "line_broken_double_yellow", "SPEED_BUMP": "speed_bump", "STOP_SIGN": "stop_sign",
    "ROAD_LINE_SOLID_SINGLE_YELLOW": "line_solid_single_yellow",
    "ROAD_LINE_PASSING_DOUBLE_YELLOW": "line_passing_double_yellow",
    "ROAD_LINE_SOLID_DOUBLE_YELLOW": "line_solid_double_yellow",
}  # fmt: skip
STATES = {"TRAFFIC_LIGHT_RED": "stop", "TRAFFIC_LIGHT_YELLOW": "caution", "TRAFFIC_LIGHT_GREEN": "go",
          "LANE_STATE_STOP": "stop", "LANE_STATE_CAUTION": "caution", "LANE_STATE_GO": "go",
          "LANE_STATE_ARROW_STOP": "arrow_stop", "LANE_STATE_ARROW_CAUTION": "arrow_caution",
          "LANE_STATE_ARROW_GO": "arrow_go"}  # fmt: skip


def main(source, destination):
    """Write the tables of all scenarios of a folder."""
    tables = {"tracks": [], "map": [], "scenarios": [], "lights": []}
    for path in sorted(Path(source).rglob("sd_*.pkl")):
        scenario = pickle.loads(path.read_bytes())
        name, about = str(scenario["id"]), scenario["metadata"]
        numbers = {key: k for k, key in enumerate(scenario["tracks"])}  # ids may be text
        for key, track in scenario["tracks"].items():
            state, kind = track["state"], OBJECTS.get(track["type"], "other")
            for step in np.flatnonzero(state["valid"]).tolist():
                row = {"scenario_id": name, "object_id": numbers[key], "type": kind, "step": step}
                row |= dict(zip("xyz", map(float, state["position"][step])))
                row["heading"] = float(state["heading"][step])
                row |= dict(zip(("vx", "vy"), map(float, state["velocity"][step])))
                row |= {size: float(np.ravel(state[size][step])[0]) for size in ("length", "width", "height")}
                tables["tracks"].append(row)
        features = {key: k for k, key in enumerate(scenario["map_features"])}
        for key, feature in scenario["map_features"].items():
            points = np.atleast_2d(feature.get("polyline", feature.get("polygon", feature.get("position"))))
            if feature["type"] in FEATURES:
                tables["map"] += [
                    {"scenario_id": name, "feature_id": features[key], "type": FEATURES[feature["type"]],
                     "x": float(p[0]), "y": float(p[1]), "z": float(p[2]) if len(p) > 2 else 0.0} for p in points
                ]  # fmt: skip
        for light in scenario["dynamic_map_states"].values():
            for step, state in enumerate(light["state"]["object_state"]):
                if state in STATES and light["lane"] in features:
                    tables["lights"].append({"scenario_id": name, "step": step, "state": STATES[state],
                                             "lane_id": features[light["lane"]]})  # fmt: skip
        predict = [numbers[key] for key in about.get("tracks_to_predict", {}) if key in numbers]
        step_s = float(np.diff(about["ts"]).mean().round(3))
        row = {"scenario_id": name, "ego_id": numbers[about["sdc_id"]], "step_s": step_s, "first_step": 0}
        tables["scenarios"].append({**row, **({"predict": predict} if predict else {})})
    Path(destination).mkdir(parents=True, exist_ok=True)
    for name, rows in tables.items():
        if rows:
            pq.write_table(pa.Table.from_pylist(rows), Path(destination) / f"{name}.parquet")


if __name__ == "__main__":
    main(*sys.argv[1:3])
