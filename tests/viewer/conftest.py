import numpy as np
import pytest

from rlftsim.scenario.types import LightStates, MapFeatures, MapFeatureType, Scenario, Tracks
from rlftsim.viewer.page import Animation, Panel
from rlftsim.viewer.scene import SceneMotion, build_scene, logged_trajectories

STEPS = 91


def draw_tracks() -> Tracks:
    """Four road users around (1010, 500), where the ego is at the current step.

    0  parked car at (1020, 500), 4.5 m x 2 m, to predict
    1  ego, same size, 10 m/s along +x through the parked car: x = 1000 + step
    2  pedestrian, unseen at the current step, hence not simulated
    3  cyclist at (1010, 505), heads along +y, recorded up to step 40
    """
    step = np.arange(STEPS, dtype=np.float32)
    position = np.zeros((4, STEPS, 3), np.float32)
    position[0, :, :2] = 1020, 500
    position[1, :, 0], position[1, :, 1] = 1000 + step, 500
    position[3, :, :2] = 1010, 505
    heading = np.zeros((4, STEPS), np.float32)
    heading[3] = np.pi / 2
    size = np.zeros((4, STEPS, 3), np.float32)
    size[:2], size[2], size[3] = (4.5, 2.0, 1.5), (0.8, 0.8, 1.8), (1.8, 0.6, 1.7)
    valid = np.ones((4, STEPS), bool)
    valid[2, 10] = False
    valid[3, 41:] = False
    velocity = np.zeros((4, STEPS, 2), np.float32)
    velocity[1, :, 0] = 10
    ids, types = np.array([5, 9, 7, 3]), np.array([1, 1, 2, 3], np.int8)
    return Tracks(ids, types, position, heading, velocity, size, valid)


def draw_map() -> MapFeatures:
    """A straight lane along y = 500 with a point every meter, a right-angled road edge, a crosswalk, a stop sign."""
    lane = [(x, 500) for x in range(980, 1041)]
    edge = [(980, 496), (1005, 496), (1030, 496), (1030, 480)]
    crosswalk = [(1000, 495), (1003, 495), (1003, 505), (1000, 505)]
    pieces = [lane, edge, crosswalk, [(1031, 497)]]
    types = [
        MapFeatureType.LANE_SURFACE_STREET,
        MapFeatureType.EDGE_BOUNDARY,
        MapFeatureType.CROSSWALK,
        MapFeatureType.STOP_SIGN,
    ]
    points = np.array([(x, y, 0) for piece in pieces for x, y in piece], np.float32)
    offsets = np.cumsum([0, *map(len, pieces)])
    return MapFeatures(np.arange(1, 5), np.array(types, np.int8), points, offsets)


def draw_lights() -> LightStates:
    """One light at (1028, 500): green (6) up to step 19, red (4) up to step 89, not seen at step 90."""
    step = np.arange(90, dtype=np.int32)
    state = np.where(step < 20, 6, 4).astype(np.int8)
    stop_point = np.tile(np.array([1028, 500, 0], np.float32), (90, 1))
    return LightStates(step, np.full(90, 1), state, stop_point)


@pytest.fixture
def scenario() -> Scenario:
    return Scenario(
        scenario_id="drawn",
        timestamps_s=np.arange(STEPS) * 0.1,
        tracks=draw_tracks(),
        map_features=draw_map(),
        lights=draw_lights(),
        ego_index=1,
        tracks_to_predict=np.array([0], np.int32),
        difficulty=np.array([1], np.int8),
        objects_of_interest=np.array([], np.int64),
    )


@pytest.fixture
def animation(scenario) -> Animation:
    """The log beside two rollouts in which everybody stands 1 m and 2 m further along x."""
    scene = build_scene(scenario)
    log = logged_trajectories(scenario).with_overlaps(scene.agents)
    moved = SceneMotion(
        np.concatenate([log.position + np.array([1, 0]), log.position + np.array([2, 0])]),
        np.repeat(log.heading, 2, 0),
        np.ones((2, *log.valid.shape[1:]), bool),
        offroad=np.zeros((2, *log.valid.shape[1:]), bool),
    )
    return Animation("A <title>", scene, [Panel("Logged", log), Panel("Base & more", moved)], caption="</script>")
