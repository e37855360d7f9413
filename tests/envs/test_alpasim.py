"""AlpaSim's traffic service, spoken with by a client of its own: messages by their published field numbers."""

import gc
import sys
import threading
import weakref
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from rlftsim.envs import alpasim_service
from rlftsim.envs.world import Dice, begin, build_world, step_world
from rlftsim.errors import ConfigError
from rlftsim.policies.registry import load_policy
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.rollout.edge_scenes import without_future
from rlftsim.rollout.policy import frozen_copy
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.verbs.serve import serve_alpasim

grpc = pytest.importorskip("grpc", reason="the service needs grpcio")

FIELDS = {
    "Empty": "",
    "Vec3": "float x 1, float y 2, float z 3",
    "Quat": "float w 1, float x 2, float y 3, float z 4",
    "Pose": "Vec3 vec 1, Quat quat 2",
    "PoseAtTime": "Pose pose 1, fixed64 timestamp_us 2",
    "Trajectory": "*PoseAtTime poses 1",
    "AABB": "float size_x 1, float size_y 2, float size_z 3",
    "ObjectTrajectory": "AABB aabb 1, Trajectory trajectory 2, string object_id 3, bool is_static 4, "
    "string label_class 5",
    "Update": "string object_id 1, Trajectory trajectory 2",
    "Session": "string session_uuid 1, string scene_id 2, fixed64 random_seed 3, "
    "*ObjectTrajectory logged_object_trajectories 4, fixed64 handover_time_us 5",
    "Close": "string session_uuid 1",
    "Request": "string session_uuid 1, fixed64 time_query_us 2, *Update object_trajectory_updates 3",
    "Return": "*Update object_trajectory_updates 1",
    "Number": "uint32 major 1, uint32 minor 2, uint32 patch 3",
    "Version": "string version_id 1, string git_hash 2, Number grpc_api_version 3",
    "Metadata": "Version version_id 1, fixed64 minimum_history_length_us 2",
    "Scenes": "*string scene_ids 1",
}
METHODS = {
    "start_session": ("Session", "Empty"),
    "simulate": ("Request", "Return"),
    "close_session": ("Close", "Empty"),
    "get_metadata": ("Empty", "Metadata"),
    "get_available_scenes": ("Empty", "Scenes"),
}
HANDOVER_US = 1_700_000_000_000_000
LABELS = {1: "automobile", 2: "Person", 3: "bicycle"}
SEED = 7


def build_messages():
    """Message classes of `FIELDS`."""
    file = descriptor_pb2.FileDescriptorProto(name="client.proto", package="client", syntax="proto3")
    scalars = {"float": 2, "fixed64": 6, "bool": 8, "string": 9, "uint32": 13}
    for name, fields in FIELDS.items():
        message = file.message_type.add(name=name)
        for text in filter(None, fields.split(", ")):
            kind, field, number = text.split()
            added = message.field.add(name=field, number=int(number), label=3 if kind[0] == "*" else 1)
            kind = kind.lstrip("*")
            if kind in scalars:
                added.type = scalars[kind]
            else:
                added.type, added.type_name = 11, f".client.{kind}"
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return {name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"client.{name}")) for name in FIELDS}


M = build_messages()


class Client:
    def __init__(self, port):
        self.channel = grpc.insecure_channel(f"127.0.0.1:{port}", [("grpc.max_receive_message_length", 1 << 24)])

    def call(self, method, **fields):
        request_type, answer_type = (M[name] for name in METHODS[method])
        path = f"/traffic.TrafficService/{method}"
        stub = self.channel.unary_unary(path, request_type.SerializeToString, answer_type.FromString)
        return stub(request_type(**fields), timeout=60)

    def fails(self, method, **fields):
        with pytest.raises(grpc.RpcError) as caught:
            self.call(method, **fields)
        return caught.value.code().name


@pytest.fixture(scope="module")
def data():
    return ScenarioDataset("synthetic", "validation")


def serve(policy, data):
    service = alpasim_service.TrafficService(frozen_copy(policy), data)
    server, port = alpasim_service.start_server(service, host="127.0.0.1", port=0)
    return server, Client(port), service


