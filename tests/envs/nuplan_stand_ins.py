"""Stand-ins for the classes of nuplan-devkit 1.2.2 that the agents touch: their signatures, nothing of their code."""

import sys
from abc import ABCMeta, abstractmethod
from dataclasses import dataclass
from enum import Enum
from types import ModuleType


class AbstractObservation(metaclass=ABCMeta):
    @abstractmethod
    def reset(self): ...


@dataclass
class StateVector2D:
    x: float
    y: float


@dataclass
class Point2D:
    x: float
    y: float


@dataclass
class StateSE2:
    x: float
    y: float
    heading: float


@dataclass
class OrientedBox:
    center: StateSE2
    length: float
    width: float
    height: float

    @classmethod
    def from_new_pose(cls, box, pose):
        return cls(pose, box.length, box.width, box.height)


@dataclass(frozen=True)
class SceneObjectMetadata:
    timestamp_us: int
    token: str
    track_id: int | None
    track_token: str | None
    category_name: str | None = None


class TrackedObjectType(Enum):
    VEHICLE, PEDESTRIAN, BICYCLE, TRAFFIC_CONE, EGO = 0, 1, 2, 3, 7


class SceneObject:
    def __init__(self, tracked_object_type, oriented_box, metadata):
        self.tracked_object_type, self.box, self.metadata = tracked_object_type, oriented_box, metadata

    @property
    def center(self):
        return self.box.center

    @property
    def track_token(self):
        return self.metadata.track_token


class Agent(SceneObject):
    def __init__(
        self, tracked_object_type, oriented_box, velocity, metadata, angular_velocity=None, predictions=None,
        past_trajectory=None,
    ):  # fmt: skip
        super().__init__(tracked_object_type, oriented_box, metadata)
        self.velocity = velocity


class TrackedObjects:
    def __init__(self, tracked_objects=None):
        self.tracked_objects = sorted(tracked_objects or [], key=lambda one: one.tracked_object_type.value)

    def __iter__(self):
        return iter(self.tracked_objects)


@dataclass
class DetectionsTracks:
    tracked_objects: TrackedObjects


class SemanticMapLayer(Enum):
    LANE, INTERSECTION, CROSSWALK, LANE_CONNECTOR, CARPARK_AREA, ROADBLOCK = 0, 1, 4, 11, 15, 17


class TrafficLightStatusType(Enum):
    GREEN, YELLOW, RED, UNKNOWN = range(4)


MODULES = {
    "common.actor_state.agent": [Agent],
    "common.actor_state.oriented_box": [OrientedBox],
    "common.actor_state.scene_object": [SceneObject, SceneObjectMetadata],
    "common.actor_state.state_representation": [Point2D, StateSE2, StateVector2D],
    "common.actor_state.tracked_objects": [TrackedObjects],
    "common.actor_state.tracked_objects_types": [TrackedObjectType],
    "common.maps.maps_datatypes": [SemanticMapLayer, TrafficLightStatusType],
    "planning.simulation.observation.abstract_observation": [AbstractObservation],
    "planning.simulation.observation.observation_type": [DetectionsTracks],
}


def install(monkeypatch) -> None:
    """Make the stand-ins importable under nuPlan's names, unless the devkit itself is there."""
    try:
        import nuplan  # noqa: F401
    except ImportError:
        for name, classes in MODULES.items():
            parts = f"nuplan.{name}".split(".")
            for depth in range(1, len(parts) + 1):
                path = ".".join(parts[:depth])
                if path not in sys.modules:
                    monkeypatch.setitem(sys.modules, path, ModuleType(path))
            for one in classes:
                setattr(sys.modules[f"nuplan.{name}"], one.__name__, one)
