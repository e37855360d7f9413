"""Routes of the studio, behind `guard.Guard`."""

import asyncio
import hashlib
import json
from collections.abc import AsyncIterator
from functools import cache
from importlib import resources
from typing import Annotated, Any

from fastapi import FastAPI, Query, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response, StreamingResponse
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp

from rlftsim.errors import RlftsimError
from rlftsim.goals.goals_file import GoalEntry, parse_goals
from rlftsim.studio import Refusal
from rlftsim.studio.bodies import CheckBody, ExportBody, Metric, OpenGoalsBody, RunBody, SaveGoalsBody
from rlftsim.studio.exports import export, save_goals
from rlftsim.studio.guard import Access, Guard
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
