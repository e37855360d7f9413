"""Traffic for nuPlan: its agents, its ego at the rear axle, its map and its lights, by stand-ins of its signatures."""

import importlib
import pickle
import sys
from math import cos, pi, sin
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import nuplan_stand_ins
import pytest
import shapely
import yaml

import rlftsim.envs.nuplan
from rlftsim.envs.nuplan import agents as module
from rlftsim.envs.nuplan.agents import RlftsimAgents, build_map
from rlftsim.errors import ConfigError
from rlftsim.scenario.types import CURRENT_STEP, LightState, MapFeatureType

START = np.array([664_430.25, 3_997_670.5])
"""A place in Las Vegas, in UTM: float32 resolves it to a quarter of a meter."""
AXLE_TO_CENTER_M = 1.461
STEP_US = 100_000
EPOCH_US = 1_620_000_000_000_000
TYPES = {"car": "VEHICLE", "walker": "PEDESTRIAN", "bike": "BICYCLE", "cone": "TRAFFIC_CONE"}


@pytest.fixture(autouse=True)
def nuplan(monkeypatch):
    nuplan_stand_ins.install(monkeypatch)
    module._load.cache_clear()


def names(path, *wanted):
    loaded = importlib.import_module(f"nuplan.{path}")
    return [getattr(loaded, name) for name in wanted]


def pose(x, y, heading=0.0):
    (StateSE2,) = names("common.actor_state.state_representation", "StateSE2")
    return StateSE2(float(START[0] + x), float(START[1] + y), heading)


def tracks(index, *, only=tuple(TYPES)):
    """What is seen at an iteration of the log: a car at 10 m/s, a walker at 1 m/s, a bicycle, a cone."""
    actor_state = "common.actor_state"
    (Agent,), (OrientedBox,) = (
        names(f"{actor_state}.agent", "Agent"),
        names(f"{actor_state}.oriented_box", "OrientedBox"),
    )
    SceneObject, Metadata = names(f"{actor_state}.scene_object", "SceneObject", "SceneObjectMetadata")
    (Velocity,) = names(f"{actor_state}.state_representation", "StateVector2D")
    (Objects,) = names(f"{actor_state}.tracked_objects", "TrackedObjects")
    (Type,) = names(f"{actor_state}.tracked_objects_types", "TrackedObjectType")
    (Detections,) = names("planning.simulation.observation.observation_type", "DetectionsTracks")
    motion = {"car": (20, 0, 10, 0), "walker": (5, 6, 0, 1), "bike": (-10, 3, 4, 0), "cone": (40, -2, 0, 0)}
    size = {"car": (4.5, 1.9, 1.6), "walker": (0.6, 0.6, 1.7), "bike": (1.8, 0.6, 1.5), "cone": (0.4, 0.4, 0.8)}
    objects = []
    for number, name in enumerate(only):
        x, y, vx, vy = motion[name]
        center = pose(x + 0.1 * index * vx, y + 0.1 * index * vy, pi / 2 if vy else 0.0)
        metadata = Metadata(EPOCH_US + index * STEP_US, f"{name}-{index}", number, name)
        box = OrientedBox(center, *size[name])
        if name == "cone":
            objects.append(SceneObject(Type[TYPES[name]], box, metadata))
        else:
            objects.append(Agent(Type[TYPES[name]], box, Velocity(float(vx), float(vy)), metadata))
    return Detections(Objects(objects))


def ego(index, speed=8.0, heading=0.3):
    """The ego, whose rear axle is at the start at iteration 0."""
    distance = 0.1 * index * speed
    axle = pose(distance * cos(heading), distance * sin(heading), heading)
    center = pose((distance + AXLE_TO_CENTER_M) * cos(heading), (distance + AXLE_TO_CENTER_M) * sin(heading), heading)
    box = SimpleNamespace(center=center, length=5.2, width=2.3, height=1.8)
    footprint = SimpleNamespace(oriented_box=box)
    return SimpleNamespace(center=center, rear_axle=axle, car_footprint=footprint, time_us=EPOCH_US + index * STEP_US)


def path_of(*points):
    return SimpleNamespace(discrete_path=[pose(*point) for point in points])


