"""Streams of events: their number, their idle end, and a server that dies while it simulates."""

import http.client
import json
import time
from contextlib import closing

import pytest

from rlftsim.studio import server
from rlftsim.studio.bodies import RunBody
from rlftsim.studio.runs import Run
from rlftsim.studio.server import Studio

BODY = RunBody("validation", "9d639de83d6f5239", ("demo-base",))


@pytest.fixture
def silent(session):
    """A studio with a run that never says anything."""
    with Studio(session) as studio:
        studio._worker.runs["silent"] = Run("silent", BODY, (), (), [])
        yield studio


def listen(studio, run="silent"):
    connection = http.client.HTTPConnection("127.0.0.1", studio.port, timeout=30)
    headers = {"Authorization": f"Bearer {studio.access.token}"}
    connection.request("GET", f"/api/runs/{run}/events", headers=headers)
    return connection, connection.getresponse()


def test_eight_pages_may_listen_and_a_ninth_when_one_has_gone(silent):
    silent._worker.runs["silent"].tell("progress", k=0)
    listening = []
    for _ in range(server.MAX_STREAMS):
        connection, answer = listen(silent)
        assert answer.status == 200
        assert answer.readline() == b"id: 0\n"  # it runs by now
        listening.append(connection)
    connection, answer = listen(silent)
    assert answer.status == 429
    assert "8 pages listen already" in json.loads(answer.read())["error"]
    connection.close()
    listening.pop().close()
    end = time.monotonic() + 20
    while (answer := listen(silent)[1]).status == 429:
        assert time.monotonic() < end
        time.sleep(0.05)
    assert answer.status == 200
    for connection in listening:
        connection.close()


def test_a_stream_without_events_ends_and_begins_anew_behind_the_last_one(silent, monkeypatch):
    assert server.IDLE_S == 60.0
    monkeypatch.setattr(server, "IDLE_S", 0.3)
    silent._worker.runs["silent"].tell("progress", k=0)
    connection, answer = listen(silent)
    with closing(connection):
        assert answer.read().count(b"event: ") == 1  # read() returns at the end of the stream
