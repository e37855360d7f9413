"""A session of AlpaSim's traffic service: objects as agents of a world, and poses at any time.

Up to the handover objects replay the poses that the client sent. From there on the world steps every 0.1 s, as `rlftsim
drive` does: the client moves the ego, the policy all other agents, and poses between two steps are interpolated. The
protocol is in `alpasim_service`.
"""

import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from math import isfinite
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int64

from rlftsim.envs import alpasim_pb2
from rlftsim.envs.drivers import Driver
from rlftsim.envs.world import Dice, WorldState, begin, build_world, step_world
from rlftsim.errors import RlftsimError, in_short
from rlftsim.geometry import wrapped
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.rollout.edge_scenes import without_future
from rlftsim.rollout.policy import Policy
from rlftsim.scenario.types import (
    CURRENT_STEP,
    FUTURE_STEPS,
    HISTORY_STEPS,
    STEP_S,
    LightStates,
    MapFeatures,
    ObjectType,
    Scenario,
    Tracks,
)

EGO = "EGO"
STEP_US = 100_000
HORIZON_US = FUTURE_STEPS * STEP_US
LABELS = {
    ObjectType.VEHICLE: ("automobile", "vehicle", "car", "truck", "bus", "trailer", "other_vehicle"),
    ObjectType.PEDESTRIAN: ("person", "pedestrian"),
    ObjectType.CYCLIST: ("bicycle", "bike", "cyclist", "cycle"),
}
"""Labels of objects, in lower case, by type; others are of the type OTHER."""
TYPE_OF_LABEL = {label: object_type for object_type, labels in LABELS.items() for label in labels}


class RequestError(RlftsimError):
    """A request that is not carried out.

    Args:
        status: Name of the gRPC status code.
        message: Sentence with the value, the cause and the way out.
    """

    def __init__(self, status: str, message: str) -> None:
        super().__init__(message)
        self.status = status


class PosePath(NamedTuple):
    """Poses of an object over time."""

    time_us: Int64[np.ndarray, "n"]
    """Rising."""
    pose: Float[np.ndarray, "n 4"]
    """x, y, z of the center, m, and heading, rad, which turns continuously."""

    def at(self, time_us: Int64[np.ndarray, "m"]) -> Float[np.ndarray, "m 4"]:
        """Poses at some times, interpolated; before the first and after the last pose these hold."""
        return np.stack([np.interp(time_us, self.time_us, column) for column in self.pose.T], -1)

    def velocity_at(self, time_us: Int64[np.ndarray, "m"], end_us: int) -> Float[np.ndarray, "m 2"]:
        """Mean velocities from a step before some times to a step after, as far as there are poses, m/s.

        Args:
            time_us: Times of the velocities.
            end_us: Time after which no pose is read.
        """
        first_us = self.time_us[0]
        last_us = max(first_us, min(self.time_us[-1], end_us))
        span_start, span_end = (np.clip(time_us + shift, first_us, last_us) for shift in (-STEP_US, STEP_US))
        span_s = np.maximum(span_end - span_start, 1)[:, None] / 1e6
        return (self.at(span_end) - self.at(span_start))[:, :2] / span_s

    def covers(self, time_us: Int64[np.ndarray, "m"] | int) -> Any:
        """True at times from the first to the last pose, for one time or each of several."""
        return (self.time_us[0] <= time_us) & (time_us <= self.time_us[-1])