@pytest.fixture(scope="module")
def served(data):
    server, client, service = serve(ConstantVelocity(), data)
    yield client, service
    server.stop(None).wait()


def poses(times, xyz, heading):
    half = heading / 2
    return M["Trajectory"](poses=[
        M["PoseAtTime"](
            pose=M["Pose"](vec=M["Vec3"](x=x, y=y, z=z), quat=M["Quat"](w=w, z=k)), timestamp_us=int(time)
        )
        for time, (x, y, z), w, k in zip(times, xyz, np.cos(half), np.sin(half))
    ])  # fmt: skip


def list_objects(scenario):
    """Ego first, then all other agents, with their logged states up to the handover."""
    tracks = scenario.tracks
    others = [row for row in scenario.simulated_indices if row != scenario.ego_index]
    objects = []
    for row in (scenario.ego_index, *others):
        steps = np.flatnonzero(tracks.valid[row, :11])
        times = HANDOVER_US + (steps - 10) * 100_000
        size = dict(zip(("size_x", "size_y", "size_z"), tracks.size[row, 10].tolist()))
        objects.append(M["ObjectTrajectory"](
            aabb=M["AABB"](**size),
            trajectory=poses(times, tracks.position[row, steps], tracks.heading[row, steps]),
            object_id="EGO" if row == scenario.ego_index else str(tracks.object_id[row]),
            label_class="" if row == scenario.ego_index else LABELS[int(tracks.object_type[row])],
        ))  # fmt: skip
    return objects


def start(client, scenario, uuid="a", **changes):
    fields = dict(
        session_uuid=uuid, scene_id=scenario.scenario_id, random_seed=SEED, handover_time_us=HANDOVER_US,
        logged_object_trajectories=list_objects(scenario),
    )  # fmt: skip
    return client.call("start_session", **(fields | changes))


def as_sent(scenario):
    """The scenario of what a client sends: ego first, gaps interpolated, velocities that follow from positions."""
    rows = [scenario.ego_index, *(row for row in scenario.simulated_indices if row != scenario.ego_index)]
    tracks = scenario.tracks.select(np.array(rows)).cut(slice(11))
    position, heading, velocity, valid = (
        values.copy() for values in (tracks.position, tracks.heading, tracks.velocity, tracks.valid)
    )
    for row in range(len(rows)):
        steps = np.flatnonzero(tracks.valid[row])
        span = np.arange(steps[0], 11)
        for axis in range(3):
            position[row, span, axis] = np.interp(span, steps, tracks.position[row, steps, axis])
        heading[row, span] = np.interp(span, steps, np.unwrap(tracks.heading[row, steps]))
        valid[row, span] = True
        velocity[row, span] = 0.0
        if len(span) > 1:
            velocity[row, span] = np.gradient(position[row, span, :2].astype(np.float64), 0.1, axis=0)
    heading = (np.remainder(heading + np.pi, 2 * np.pi) - np.pi).astype(np.float32)
    size = np.repeat(tracks.size[:, 10:], 11, 1)
    return replace(
        without_future(scenario), ego_index=0, tracks_to_predict=np.zeros(0, np.int32), difficulty=np.zeros(0, np.int8),
        tracks=replace(tracks, position=position, heading=heading, velocity=velocity, valid=valid, size=size),
    )  # fmt: skip


def drive(client, scenario, uuid="a", steps=range(1, 81), query=lambda step: HANDOVER_US + step * 100_000):
    """Answers of a session in which the ego goes where a path says."""
    answers = []
    for step in steps:
        xyz, heading = scenario.ego_path[step]
        update = M["Update"](object_id="EGO", trajectory=poses([query(step)], [xyz], np.array([heading])))
        fields = dict(session_uuid=uuid, time_query_us=query(step), object_trajectory_updates=[update])
        answers.append(client.call("simulate", **fields))
    return answers


def read(answer, index=0):
    """x, y, heading of all objects at their first pose."""
    rows = []
    for update in answer.object_trajectory_updates:
        vec, quat = update.trajectory.poses[index].pose.vec, update.trajectory.poses[index].pose.quat
        rows.append((vec.x, vec.y, 2 * np.arctan2(quat.z, quat.w)))
    return np.array(rows)