class Map:
    """A street along x, 8 m wide, that begins and ends beyond the square around the ego."""

    def __init__(self):
        def side(name, y):
            return SimpleNamespace(id=name, discrete_path=path_of((-200, y), (200, y)).discrete_path)

        lane = SimpleNamespace(id="7", baseline_path=path_of((-200, 0), (0, 0)), left_boundary=side("a", 2.0))
        lane.right_boundary = side("b", -2.0)
        twin = SimpleNamespace(id="8", baseline_path=path_of((-200, 4), (0, 4)), left_boundary=side("c", 6.0))
        twin.right_boundary = lane.left_boundary
        connector = SimpleNamespace(id="7", baseline_path=path_of((0, 0), (200, 0)))
        street, corner = START - np.array([200, 2]), START + np.array([200, 6])
        walk = shapely.box(*(START + np.array([50, -2])), *(START + np.array([53, 6])))
        self.objects = {
            "LANE": [lane, twin],
            "LANE_CONNECTOR": [connector],
            "ROADBLOCK": [SimpleNamespace(polygon=shapely.box(*street, START[0] - 0.1, corner[1]))],
            "INTERSECTION": [SimpleNamespace(polygon=shapely.box(START[0] + 0.1, street[1], *corner))],
            "CARPARK_AREA": [],
            "CROSSWALK": [SimpleNamespace(polygon=walk)],
        }

    def get_proximal_map_objects(self, point, radius, layers):
        return {layer: self.objects[layer.name] for layer in layers}


def light(connector, name):
    (Status,) = names("common.maps.maps_datatypes", "TrafficLightStatusType")
    return SimpleNamespace(lane_connector_id=connector, status=Status[name])


class Scenario:
    token = "4f8a"

    @property
    def map_api(self):
        return Map()

    @property
    def initial_tracked_objects(self):
        return tracks(0)

    def get_tracked_objects_at_iteration(self, iteration):
        return tracks(iteration)

    def get_traffic_light_status_at_iteration(self, iteration):
        yield light(7, "RED")


def iteration(index, step_us=STEP_US):
    time_us = EPOCH_US + index * step_us
    return SimpleNamespace(index=index, time_us=time_us, time_s=time_us / 1e6)


def drive(observation, num_steps, ego_at=ego):
    """nuPlan's loop: the observation is updated before the ego's new state joins the history. Returns the history."""
    observation.initialize()
    egos, seen = [ego_at(k) for k in range(-20, 0)], [tracks(k) for k in range(-20, 0)]
    egos.append(ego_at(0))
    seen.append(observation.get_observation())
    for index in range(num_steps):
        current = egos[-1], seen[-1]
        history = SimpleNamespace(ego_states=egos[-21:], observations=seen[-21:], current_state=current)
        observation.update_observation(iteration(index), iteration(index + 1), history)
        egos.append(ego_at(index + 1))
        seen.append(observation.get_observation())
    return seen[20:]


def by_token(observation):
    return {one.track_token: one for one in observation.tracked_objects}


# ---- the loop -------------------------------------------------------------------------------------------------------


def test_the_first_observation_is_that_of_the_log_and_the_class_is_an_observation_of_nuplan():
    (AbstractObservation,) = names("planning.simulation.observation.abstract_observation", "AbstractObservation")
    observation = RlftsimAgents("constant_velocity", Scenario())
    observation.initialize()
    assert isinstance(observation, AbstractObservation)
    assert observation.observation_type().__name__ == "DetectionsTracks"
    assert by_token(observation.get_observation()).keys() == TYPES.keys()


def test_agents_keep_type_size_and_token_and_move_by_the_policy_in_nuplans_frame():
    seen = drive(RlftsimAgents("constant_velocity", Scenario()), 12)
    first, last = by_token(seen[0]), by_token(seen[12])
    assert last.keys() == TYPES.keys()
    for name, (vx, vy) in {"car": (10, 0), "walker": (0, 1), "bike": (4, 0)}.items():
        agent, before = last[name], first[name]
        assert agent.center.x == pytest.approx(before.center.x + 1.2 * vx, abs=0.02)
        assert agent.center.y == pytest.approx(before.center.y + 1.2 * vy, abs=0.02)
        assert agent.center.heading == pytest.approx(before.center.heading, abs=1e-4)
        assert (agent.velocity.x, agent.velocity.y) == pytest.approx((vx, vy), abs=0.02)
        assert agent.tracked_object_type == before.tracked_object_type
        assert (agent.box.length, agent.box.width) == (before.box.length, before.box.width)
        assert agent.metadata.timestamp_us == EPOCH_US + 12 * STEP_US


def test_a_cone_is_that_of_the_log(monkeypatch):
    seen = drive(RlftsimAgents("constant_velocity", Scenario()), 3)
    assert by_token(seen[3])["cone"].metadata.token == "cone-3"


def test_the_world_has_the_ego_at_its_center_where_nuplan_moved_it():
    """One step late: what the last step assumed is replaced by the truth."""
    swerving = lambda index: ego(index, speed=8.0 if index <= 3 else 12.0)  # noqa: E731
    observation = RlftsimAgents("constant_velocity", Scenario())
    drive(observation, 7, swerving)
    world, state = observation.episode
    shift = observation.origin + world.scenes[0].scenario.origin
    for index in range(7):
        center = swerving(index).center
        motion = state.track[CURRENT_STEP + index][0, 0]
        np.testing.assert_allclose(motion[:2] + shift, [center.x, center.y], atol=0.01)
        assert motion[2] == pytest.approx(0.3, abs=1e-4)


