"""Routes of the studio, behind `guard.Guard`, and the running server: a free port, a printed address, a quick end."""

import asyncio
import errno
import hashlib
import json
import logging
import os
import socket
import threading
import time
import webbrowser
from collections.abc import AsyncIterator
from functools import cache
from importlib import resources
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import uvicorn
from fastapi import FastAPI, Query, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response, StreamingResponse
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp

from rlftsim.errors import ConfigError, RlftsimError
from rlftsim.goals.goals_file import GoalEntry, parse_goals
from rlftsim.jobs.files import errors_name
from rlftsim.studio import Refusal
from rlftsim.studio.bodies import CheckBody, ExportBody, Metric, OpenGoalsBody, RunBody, SaveGoalsBody
from rlftsim.studio.exports import export, save_goals
from rlftsim.studio.guard import LOCAL_NAMES, Access, Guard, new_token
from rlftsim.studio.inputs import encode_imported, score_imported
from rlftsim.studio.runs import Run, Worker
from rlftsim.studio.session import Session
from rlftsim.studio.variants import to_goal_entries

POLL_S = 0.05
IDLE_S = 60.0
MAX_STREAMS = 8
LONGEST_ID = 10
ENDS = ("done", "failed")
MEDIA_TYPES = {"js": "text/javascript", "css": "text/css", "svg": "image/svg+xml"}
SHARED = ("drawing.js", "palette.css")
"""Files of `viewer` that the page loads, too."""


@cache
def static_files() -> dict[str, bytes]:
    """Files of the page by name."""
    folder = resources.files("rlftsim.studio") / "static"
    files = [file for file in folder.iterdir() if file.is_file()]
    files += [resources.files("rlftsim.viewer") / name for name in SHARED]
    return {file.name: file.read_bytes() for file in files}


@cache
def static_hash() -> str:
    """Hash of the page's files: part of all addresses, so that a browser may keep the files for ever."""
    digest = hashlib.sha256()
    for name, content in sorted(static_files().items()):
        digest.update(name.encode() + content)
    return digest.hexdigest()[:16]


def create_app(session: Session, worker: Worker, access: Access) -> ASGIApp:
    """The server as an ASGI application.

    Args:
        session: Session with data, models and folder of exports.
        worker: Thread that simulates the runs; the caller closes the worker.
        access: Hosts and token that requests have to show.
    """
    app = FastAPI(title="rlftsim studio", docs_url=None, redoc_url=None, openapi_url=None)
    for error_type in (RlftsimError, RequestValidationError, HTTPException, Exception):
        app.add_exception_handler(error_type, _answer)
    _add_page(app)
    _add_scenarios(app, session)
    _add_runs(app, worker)
    _add_files(app, session, worker)
    return Guard(app, access)


def _add_page(app: FastAPI) -> None:
    @app.get("/")
    def _page() -> Response:
        """The page."""
        text = static_files()["index.html"].replace(b"STATIC", f"static/{static_hash()}".encode())
        return Response(text, media_type="text/html; charset=utf-8")

    @app.get("/static/{version}/{name}")
    def _static(version: str, name: str) -> Response:
        """A module or style sheet; names are looked up, so no name can lead out of the folder."""
        ending = name.rpartition(".")[2]
        if version != static_hash() or name not in static_files() or ending not in MEDIA_TYPES:
            raise Refusal(f"no file {name!r} on this page.", status=404, hint="Reload the page.")
        keep = {"cache-control": "private, max-age=31536000, immutable"}
        return Response(static_files()[name], media_type=f"{MEDIA_TYPES[ending]}; charset=utf-8", headers=keep)


