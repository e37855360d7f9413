"""Rollouts as recordings for the Rerun viewer. Needs the extra `rerun`."""

from pathlib import Path

import numpy as np
import torch

from rlftsim.errors import ConfigError
from rlftsim.jobs.files import write_atomically
from rlftsim.realism import SimulatedStates, compute_features, scenario_log
from rlftsim.scenario.types import (
    FUTURE_STEPS,
    HISTORY_STEPS,
    LANE_TYPES,
    ROAD_EDGE_TYPES,
    LightState,
    ObjectType,
    Scenario,
)

MAX_ROLLOUTS = 8
"""Rollouts in a recording."""
TYPE_COLORS = {
    ObjectType.VEHICLE: (90, 140, 220), ObjectType.PEDESTRIAN: (230, 140, 40), ObjectType.CYCLIST: (60, 170, 90),
}  # fmt: skip
EGO_COLOR, OTHER_COLOR, MAP_COLOR, EDGE_COLOR = (220, 60, 60), (150, 150, 150), (110, 110, 110), (230, 230, 230)
STOP, GO, UNKNOWN = (220, 40, 40), (40, 190, 80), (150, 150, 150)
LIGHT_COLORS = {
    LightState.STOP: STOP, LightState.ARROW_STOP: STOP, LightState.FLASHING_STOP: STOP,
    LightState.GO: GO, LightState.ARROW_GO: GO,
}  # fmt: skip


def write_rerun(scenario: Scenario, states: SimulatedStates, folder: Path) -> Path:
    """Write FOLDER/SCENARIO.rrd: map, lights, and boxes of the log and of the first rollouts over the steps.

    Frame: map, meters, the ego's current position at 0. Of a scenario with a future the fraction of evaluated agents
    that collide or are off the road is a time series of each rollout.

    Args:
        scenario: Scenario with the map and the log.
        states: Rollouts of the scenario, world frame.
        folder: Folder in which the recording is written.

    Raises:
        ConfigError: rerun-sdk is not installed.
        DataError: A file that cannot be written.
    """
    try:
        import rerun as rr  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError:
        raise ConfigError("Rerun's recordings need rerun-sdk: pip install 'rlftsim[rerun]'.") from None

    path = folder / f"{scenario.scenario_id}.rrd"
    tracks, origin = scenario.tracks.select(scenario.simulated_indices), np.append(scenario.origin, 0.0)
    order = states.find_rows(tracks.object_id)
    future = torch.stack([states.x, states.y, states.z, states.heading], -1)[:MAX_ROLLOUTS, order].cpu().numpy()
    presence = states.presence[:, order].cpu().numpy()
    log = np.concatenate([tracks.position, tracks.heading[..., None]], -1)
    size = tracks.size[:, HISTORY_STEPS - 1]
    colors = np.array([TYPE_COLORS.get(ObjectType(value), OTHER_COLOR) for value in tracks.object_type])
    colors[scenario.simulated_indices == scenario.ego_index] = EGO_COLOR
    stream = rr.RecordingStream(f"rlftsim {scenario.scenario_id}")

    def log_boxes(entity: str, poses: np.ndarray, is_valid: np.ndarray) -> None:
        half = poses[is_valid, 3] / 2
        turn = np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], -1)  # quaternions x, y, z, w
        boxes = rr.Boxes3D(
            centers=poses[is_valid, :3] - origin, half_sizes=size[is_valid] / 2, quaternions=turn,
            colors=colors[is_valid], labels=tracks.object_id[is_valid].astype(str), show_labels=False,
        )  # fmt: skip
        stream.log(entity, boxes)

    def write(temporary: Path) -> None:
        stream.save(temporary)
        features = scenario.map_features
        for name, types, color in (("lanes", LANE_TYPES, MAP_COLOR), ("edges", ROAD_EDGE_TYPES, EDGE_COLOR)):
            lines = [features.polyline(index) - origin for index in features.find_indices(types)]
            stream.log(f"map/{name}", rr.LineStrips3D(lines, colors=[color] * len(lines)), static=True)
        for number, rollout in enumerate(future):
            lines = [path[is_there, :3] - origin for path, is_there in zip(rollout, presence[number])]
            stream.log(f"rollout_{number}/paths", rr.LineStrips3D(lines, colors=colors), static=True)
        for step in range(HISTORY_STEPS + future.shape[2]):
            stream.set_time("step", sequence=step)
            if step < scenario.num_steps:
                log_boxes("log", log[:, step], tracks.valid[:, step])
            is_now = scenario.lights.step == step
            lights = [LIGHT_COLORS.get(LightState(value), UNKNOWN) for value in scenario.lights.state[is_now]]
            stream.log("lights", rr.Points3D(scenario.lights.stop_point[is_now] - origin, colors=lights, radii=0.6))
            for number, rollout in enumerate(future):
                if step >= HISTORY_STEPS:
                    log_boxes(
                        f"rollout_{number}", rollout[:, step - HISTORY_STEPS], presence[number, :, step - HISTORY_STEPS]
                    )
        for name, fractions in _measure_events(scenario, states).items():
            for number, values in enumerate(fractions):
                for step, value in enumerate(values, HISTORY_STEPS):
                    stream.set_time("step", sequence=step)
                    stream.log(f"scores/{name}/rollout_{number}", rr.Scalars(value))
        stream.disconnect()

    write_atomically(path, write)
    return path


def _measure_events(scenario: Scenario, states: SimulatedStates) -> dict[str, np.ndarray]:
    """Fraction of evaluated agents that collide, or are off the road, at each step of the first rollouts, [N, T]."""
    if not scenario.has_evaluated_future or states.x.shape[-1] != FUTURE_STEPS or states.valid is not None:
        return {}
    features = compute_features(scenario_log(scenario, states.device, missing_map="neutral"), states)
    events = {"collision": features.collision, "off_road": features.offroad}
    return {name: event[:MAX_ROLLOUTS].double().mean(1).cpu().numpy() for name, event in events.items()}