def difference(first, second):
    turn = np.angle(np.exp(1j * (first[..., 2] - second[..., 2])))
    return max(np.abs(first[..., :2] - second[..., :2]).max(), np.abs(turn).max())


def drive_world(policy, scenario, path):
    """x, y, heading [A, 80, 3] of the world of `rlftsim drive`, in which the ego goes along a path."""
    world = build_world([scenario], policy, rules={"ego": "planner"})
    state = begin(world, [Dice(SEED)])
    for step in range(1, 81):
        (x, y, _), heading = path.ego_path[step]
        before = state.motion[0, 0, :2]
        position = np.array([x, y]) - scenario.origin
        velocity = (position - before) / 0.1
        state = step_world(world, state, np.array([[*position, heading, *velocity]]))
    motion = np.stack(state.track[11:], 2)[0, :, :, :3]
    return motion + np.append(scenario.origin, 0.0)


@pytest.mark.slow
def test_scenarios_are_driven_as_rlftsim_drive_drives_them(data):
    policy = frozen_copy(load_policy("demo-base"))
    server, client, service = serve(policy, data)
    for scenario in data[3:20:4]:  # of 11 to 55 agents
        start(client, scenario)
        path = straight_on(scenario)
        simulated = np.stack([read(answer) for answer in drive(client, path)], 1)
        assert difference(simulated, drive_world(policy, as_sent(scenario), path)[1:]) <= 1e-3, scenario.scenario_id
        client.call("close_session", session_uuid="a")
    server.stop(None).wait()
    assert not service.sessions


class Driven:
    """Where a client lets the ego go."""

    def __init__(self, ego_path):
        self.ego_path = ego_path


def straight_on(scenario, query=None):
    """The ego at constant velocity, at steps from 0 on that need not be whole."""
    tracks, ego = scenario.tracks, scenario.ego_index
    position, heading = tracks.position[ego, 10], float(tracks.heading[ego, 10])
    velocity = np.append(tracks.velocity[ego, 10], 0)
    return Driven({step: (position + 0.1 * step * velocity, heading) for step in query or range(81)})


def test_times_between_the_steps_are_interpolated_and_before_the_handover_the_log_is_replayed(served, data):
    client, _ = served
    scenario = data[0]
    start(client, scenario, "grid")
    start(client, scenario, "between")
    on_grid = [read(a) for a in drive(client, straight_on(scenario), "grid", range(1, 21))]
    steps = [0.5, 1.25, 7.999, 15.0, 19.5]
    query = lambda step: HANDOVER_US + round(step * 100_000)  # noqa: E731
    answers = drive(client, straight_on(scenario, steps), "between", steps, query)
    for step, answer in zip(steps[1:], answers[1:]):
        below, above = on_grid[int(step) - 1], on_grid[int(step)] if step % 1 else on_grid[int(step) - 1]
        expected = below + (step % 1) * (above - below)
        assert difference(read(answer), expected) <= 1e-3
        times = [pose.timestamp_us for pose in answer.object_trajectory_updates[0].trajectory.poses]
        assert times[0] == query(step)
        assert all(time % 100_000 == HANDOVER_US % 100_000 and time > query(step) for time in times[1:])
    order = [update.object_id for update in answers[0].object_trajectory_updates]
    assert order == [o.object_id for o in list_objects(scenario)[1:]]
    # the log, half way between two of its states
    answer = client.call("simulate", session_uuid="grid", time_query_us=HANDOVER_US - 150_000)
    by_id = {str(i): row for row, i in enumerate(scenario.tracks.object_id)}
    for update in answer.object_trajectory_updates:
        row = by_id[update.object_id]
        expected = scenario.tracks.position[row, 8:10].mean(0)
        pose = update.trajectory.poses[0]
        assert len(update.trajectory.poses) == 1
        if scenario.tracks.valid[row, 8:10].all():
            assert (pose.pose.vec.x, pose.pose.vec.y) == pytest.approx(expected[:2], abs=1e-3)