def _add_scenarios(app: FastAPI, session: Session) -> None:
    app.get("/api/session")(session.describe)
    app.get("/api/proposals/{split}/{scenario_id}/{agent}")(session.proposals)

    @app.get("/api/alive")
    def _alive() -> dict[str, Any]:
        """Sign of life."""
        return {"alive": True}

    @app.get("/api/scenarios")
    def _rows(
        split: str, query: Annotated[str, Query(max_length=400)] = "", offset: Annotated[int, Query(ge=0)] = 0
    ) -> dict[str, Any]:
        """A page of the index."""
        return session.rows(split, query, offset)

    @app.get("/api/scenario/{split}/{scenario_id}")
    def _scene(split: str, scenario_id: str) -> Response:
        """Scene and log."""
        return Response(session.scene(split, scenario_id), media_type="application/json")

    @app.get("/api/imported/{name}/{split}/{scenario_id}")
    def _imported(name: str, split: str, scenario_id: str) -> Response:
        """Poses of rollouts from files."""
        content = encode_imported(session.imported(name), session.scenario(split, scenario_id))
        return Response(content, media_type="application/octet-stream")

    @app.get("/api/imported/{name}/{split}/{scenario_id}/score")
    def _imported_score(name: str, split: str, scenario_id: str, metric: Metric = "2025") -> dict[str, Any]:
        """Score of rollouts from files."""
        return score_imported(session.imported(name), session.scenario(split, scenario_id), metric)

    @app.post("/api/goals/check")
    def _check(body: CheckBody) -> dict[str, Any]:
        """Refusals and doubts of goals."""
        return {"goals": session.doubts(session.scenario(body.split, body.scenario), to_goal_entries(body))}

    @app.post("/api/goals/open")
    def _open_goals(body: OpenGoalsBody) -> dict[str, Any]:
        """Entries of a goals file."""
        file = parse_goals(body.text, body.name)
        return {"goals": _to_payload(file.goals), "alternatives": _to_payload(file.alternatives)}


def _add_runs(app: FastAPI, worker: Worker) -> None:
    streams = 0

    @app.post("/api/runs")
    def _submit(body: RunBody) -> dict[str, Any]:
        """Queue a run."""
        return _describe_run(worker.submit(body))

    @app.get("/api/runs/{name}")
    def _state(name: str, after: Annotated[int, Query(ge=-1)] = -1) -> dict[str, Any]:
        """Events of a run after a number, for pages behind a proxy that holds streams back."""
        run = worker.run(name)
        events = [{"id": i, "event": e, "data": d} for i, (e, d) in enumerate(run.events) if i > after]
        return {**_describe_run(run), "events": events}

    @app.get("/api/runs/{name}/events")
    async def _events(name: str, request: Request) -> Response:
        """Events of a run as a stream."""
        nonlocal streams
        run = worker.run(name)
        last = request.headers.get("last-event-id", "")
        # Longer words are no number of an event, and Python refuses to read very long ones.
        first = int(last) + 1 if last.isdecimal() and len(last) < LONGEST_ID else 0
        if streams >= MAX_STREAMS:
            raise Refusal(f"{MAX_STREAMS} pages listen already: close one.", status=429)

        async def stream() -> AsyncIterator[str]:
            nonlocal streams
            streams += 1
            try:
                async for text in _stream(run, first, worker):
                    yield text
            finally:
                streams -= 1

        # A proxy of nginx's kind would hold the events back.
        return StreamingResponse(stream(), media_type="text/event-stream", headers={"x-accel-buffering": "no"})

    @app.get("/api/runs/{name}/chunk/{k}")
    def _chunk(name: str, k: int) -> Response:
        """Poses of a chunk."""
        return Response(worker.run(name).chunk(k), media_type="application/octet-stream")

    @app.get("/api/runs/{name}/score")
    def _score(name: str) -> dict[str, Any]:
        """Scores of the variants that are complete."""
        scores = {data["variant"]: data for event, data in list(worker.run(name).events) if event == "score"}
        return {"variants": [scores[v] for v in sorted(scores)]}

    @app.get("/api/runs/{name}/explain")
    def _explain(name: str, variant: Annotated[int, Query(ge=0)] = 0) -> dict[str, Any]:
        """Losses of a variant by feature, agent and step."""
        return worker.run(name).score(variant).explained()

    @app.post("/api/runs/{name}/cancel")
    def _cancel(name: str) -> dict[str, Any]:
        """Stop a run at the next decision."""
        worker.cancel(name)
        return {"run": name}

    @app.delete("/api/runs/{name}")
    def _drop(name: str) -> dict[str, Any]:
        """Stop and forget a run."""
        worker.drop(name)
        return {"run": name}


