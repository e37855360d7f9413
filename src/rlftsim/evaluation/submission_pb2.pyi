from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Iterable as _Iterable, Mapping as _Mapping, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class SimulatedTrajectory(_message.Message):
    __slots__ = ("center_x", "center_y", "center_z", "heading", "object_id", "valid")
    CENTER_X_FIELD_NUMBER: _ClassVar[int]
    CENTER_Y_FIELD_NUMBER: _ClassVar[int]
    CENTER_Z_FIELD_NUMBER: _ClassVar[int]
    HEADING_FIELD_NUMBER: _ClassVar[int]
    OBJECT_ID_FIELD_NUMBER: _ClassVar[int]
    VALID_FIELD_NUMBER: _ClassVar[int]
    center_x: _containers.RepeatedScalarFieldContainer[float]
    center_y: _containers.RepeatedScalarFieldContainer[float]
    center_z: _containers.RepeatedScalarFieldContainer[float]
    heading: _containers.RepeatedScalarFieldContainer[float]
    object_id: int
    valid: _containers.RepeatedScalarFieldContainer[bool]
    def __init__(self, center_x: _Optional[_Iterable[float]] = ..., center_y: _Optional[_Iterable[float]] = ..., center_z: _Optional[_Iterable[float]] = ..., heading: _Optional[_Iterable[float]] = ..., object_id: _Optional[int] = ..., valid: _Optional[_Iterable[bool]] = ...) -> None: ...

class JointScene(_message.Message):
    __slots__ = ("simulated_trajectories",)
    SIMULATED_TRAJECTORIES_FIELD_NUMBER: _ClassVar[int]
    simulated_trajectories: _containers.RepeatedCompositeFieldContainer[SimulatedTrajectory]
    def __init__(self, simulated_trajectories: _Optional[_Iterable[_Union[SimulatedTrajectory, _Mapping]]] = ...) -> None: ...

class ScenarioRollouts(_message.Message):
    __slots__ = ("scenario_id", "joint_scenes")
    SCENARIO_ID_FIELD_NUMBER: _ClassVar[int]
    JOINT_SCENES_FIELD_NUMBER: _ClassVar[int]
    scenario_id: str
    joint_scenes: _containers.RepeatedCompositeFieldContainer[JointScene]
    def __init__(self, scenario_id: _Optional[str] = ..., joint_scenes: _Optional[_Iterable[_Union[JointScene, _Mapping]]] = ...) -> None: ...

class SimAgentsChallengeSubmission(_message.Message):
    __slots__ = ("scenario_rollouts",)
    SCENARIO_ROLLOUTS_FIELD_NUMBER: _ClassVar[int]
    scenario_rollouts: _containers.RepeatedCompositeFieldContainer[ScenarioRollouts]
    def __init__(self, scenario_rollouts: _Optional[_Iterable[_Union[ScenarioRollouts, _Mapping]]] = ...) -> None: ...
