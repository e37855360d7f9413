"""AlpaSim's traffic service over gRPC: sessions by id, status codes, and a server. Needs the extra `alpasim`."""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from rlftsim import __version__
from rlftsim.envs import alpasim_pb2
from rlftsim.envs.alpasim_session import STEP_US, RequestError, Session, write_path
from rlftsim.errors import ConfigError, DataError, RlftsimError, in_short
from rlftsim.jobs.progress import log
from rlftsim.rollout.policy import Policy
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.types import HISTORY_STEPS, Scenario

NAME = "traffic.TrafficService"
MAX_MESSAGE_BYTES = 16 << 20
NUM_THREADS = 8
API_VERSION = (0, 54, 0)
"""Version of AlpaSim's messages that `alpasim.proto` follows."""
MAX_SESSIONS = 1000
"""Sessions that may be open at once: clients that end without a word leave theirs."""


class TrafficService:
    """The five methods of the service.

    Args:
        policy: Traffic model, frozen.
        data: Scenes by the ids of scenarios; None = no scene has a map, and each id is one.
    """

    def __init__(self, policy: Policy, data: ScenarioDataset | None) -> None:
        self.policy = policy
        self.data = data
        self.sessions: dict[str, Session] = {}
        self._lock = threading.Lock()
        self._data_lock = threading.Lock()

    def start_session(self, request: alpasim_pb2.SessionRequest) -> alpasim_pb2.Empty:
        """Begin a session.

        Raises:
            RequestError: An incomplete request, an unknown scene, or an id that is taken.
        """
        for name in ("session_uuid", "scene_id", "logged_object_trajectories"):
            if not getattr(request, name):
                raise RequestError("INVALID_ARGUMENT", f"{name} is empty")
        self._check_free(request.session_uuid)
        session = Session(request, self._find_scene(request.scene_id), self.policy)
        with self._lock:
            self._check_free(request.session_uuid)
            self.sessions[request.session_uuid] = session
        return alpasim_pb2.Empty()

    def simulate(self, request: alpasim_pb2.TrafficRequest) -> alpasim_pb2.TrafficReturn:
        """Poses of all objects but the ego, in the order of the session's request.

        Raises:
            RequestError: An unknown session, or a time without poses.
        """
        session = self.sessions.get(request.session_uuid)
        if session is None:
            raise RequestError("NOT_FOUND", f"no session {in_short(request.session_uuid)}: start it first")
        answer = alpasim_pb2.TrafficReturn()
        for object_id, path in session.simulate(request.time_query_us, request.object_trajectory_updates):
            answer.object_trajectory_updates.add(object_id=object_id, trajectory=write_path(path))
        return answer

    def close_session(self, request: alpasim_pb2.CloseRequest) -> alpasim_pb2.Empty:
        """Forget a session; calls that are under way end as usual.

        Raises:
            RequestError: An unknown session.
        """
        if self.sessions.pop(request.session_uuid, None) is None:
            raise RequestError("NOT_FOUND", f"no session {in_short(request.session_uuid)}")
        return alpasim_pb2.Empty()

    def get_metadata(self, request: alpasim_pb2.Empty) -> alpasim_pb2.Metadata:
        """Version, and the length of the history that a model sees."""
        major, minor, patch = API_VERSION
        number = alpasim_pb2.Version.Number(major=major, minor=minor, patch=patch)
        version = alpasim_pb2.Version(version_id=f"rlftsim {__version__}", grpc_api_version=number)
        return alpasim_pb2.Metadata(version_id=version, minimum_history_length_us=HISTORY_STEPS * STEP_US)

    def get_available_scenes(self, request: alpasim_pb2.Empty) -> alpasim_pb2.Scenes:
        """Ids of the scenes that have a map."""
        return alpasim_pb2.Scenes(scene_ids=[] if self.data is None else self.data.scenario_ids)

    def _check_free(self, session_uuid: str) -> None:
        if session_uuid in self.sessions:
            raise RequestError("ALREADY_EXISTS", f"session {in_short(session_uuid)} is open: close it first")
        if len(self.sessions) >= MAX_SESSIONS:
            raise RequestError("RESOURCE_EXHAUSTED", f"{MAX_SESSIONS} sessions are open: close those that have ended")

    def _find_scene(self, scene_id: str) -> Scenario | None:
        if self.data is None:
            return None
        try:
            with self._data_lock:
                return self.data.by_id(scene_id)
        except DataError as error:
            raise RequestError("NOT_FOUND", f"scene {in_short(scene_id)}: {error}") from None


METHODS = {
    "start_session": (alpasim_pb2.SessionRequest, alpasim_pb2.Empty),
    "simulate": (alpasim_pb2.TrafficRequest, alpasim_pb2.TrafficReturn),
    "close_session": (alpasim_pb2.CloseRequest, alpasim_pb2.Empty),
    "get_metadata": (alpasim_pb2.Empty, alpasim_pb2.Metadata),
    "get_available_scenes": (alpasim_pb2.Empty, alpasim_pb2.Scenes),
}
"""Messages of each method, request and answer."""


def start_server(service: TrafficService, *, host: str, port: int) -> tuple[Any, int]:
    """Server that answers, and the port.

    Args:
        service: Methods that the server calls.
        host: Address to listen on.
        port: Port to listen on; 0 takes a free one.

    Raises:
        ConfigError: grpcio is not installed, or the port is taken.
    """
    try:
        import grpc
    except ModuleNotFoundError:
        raise ConfigError("the AlpaSim service needs grpcio: pip install 'rlftsim[alpasim]'.") from None

    def answer(method: Callable[[Any], Any]) -> Callable[[Any, Any], Any]:
        def handle(request: Any, context: Any) -> Any:
            try:
                return method(request)
            except RequestError as error:
                status, text = error.status, str(error)
            except RlftsimError as error:  # of the model: nothing is made up in its place
                status, text = "FAILED_PRECONDITION", str(error)
            except Exception as error:
                log.warning(f"{method.__name__}: {error!r}")
                status, text = "INTERNAL", f"{type(error).__name__}: {error}"
            context.abort(grpc.StatusCode[status], text)

        return handle

    handlers = {
        name: grpc.unary_unary_rpc_method_handler(
            answer(getattr(service, name)), request_type.FromString, answer_type.SerializeToString
        )
        for name, (request_type, answer_type) in METHODS.items()
    }
    sizes = [(f"grpc.max_{side}_message_length", MAX_MESSAGE_BYTES) for side in ("receive", "send")]
    server = grpc.server(ThreadPoolExecutor(NUM_THREADS), options=[*sizes, ("grpc.so_reuseport", 0)])
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(NAME, handlers),))
    try:
        port = server.add_insecure_port(f"{host}:{port}")
    except RuntimeError as error:
        raise ConfigError(f"--host {host} --port {port} cannot be listened on ({error}): name another one.") from None
    server.start()
    return server, port
