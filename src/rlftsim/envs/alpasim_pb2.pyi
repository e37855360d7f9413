from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Iterable as _Iterable, Mapping as _Mapping, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Empty(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class Vec3(_message.Message):
    __slots__ = ("x", "y", "z")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    x: float
    y: float
    z: float
    def __init__(self, x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ...) -> None: ...

class Quat(_message.Message):
    __slots__ = ("w", "x", "y", "z")
    W_FIELD_NUMBER: _ClassVar[int]
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    w: float
    x: float
    y: float
    z: float
    def __init__(self, w: _Optional[float] = ..., x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ...) -> None: ...

class Pose(_message.Message):
    __slots__ = ("vec", "quat")
    VEC_FIELD_NUMBER: _ClassVar[int]
    QUAT_FIELD_NUMBER: _ClassVar[int]
    vec: Vec3
    quat: Quat
    def __init__(self, vec: _Optional[_Union[Vec3, _Mapping]] = ..., quat: _Optional[_Union[Quat, _Mapping]] = ...) -> None: ...

class PoseAtTime(_message.Message):
    __slots__ = ("pose", "timestamp_us")
    POSE_FIELD_NUMBER: _ClassVar[int]
    TIMESTAMP_US_FIELD_NUMBER: _ClassVar[int]
    pose: Pose
    timestamp_us: int
    def __init__(self, pose: _Optional[_Union[Pose, _Mapping]] = ..., timestamp_us: _Optional[int] = ...) -> None: ...

class Trajectory(_message.Message):
    __slots__ = ("poses",)
    POSES_FIELD_NUMBER: _ClassVar[int]
    poses: _containers.RepeatedCompositeFieldContainer[PoseAtTime]
    def __init__(self, poses: _Optional[_Iterable[_Union[PoseAtTime, _Mapping]]] = ...) -> None: ...

class Box(_message.Message):
    __slots__ = ("size_x", "size_y", "size_z")
    SIZE_X_FIELD_NUMBER: _ClassVar[int]
    SIZE_Y_FIELD_NUMBER: _ClassVar[int]
    SIZE_Z_FIELD_NUMBER: _ClassVar[int]
    size_x: float
    size_y: float
    size_z: float
    def __init__(self, size_x: _Optional[float] = ..., size_y: _Optional[float] = ..., size_z: _Optional[float] = ...) -> None: ...

class ObjectTrajectory(_message.Message):
    __slots__ = ("aabb", "trajectory", "object_id", "is_static", "label_class")
    AABB_FIELD_NUMBER: _ClassVar[int]
    TRAJECTORY_FIELD_NUMBER: _ClassVar[int]
    OBJECT_ID_FIELD_NUMBER: _ClassVar[int]
    IS_STATIC_FIELD_NUMBER: _ClassVar[int]
    LABEL_CLASS_FIELD_NUMBER: _ClassVar[int]
    aabb: Box
    trajectory: Trajectory
    object_id: str
    is_static: bool
    label_class: str
    def __init__(self, aabb: _Optional[_Union[Box, _Mapping]] = ..., trajectory: _Optional[_Union[Trajectory, _Mapping]] = ..., object_id: _Optional[str] = ..., is_static: bool = ..., label_class: _Optional[str] = ...) -> None: ...

class SessionRequest(_message.Message):
    __slots__ = ("session_uuid", "scene_id", "random_seed", "logged_object_trajectories", "handover_time_us")
    SESSION_UUID_FIELD_NUMBER: _ClassVar[int]
    SCENE_ID_FIELD_NUMBER: _ClassVar[int]
    RANDOM_SEED_FIELD_NUMBER: _ClassVar[int]
    LOGGED_OBJECT_TRAJECTORIES_FIELD_NUMBER: _ClassVar[int]
    HANDOVER_TIME_US_FIELD_NUMBER: _ClassVar[int]
    session_uuid: str
    scene_id: str
    random_seed: int
    logged_object_trajectories: _containers.RepeatedCompositeFieldContainer[ObjectTrajectory]
    handover_time_us: int
    def __init__(self, session_uuid: _Optional[str] = ..., scene_id: _Optional[str] = ..., random_seed: _Optional[int] = ..., logged_object_trajectories: _Optional[_Iterable[_Union[ObjectTrajectory, _Mapping]]] = ..., handover_time_us: _Optional[int] = ...) -> None: ...

class CloseRequest(_message.Message):
    __slots__ = ("session_uuid",)
    SESSION_UUID_FIELD_NUMBER: _ClassVar[int]
    session_uuid: str
    def __init__(self, session_uuid: _Optional[str] = ...) -> None: ...

class ObjectUpdate(_message.Message):
    __slots__ = ("object_id", "trajectory")
    OBJECT_ID_FIELD_NUMBER: _ClassVar[int]
    TRAJECTORY_FIELD_NUMBER: _ClassVar[int]
    object_id: str
    trajectory: Trajectory
    def __init__(self, object_id: _Optional[str] = ..., trajectory: _Optional[_Union[Trajectory, _Mapping]] = ...) -> None: ...

class TrafficRequest(_message.Message):
    __slots__ = ("session_uuid", "time_query_us", "object_trajectory_updates")
    SESSION_UUID_FIELD_NUMBER: _ClassVar[int]
    TIME_QUERY_US_FIELD_NUMBER: _ClassVar[int]
    OBJECT_TRAJECTORY_UPDATES_FIELD_NUMBER: _ClassVar[int]
    session_uuid: str
    time_query_us: int
    object_trajectory_updates: _containers.RepeatedCompositeFieldContainer[ObjectUpdate]
    def __init__(self, session_uuid: _Optional[str] = ..., time_query_us: _Optional[int] = ..., object_trajectory_updates: _Optional[_Iterable[_Union[ObjectUpdate, _Mapping]]] = ...) -> None: ...

class TrafficReturn(_message.Message):
    __slots__ = ("object_trajectory_updates",)
    OBJECT_TRAJECTORY_UPDATES_FIELD_NUMBER: _ClassVar[int]
    object_trajectory_updates: _containers.RepeatedCompositeFieldContainer[ObjectUpdate]
    def __init__(self, object_trajectory_updates: _Optional[_Iterable[_Union[ObjectUpdate, _Mapping]]] = ...) -> None: ...

class Version(_message.Message):
    __slots__ = ("version_id", "git_hash", "grpc_api_version")
    class Number(_message.Message):
        __slots__ = ("major", "minor", "patch")
        MAJOR_FIELD_NUMBER: _ClassVar[int]
        MINOR_FIELD_NUMBER: _ClassVar[int]
        PATCH_FIELD_NUMBER: _ClassVar[int]
        major: int
        minor: int
        patch: int
        def __init__(self, major: _Optional[int] = ..., minor: _Optional[int] = ..., patch: _Optional[int] = ...) -> None: ...
    VERSION_ID_FIELD_NUMBER: _ClassVar[int]
    GIT_HASH_FIELD_NUMBER: _ClassVar[int]
    GRPC_API_VERSION_FIELD_NUMBER: _ClassVar[int]
    version_id: str
    git_hash: str
    grpc_api_version: Version.Number
    def __init__(self, version_id: _Optional[str] = ..., git_hash: _Optional[str] = ..., grpc_api_version: _Optional[_Union[Version.Number, _Mapping]] = ...) -> None: ...

class Metadata(_message.Message):
    __slots__ = ("version_id", "minimum_history_length_us")
    VERSION_ID_FIELD_NUMBER: _ClassVar[int]
    MINIMUM_HISTORY_LENGTH_US_FIELD_NUMBER: _ClassVar[int]
    version_id: Version
    minimum_history_length_us: int
    def __init__(self, version_id: _Optional[_Union[Version, _Mapping]] = ..., minimum_history_length_us: _Optional[int] = ...) -> None: ...

class Scenes(_message.Message):
    __slots__ = ("scene_ids",)
    SCENE_IDS_FIELD_NUMBER: _ClassVar[int]
    scene_ids: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, scene_ids: _Optional[_Iterable[str]] = ...) -> None: ...