def _add_files(app: FastAPI, session: Session, worker: Worker) -> None:
    @app.post("/api/goals/save")
    def _save(body: SaveGoalsBody) -> dict[str, Any]:
        """Write a goals file."""
        return {"path": str(save_goals(session, body))}

    @app.post("/api/export")
    def _write(body: ExportBody) -> dict[str, Any]:
        """Write rollouts of a run."""
        return {"path": str(export(session, worker.run(body.run), body))}


async def _stream(run: Run, first: int, worker: Worker) -> AsyncIterator[str]:
    """Events of a run from number `first` on; ends with the run, with the studio, or after a minute without events."""
    sent, idle_s = first, 0.0
    while idle_s < IDLE_S and not worker.is_closed:
        events = run.events[sent:]
        for number, event in enumerate(events, sent):
            data = json.dumps(event[1], separators=(",", ":"), allow_nan=False)
            yield f"id: {number}\nevent: {event[0]}\ndata: {data}\n\n"
            if event[0] in ENDS:
                return
        sent, idle_s = sent + len(events), 0.0 if events else idle_s + POLL_S
        await asyncio.sleep(POLL_S)


def _describe_run(run: Run) -> dict[str, Any]:
    variants = [{"model": v.model, "goals": len(v.goals), "guidance": v.guidance} for v in run.variants]
    return {"run": run.name, "variants": variants, "num_rollouts": run.body.num_rollouts, "is_over": run.is_over}


def _to_payload(entries: tuple[GoalEntry, ...]) -> list[dict[str, Any]]:
    return [{"scenario": e.scenario_id, "agent": e.agent_id, "x": e.x, "y": e.y, "label": e.label} for e in entries]


async def _answer(_: Request, error: Exception) -> Response:
    """Answer to a request that failed: a sentence, and a hint where there is one."""
    status, sentence, hint = 422, str(error), ""
    match error:
        case Refusal():
            status, hint = error.status, error.hint
        case RlftsimError():
            pass
        case RequestValidationError():
            first = error.errors()[0]
            location = ".".join(str(step) for step in first["loc"] if step not in ("body", "query"))
            sentence = f"{location or 'body'}: {first['msg']}"
        case HTTPException():
            status, sentence = error.status_code, str(error.detail)
        case _:  # the server still raises it, so that the terminal has the traceback
            status, sentence = 500, f"{type(error).__name__}: {error}; the terminal shows more."
    return JSONResponse({"error": sentence, "hint": hint}, status)


LOOPBACK = "127.0.0.1"
PORT_ERRORS = (errno.EADDRINUSE, errno.EACCES)
ALL_INTERFACES = ("0.0.0.0", "::")