def read_path(trajectory: alpasim_pb2.Trajectory, object_id: str) -> PosePath:
    """PosePath of a message.

    Args:
        trajectory: Poses in the local frame.
        object_id: Object that messages name.

    Raises:
        RequestError: No pose, times that do not rise, or a number that is not finite.
    """
    poses = [(p.pose.vec, p.pose.quat, p.timestamp_us) for p in trajectory.poses]
    time_us = np.array([time for *_, time in poses], np.uint64).astype(np.int64)
    if not poses or (np.diff(time_us) <= 0).any() or (time_us < 0).any():
        raise RequestError("INVALID_ARGUMENT", f"object {in_short(object_id)} has no poses, or times that do not rise")
    x, y, z = np.array([(vec.x, vec.y, vec.z) for vec, *_ in poses]).T
    w, i, j, k = np.array([(quat.w, quat.x, quat.y, quat.z) for _, quat, _ in poses]).T
    heading = np.unwrap(np.arctan2(2 * (w * k + i * j), 1 - 2 * (j * j + k * k)))
    pose = np.stack([x, y, z, heading], -1)
    if not (np.isfinite(pose).all() and (np.abs(w * w + i * i + j * j + k * k - 1) < 1e-2).all()):
        text = f"object {in_short(object_id)} has a pose that is not finite, or a quaternion that is not of length 1"
        raise RequestError("INVALID_ARGUMENT", text)
    return PosePath(time_us, pose)


def write_path(path: PosePath) -> alpasim_pb2.Trajectory:
    """Message of a path."""
    trajectory = alpasim_pb2.Trajectory()
    half = path.pose[:, 3] / 2
    for time_us, (x, y, z, _), w, k in zip(path.time_us.tolist(), path.pose.tolist(), np.cos(half), np.sin(half)):
        vec, quat = alpasim_pb2.Vec3(x=x, y=y, z=z), alpasim_pb2.Quat(w=w, z=k)
        trajectory.poses.add(pose=alpasim_pb2.Pose(vec=vec, quat=quat), timestamp_us=time_us)
    return trajectory


@dataclass(frozen=True)
class LoggedObject:
    """An object of a session as the client sent it."""

    object_id: str
    object_type: ObjectType
    size: tuple[float, float, float]
    is_static: bool
    path: PosePath


def read_objects(messages: Iterable[alpasim_pb2.ObjectTrajectory]) -> list[LoggedObject]:
    """Objects of a session, in the order of the messages.

    Raises:
        RequestError: No ego, an object twice, a box without a size, or poses that are none.
    """
    objects = []
    for message in messages:
        name, size = message.object_id, (message.aabb.size_x, message.aabb.size_y, message.aabb.size_z)
        if not all(isfinite(side) and side > 0 for side in size):
            raise RequestError("INVALID_ARGUMENT", f"object {in_short(name)} has a box of {size} m")
        label = "vehicle" if name == EGO else message.label_class.lower()
        object_type = TYPE_OF_LABEL.get(label, ObjectType.OTHER)
        path = read_path(message.trajectory, name)
        objects.append(LoggedObject(name, object_type, size, message.is_static, path))
    names = [logged.object_id for logged in objects]
    if EGO not in names or len(set(names)) < len(names):
        raise RequestError("INVALID_ARGUMENT", f"a session has one object {EGO} and no object twice, got {len(names)}")
    return objects


def build_session_scenario(
    scene_id: str, scene: Scenario | None, objects: Sequence[LoggedObject], handover_us: int
) -> Scenario:
    """Scenario without a future whose current step is the handover: objects of the session on the map of the scene.

    Args:
        scene_id: Id of the scenario.
        scene: Scenario with the map and the lights; None = there are none.
        objects: Objects that have a pose at the handover, the ego among them; tracks in this order.
        handover_us: Time of the current step.
    """
    times = handover_us + STEP_US * np.arange(-CURRENT_STEP, 1)
    is_static = np.array([logged.is_static for logged in objects])
    pose = np.stack([logged.path.at(times) for logged in objects])  # [A, 11, 4]
    velocity = np.stack([logged.path.velocity_at(times, handover_us) for logged in objects])
    is_covered = np.stack([logged.path.covers(times) for logged in objects])  # [A, 11]
    size = np.array([logged.size for logged in objects], np.float32)
    count = len(objects)
    tracks = Tracks(
        object_id=np.arange(count),
        object_type=np.array([logged.object_type for logged in objects], np.int8),
        position=pose[..., :3].astype(np.float32),
        heading=wrapped(pose[..., 3]).astype(np.float32),
        velocity=velocity.astype(np.float32),
        size=np.repeat(size[:, None], HISTORY_STEPS, 1),
        valid=is_covered | is_static[:, None],
    )
    return Scenario(
        scenario_id=scene_id,
        timestamps_s=STEP_S * np.arange(HISTORY_STEPS),
        tracks=tracks,
        map_features=MapFeatures.of([]) if scene is None else scene.map_features,
        lights=LightStates.of([]) if scene is None else without_future(scene).lights,
        ego_index=[logged.object_id for logged in objects].index(EGO),
        tracks_to_predict=np.zeros(0, np.int32),
        difficulty=np.zeros(0, np.int8),
        objects_of_interest=np.zeros(0, np.int64),
        guessed=frozenset() if scene is None else scene.guessed,
    )