def test_a_plan_of_the_ego_is_replaced_by_where_it_goes(served, data):
    client, _ = served
    path = straight_on(data[0])
    motions = []
    for plan_steps in ([1], [1, 5, 40]):
        uuid = f"plan-{len(plan_steps)}"
        client.call(
            "start_session", session_uuid=uuid, scene_id=data[0].scenario_id, random_seed=0,
            handover_time_us=HANDOVER_US, logged_object_trajectories=list_objects(data[0]),
        )  # fmt: skip
        times = [HANDOVER_US + step * 100_000 for step in plan_steps]
        places = [path.ego_path[1][0] + np.array([9.0 * (step > 1), 0, 0]) for step in plan_steps]
        plan = M["Update"](object_id="EGO", trajectory=poses(times, places, np.full(len(times), path.ego_path[1][1])))
        client.call("simulate", session_uuid=uuid, time_query_us=times[0], object_trajectory_updates=[plan])
        motions.append(np.array([read(answer) for answer in drive(client, path, uuid, range(2, 31))]))
    assert difference(*motions) < 1e-6


def test_two_sessions_at_once_do_not_touch_each_other(served, data):
    client, _ = served
    answers = {}

    def run(number):
        start(client, data[number], f"thread-{number}")
        answers[number] = [read(a) for a in drive(client, straight_on(data[number]), f"thread-{number}", range(1, 31))]

    threads = [threading.Thread(target=run, args=(number,)) for number in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for number in (0, 1):
        start(client, data[number], f"alone-{number}")
        alone = drive(client, straight_on(data[number]), f"alone-{number}", range(1, 31))
        assert all((read(a) == b).all() for a, b in zip(alone, answers[number]))


def test_every_mistake_has_its_status(served, data, monkeypatch):
    client, service = served
    scenario = data[0]
    objects = list_objects(scenario)
    fields = dict(
        session_uuid="m", scene_id=scenario.scenario_id, random_seed=0, handover_time_us=HANDOVER_US,
        logged_object_trajectories=objects,
    )  # fmt: skip
    no_ego, broken, twice = (
        objects[1:],
        [M["ObjectTrajectory"].FromString(o.SerializeToString()) for o in objects],
        objects + objects[1:2],
    )
    broken[1].trajectory.poses[0].pose.vec.x = float("nan")
    flat = [M["ObjectTrajectory"].FromString(o.SerializeToString()) for o in objects]
    flat[2].aabb.size_y = 0
    turned = [M["ObjectTrajectory"].FromString(o.SerializeToString()) for o in objects]
    turned[1].trajectory.poses[0].pose.ClearField("quat")
    for change in (
        {"session_uuid": ""}, {"scene_id": ""}, {"logged_object_trajectories": []}, {"handover_time_us": 0},
        {"logged_object_trajectories": no_ego}, {"logged_object_trajectories": broken},
        {"logged_object_trajectories": twice}, {"logged_object_trajectories": flat},
        {"logged_object_trajectories": turned},
        {"handover_time_us": HANDOVER_US + 50_000_000},
    ):  # fmt: skip
        assert client.fails("start_session", **(fields | change)) == "INVALID_ARGUMENT", change
    assert client.fails("start_session", **(fields | {"scene_id": "nowhere"})) == "NOT_FOUND"
    assert client.fails("simulate", session_uuid="m", time_query_us=HANDOVER_US + 1) == "NOT_FOUND"
    assert client.fails("close_session", session_uuid="m") == "NOT_FOUND"
    client.call("start_session", **fields)
    assert client.fails("start_session", **fields) == "ALREADY_EXISTS"
    short = dict(session_uuid="m", time_query_us=HANDOVER_US + 100_000)
    assert client.fails("simulate", **short) == "INVALID_ARGUMENT"  # the ego's poses end at the handover
    assert client.fails("simulate", session_uuid="m", time_query_us=HANDOVER_US + 8_000_001) == "INVALID_ARGUMENT"
    last = drive(client, straight_on(scenario), "m", [80])
    assert len(last[0].object_trajectory_updates) == len(objects) - 1
    service.sessions["m"].state = None  # an error of the code
    assert client.fails("simulate", session_uuid="m", time_query_us=HANDOVER_US + 8_000_000) == "INTERNAL"
    client.call("close_session", session_uuid="m")
    monkeypatch.setattr(alpasim_service, "MAX_SESSIONS", 0)
    assert client.fails("start_session", **fields) == "RESOURCE_EXHAUSTED"
    monkeypatch.undo()
    server, other, _ = serve(load_policy("demo-base"), None)
    assert other.fails("start_session", **fields) == "FAILED_PRECONDITION"  # no map: nothing is made up
    server.stop(None).wait()


def test_objects_without_a_model_stand_or_are_replayed(served, data):
    client, _ = served
    scenario = data[0]
    objects = list_objects(scenario)
    objects[1].is_static = True
    del objects[1].trajectory.poses[1:]
    late = M["ObjectTrajectory"].FromString(objects[2].SerializeToString())
    late.object_id = "late"
    for pose in late.trajectory.poses:
        pose.timestamp_us += 1_500_000
    start(client, scenario, "s", logged_object_trajectories=[*objects, late])
    early, then = drive(client, straight_on(scenario), "s", [1, 10])
    names = [update.object_id for update in early.object_trajectory_updates]
    assert "late" not in names
    assert then.object_trajectory_updates[-1].object_id == "late"
    stood = [update for update in then.object_trajectory_updates if update.object_id == objects[1].object_id]
    assert len(stood[0].trajectory.poses) == 1
    assert stood[0].trajectory.poses[0].pose == objects[1].trajectory.poses[0].pose
    client.call("close_session", session_uuid="s")


def test_version_history_and_scenes_are_told(served, data):
    client, _ = served
    metadata = client.call("get_metadata")
    assert metadata.minimum_history_length_us == 1_100_000
    assert metadata.version_id.version_id.startswith("rlftsim ")
    assert list(client.call("get_available_scenes").scene_ids) == list(data.scenario_ids)


class Gate:
    """A lock that says when a call has come, and lets it go on when told."""

    def __init__(self):
        self.has_come, self.is_open = threading.Event(), threading.Event()

    def __enter__(self):
        self.has_come.set()
        assert self.is_open.wait(60)

    def __exit__(self, *_):
        pass


def test_a_session_closed_during_a_call_ends_it_as_it_would(served, data):
    client, service = served
    start(client, data[0], "c")
    gate = service.sessions["c"].lock = Gate()
    answers = []
    thread = threading.Thread(target=lambda: answers.extend(drive(client, straight_on(data[0]), "c", [5])))
    thread.start()
    assert gate.has_come.wait(60)
    client.call("close_session", session_uuid="c")
    gate.is_open.set()
    thread.join()
    assert len(answers[0].object_trajectory_updates) == len(list_objects(data[0])) - 1
    assert client.fails("close_session", session_uuid="c") == "NOT_FOUND"


def test_a_closed_session_leaves_nothing_behind(served, data):
    client, service = served
    start(client, data[0], "gone")
    drive(client, straight_on(data[0]), "gone", [5])
    session = service.sessions["gone"]
    left = [weakref.ref(value) for value in (session, session.world, session.world.scenes[0].scenario)]
    del session
    client.call("close_session", session_uuid="gone")
    gc.collect()
    assert [reference() for reference in left] == [None] * 3


def test_a_model_without_maps_is_refused_and_a_port_that_is_taken(served):
    with pytest.raises(ConfigError, match=r"--model demo-tuned needs maps: name --data.*constant_velocity"):
        serve_alpasim()
    with pytest.raises(ConfigError, match="cannot be listened on"):
        alpasim_service.start_server(served[1], host="203.0.113.7", port=1)


def test_nothing_but_the_service_imports_grpcio_and_its_lack_is_one_line(served, monkeypatch):
    package = Path(alpasim_service.__file__).parents[1]
    importing = [path.name for path in package.rglob("*.py") if "import grpc" in path.read_text()]
    assert importing == ["alpasim_service.py"]
    monkeypatch.setitem(sys.modules, "grpc", None)
    with pytest.raises(ConfigError, match=r"needs grpcio: pip install 'rlftsim\[alpasim\]'"):
        alpasim_service.start_server(served[1], host="127.0.0.1", port=0)