def test_a_model_drives_beyond_its_horizon_of_eight_seconds_and_the_same_seed_drives_the_same():
    runs = [drive(RlftsimAgents("demo-base", Scenario(), seed), 85) for seed in (3, 3, 4)]
    ends = [np.array([(one.center.x, one.center.y) for one in by_token(seen[85]).values()]) for seen in runs]
    np.testing.assert_array_equal(ends[0], ends[1])
    assert np.abs(ends[0] - ends[2]).max() > 0.01
    for seen in runs:
        x = np.array([[by_token(one)[name].center.x for name in TYPES] for one in seen])
        assert np.abs(np.diff(x, axis=0)).max() < 3  # nobody jumps where the second episode begins


def test_one_that_is_gone_before_the_episode_begins_does_not_come_back():
    class Empty(Scenario):
        @property
        def initial_tracked_objects(self):
            return tracks(0, only=("bike",))

    seen = drive(RlftsimAgents("constant_velocity", Empty()), 2)
    assert by_token(seen[2]).keys() == {"bike", "cone"}


def test_it_waits_for_its_start_as_a_pickle():
    observation = pickle.loads(pickle.dumps(RlftsimAgents("constant_velocity", Scenario())))
    assert len(drive(observation, 1)) == 2


# ---- map and lights -----------------------------------------------------------------------------------------------


def test_the_map_has_lanes_lines_edges_and_crosswalks():
    features, _ = build_map(Map(), [], START)
    counts = {kind.name: len(features.find_indices((kind,))) for kind in MapFeatureType}
    assert {name: count for name, count in counts.items() if count} == {
        "LANE_SURFACE_STREET": 3, "LINE_BROKEN_SINGLE_WHITE": 3, "EDGE_BOUNDARY": 2, "CROSSWALK": 1
    }  # fmt: skip
    assert np.abs(features.points).max() <= 200
    edges = [features.polyline(index)[:, :2] for index in features.find_indices((MapFeatureType.EDGE_BOUNDARY,))]
    for edge in edges:
        side_m = -2 if edge[0, 1] < 0 else 6
        np.testing.assert_allclose(edge[:, 1], side_m, atol=0.05)  # not across the street, where blocks end
        to_the_left = 1 if edge[0, 1] < 0 else -1  # the road is on the left of its edges
        assert np.sign(edge[-1, 0] - edge[0, 0]) == to_the_left


def test_off_the_map_there_is_an_empty_one():
    nowhere = SimpleNamespace(get_proximal_map_objects=lambda point, radius, layers: {layer: [] for layer in layers})
    features, lights = build_map(nowhere, [light(7, "RED")], START)
    assert (len(features), len(lights.step)) == (0, 0)


@pytest.mark.parametrize(
    ("name", "state"),
    [
        ("RED", LightState.STOP),
        ("YELLOW", LightState.CAUTION),
        ("GREEN", LightState.GO),
        ("UNKNOWN", LightState.UNKNOWN),
    ],
)
def test_lights_belong_to_connectors_and_lanes_of_the_same_number_have_none(name, state):
    features, lights = build_map(Map(), [light(7, name), light(99, "RED")], START)
    assert (lights.step.tolist(), lights.state.tolist()) == ([CURRENT_STEP], [state])
    lane = features.polyline(int(np.flatnonzero(features.feature_id == lights.lane_id[0])[0]))
    assert lane[0].tolist() == lights.stop_point[0].tolist() == [0.0, 0.0, 0.0]
    assert lane[-1, 0] == 200


# ---- settings and refusals ------------------------------------------------------------------------------------------


def test_hydras_settings_name_the_class_and_its_arguments():
    text = (Path(rlftsim.envs.nuplan.__file__).parent / "observation" / "rlftsim_agents.yaml").read_text()
    settings = yaml.safe_load(text)
    location, _, name = settings.pop("_target_").rpartition(".")
    assert settings.pop("_convert_") == "all"
    observation = getattr(importlib.import_module(location), name)(**settings, scenario=Scenario())
    assert (observation.model, observation.seed) == ("demo-tuned", 0)


def test_steps_of_other_lengths_are_refused_with_the_way_out():
    observation = RlftsimAgents("constant_velocity", Scenario())
    with pytest.raises(ConfigError, match=r"0\.050 s apart.*subsample_ratio_override=0\.5"):
        observation.update_observation(iteration(0, 50_000), iteration(1, 50_000), None)


def test_without_the_devkit_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "nuplan.planning.simulation.observation.abstract_observation", None)
    with pytest.raises(ConfigError, match="install nuplan-devkit"):
        RlftsimAgents("constant_velocity", Scenario())