class _Server(uvicorn.Server):
    """A server whose streams and simulation end with the first Ctrl-C, before it waits for open connections."""

    def __init__(self, config: uvicorn.Config, worker: Worker) -> None:
        super().__init__(config)
        self._worker = worker

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Take a signal.

        Args:
            sig: Number of the signal; 2 is Ctrl-C.
            frame: Frame that the signal interrupted; not read.
        """
        self._worker.stop()
        # Requests that are cut off by the end are no errors.
        logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL)
        super().handle_exit(sig, frame)


class Studio:
    """A server on this machine, from `start` or `run` until `stop`.

    Args:
        session: Session with data, models and folder of exports.
        host: Address to listen on; "0.0.0.0" listens on all interfaces.
        port: Port to listen on; 0 takes a free port.
        token: Token of an earlier start, so that an open page goes on; None makes a new token.
        trusted_hosts: Further values of the Host header that are answered, such as a proxy's.
        frame_ancestors: Origins that may show the page in a frame, such as notebooks.

    Raises:
        ConfigError: The port is taken, forbidden or out of range.
    """

    def __init__(
        self,
        session: Session,
        *,
        host: str = LOOPBACK,
        port: int = 0,
        token: str | None = None,
        trusted_hosts: tuple[str, ...] = (),
        frame_ancestors: tuple[str, ...] = (),
    ) -> None:
        self._socket = _bind(host, port)
        self.port = int(self._socket.getsockname()[1])
        # Another interface is reached under the name that was given for it; in addresses IPv6 stands in brackets.
        self._name = LOOPBACK if host in ALL_INTERFACES else f"[{host}]" if ":" in host else host
        extra_hosts = () if self._name in LOCAL_NAMES else (f"{self._name}:{self.port}",)
        self.access = Access(self.port, token or new_token(), (*trusted_hosts, *extra_hosts), frame_ancestors)
        self._worker = Worker(session)
        app = create_app(session, self._worker, self.access)
        # Open streams must not hold up the end.
        config = uvicorn.Config(app, log_level="error", timeout_graceful_shutdown=1, timeout_keep_alive=60, ws="none")
        self._server = _Server(config, self._worker)
        self._thread: threading.Thread | None = None

    @property
    def url(self) -> str:
        """Address with the token, to be opened once."""
        return f"http://{self._name}:{self.port}/?token={self.access.token}"

    def run(self) -> None:
        """Serve until Ctrl-C."""
        try:
            self._server.run(sockets=[self._socket])
        finally:
            self._worker.close()

    def start(self) -> None:
        """Serve in a separate thread; returns when the server answers."""
        self._thread = threading.Thread(
            target=self._server.run, kwargs={"sockets": [self._socket]}, name="studio server", daemon=True
        )
        self._thread.start()
        while not self._server.started and self._thread.is_alive():
            time.sleep(0.01)

    def stop(self) -> None:
        """End the server and its worker, also while it simulates."""
        self._worker.close()
        self._server.should_exit = True
        if self._thread is not None:
            self._thread.join(timeout=2)

    def __enter__(self) -> "Studio":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


def load_token(path: Path) -> str:
    """Token of a file; a missing file is made, readable by the owner only.

    Raises:
        ConfigError: The file has no token, or is readable by further users.
    """
    if not path.exists():
        with errors_name(path):
            descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            with os.fdopen(descriptor, "w") as file:
                file.write(new_token())
    token = path.read_text(errors="replace").strip()
    if len(token) < len(new_token()) or not token.isascii() or path.stat().st_mode & 0o077:
        raise ConfigError(f"--token-file {path}: no token that only its owner can read: delete it, a new one is made.")
    return token


def announce(studio: Studio, *, as_json: bool, open_browser: bool) -> None:
    """Print the address on a line, and open the page.

    Args:
        studio: Studio that is about to serve; the port listens already.
        as_json: True prints a line of JSON with address and port.
        open_browser: True opens the page in the user's browser.
    """
    line = json.dumps({"url": studio.url, "port": studio.port}) if as_json else studio.url
    print(line, flush=True)
    if open_browser:
        # A browser of the terminal would take the terminal; a thread, as some browsers block.
        threading.Thread(target=webbrowser.open, args=(studio.url,), daemon=True).start()


def _bind(host: str, port: int) -> socket.socket:
    if not 0 <= port <= 65535:
        raise ConfigError(f"--port must lie between 0 and 65535, got {port}: 0 takes a free one.")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        # an address of all hosts takes those of IPv4, too
        return socket.create_server((host, port), family=family, backlog=128, dualstack_ipv6=host == "::")
    except OSError as error:
        # A taken or forbidden port; everything else is the host's fault, as a name that stands for no address.
        advice = "choose another --port, or 0 for a free one" if error.errno in PORT_ERRORS else "choose another --host"
        cause = (error.strerror or str(error)).partition(" (while ")[0]
        raise ConfigError(f"cannot listen on {host}:{port} ({cause}): {advice}.") from None