class Session:
    """State of a session; a call waits until earlier calls have ended.

    Args:
        request: Objects, seed and handover.
        scene: Scenario with the map of the scene; None = there is no map.
        policy: Traffic model.

    Raises:
        RequestError: Impossible objects or handover, or a scene without a map for a model with maps.
    """

    def __init__(self, request: alpasim_pb2.SessionRequest, scene: Scenario | None, policy: Policy) -> None:
        self.handover_us = request.handover_time_us
        self.objects = read_objects(request.logged_object_trajectories)
        agents = [o for o in self.objects if o.is_static or o.path.covers(self.handover_us)]
        if not 0 < self.handover_us < 1 << 62 or EGO not in [o.object_id for o in agents]:
            raise RequestError("INVALID_ARGUMENT", f"at handover {self.handover_us} us {EGO} has no pose: send its log")
        if (scene is None or not len(scene.map_features)) and not isinstance(policy, ConstantVelocity):
            raise RequestError(
                "FAILED_PRECONDITION",
                f"scene {in_short(request.scene_id)} has no map, which this model needs: name --data with the scene, "
                "or serve --model constant_velocity",
            )
        self.rows = {logged.object_id: row for row, logged in enumerate(agents)}
        self.ego = self.rows[EGO]
        self.ego_path = self._cut_ego_path()
        scenario = build_session_scenario(request.scene_id, scene, agents, self.handover_us)
        rules = {row: "replay" for row, logged in enumerate(agents) if logged.is_static and row != self.ego}
        self.world = build_world([scenario], policy, rules={"ego": "planner", **rules})
        self.state = begin(self.world, [Dice(request.random_seed)])
        """At the last step whose time the ego's poses reach."""
        self.next_state: WorldState | None = None
        """One step later, but for the ego, whose pose then is not known yet."""
        self.lock = threading.Lock()

    def _cut_ego_path(self) -> PosePath:
        """The ego's log up to the handover: later poses are the client's to say."""
        path = next(logged.path for logged in self.objects if logged.object_id == EGO)
        is_past = path.time_us < self.handover_us
        current = path.at(np.array([self.handover_us]))
        return PosePath(
            np.append(path.time_us[is_past], self.handover_us), np.concatenate([path.pose[is_past], current])
        )

    def simulate(self, query_us: int, updates: Iterable[alpasim_pb2.ObjectUpdate]) -> list[tuple[str, PosePath]]:
        """Pose of each object but the ego at a time, and the poses after it that are decided already.

        Args:
            query_us: Time of the poses.
            updates: Poses of the ego up to this time; those of other objects are not read.

        Raises:
            RequestError: A time beyond the horizon, or that the ego's poses do not reach.
        """
        with self.lock:
            for update in updates:
                if update.object_id == EGO:
                    self._extend_ego_path(read_path(update.trajectory, EGO))
            if query_us > self.handover_us:
                if query_us > self.handover_us + HORIZON_US:
                    horizon = f"{HORIZON_US / 1e6:g} s after the handover"
                    raise RequestError("INVALID_ARGUMENT", f"{query_us} us is beyond the horizon, {horizon}")
                if query_us > self.ego_path.time_us[-1]:
                    last = self.ego_path.time_us[-1]
                    raise RequestError("INVALID_ARGUMENT", f"poses of {EGO} end at {last} us, before {query_us} us")
                self._advance(query_us)
            return list(self._collect_paths(query_us))

    def _extend_ego_path(self, update: PosePath) -> None:
        """Append the poses of an update, which replace a plan; poses that the world has stepped by do not change."""
        now_us = self.handover_us + self.state.step * STEP_US
        is_new, is_past = update.time_us > now_us, self.ego_path.time_us <= now_us
        is_past |= self.ego_path.time_us < update.time_us[is_new].min(initial=np.iinfo(np.int64).max)
        joined = np.concatenate([self.ego_path.pose[is_past], update.pose[is_new]])
        joined[:, 3] = np.unwrap(joined[:, 3])
        self.ego_path = PosePath(np.append(self.ego_path.time_us[is_past], update.time_us[is_new]), joined)

    def _advance(self, query_us: int) -> None:
        """Step the world to the last step before the query, and decide the next steps."""
        while self.state.step < FUTURE_STEPS:
            time_us = self.handover_us + (self.state.step + 1) * STEP_US
            if self.next_state is None:
                self.next_state = step_world(self.world, self.state, self.state.motion[0, [self.ego]])
            if time_us > query_us:
                return
            motion = self.next_state.motion.copy()
            motion[0, self.ego] = self._move_ego(time_us)
            self.state, self.next_state = replace(self.next_state, track=(*self.next_state.track[:-1], motion)), None

    def _move_ego(self, time_us: int) -> Float[np.ndarray, "5"]:
        """Motion of the ego at a time, map frame."""
        previous, current = self.ego_path.at(np.array([time_us - STEP_US, time_us]))
        velocity = (current[:2] - previous[:2]) / STEP_S
        return np.concatenate([current[:2] - self.world.scenes[0].scenario.origin, wrapped(current[3:]), velocity])

    def _collect_paths(self, query_us: int) -> Iterable[tuple[str, PosePath]]:
        """PosePath of each object from the query on, but of those without a pose then."""
        is_logged = query_us <= self.handover_us
        simulated = None if is_logged else self._collect_poses(query_us)
        for logged in self.objects:
            if logged.object_id == EGO:
                continue
            row = self.rows.get(logged.object_id)
            if simulated is not None and row is not None and self.world.drivers[0, row] == Driver.POLICY:
                times, poses = simulated
                yield logged.object_id, PosePath(times, poses[row])
            elif logged.is_static or logged.path.covers(query_us):
                times = np.array([query_us])
                yield logged.object_id, PosePath(times, logged.path.at(times))

    def _collect_poses(self, query_us: int) -> tuple[Int64[np.ndarray, "m"], Float[np.ndarray, "A m 4"]]:
        """Poses of all agents at the query and at the steps after it that are decided."""
        track, z = [m[0, :, :3] for m in self.state.track[CURRENT_STEP:]], [h[0] for h in self.state.z[CURRENT_STEP:]]
        if self.next_state is not None:
            assert self.next_state.block is not None
            assert self.next_state.block.poses is not None
            decided = self.next_state.block.poses[0]  # [A, k, 3]
            num_past = self.state.step % decided.shape[1]
            track += list(np.moveaxis(decided[:, num_past:], 1, 0))
            z += [self.next_state.z[-1][0]] * (decided.shape[1] - num_past)
        motion, height = np.stack(track, 1), np.stack(z, 1)  # [A, steps, ...]
        position = motion[..., :2] + self.world.scenes[0].scenario.origin
        heading = np.unwrap(motion[..., 2], axis=1)
        pose = np.concatenate([position, height[..., None], heading[..., None]], -1)
        step_us = self.handover_us + STEP_US * np.arange(pose.shape[1])
        times = np.append(query_us, step_us[step_us > query_us])
        return times, np.stack([PosePath(step_us, agent).at(times) for agent in pose])
