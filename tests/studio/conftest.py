"""A studio of the package's own scenarios: the shipped model, and one with fresh weights for goals."""

import asyncio
import time
from concurrent.futures import ThreadPoolExecutor

import httpx
import pytest
import torch

from rlftsim.policies.shipped import demo_base

pytest.importorskip("fastapi", reason="the extra `studio` is not installed")
pytest.importorskip("uvicorn", reason="the extra `studio` is not installed")

from rlftsim.studio.guard import Access
from rlftsim.studio.runs import Worker
from rlftsim.studio.server import create_app
from rlftsim.studio.session import Session

PORT = 4711
HOST = f"127.0.0.1:{PORT}"


@pytest.fixture(scope="session")
def goal_model(tmp_path_factory):
    """Folder of a goal-conditioned model whose goals have an effect, though not a learned one."""
    folder = tmp_path_factory.mktemp("models") / "goals" / "model"
    policy = demo_base().with_goal_conditioning("indication", logit_bias=True)
    torch.manual_seed(1)
    with torch.no_grad():
        for part in policy.goal_modules():
            for weight in part.parameters():
                weight.add_(0.3 * torch.randn_like(weight))
    policy.save_pretrained(folder)
    return folder


@pytest.fixture(scope="session")
def session(goal_model, tmp_path_factory):
    return Session("synthetic", ("demo-base", str(goal_model)), None, tmp_path_factory.mktemp("out"))


@pytest.fixture
def worker(session):
    working = Worker(session)
    yield working
    working.close()


@pytest.fixture
def access():
    return Access(PORT, "t" * 43)


class Client:
    """Requests to the ASGI app, as the page sends them."""

    def __init__(self, app, access):
        self.app, self.access = app, access
        self.headers = {
            "host": HOST, "origin": f"http://{HOST}", "cookie": f"{access.cookie}={access.token}",
            "content-type": "application/json",
        }  # fmt: skip

    def request(self, method, path, headers=None, **more):
        kept = {k: v for k, v in (self.headers | (headers or {})).items() if v is not None}

        async def send():
            transport = httpx.ASGITransport(self.app, raise_app_exceptions=False)
            async with httpx.AsyncClient(transport=transport, base_url=f"http://{HOST}") as client:
                return await client.request(method, path, headers=kept, **more)

        # In a thread: a browser that another test opened keeps an event loop in this one.
        with ThreadPoolExecutor(1) as pool:
            return pool.submit(asyncio.run, send()).result()

    def get(self, path, headers=None, **more):
        return self.request("GET", path, headers, **more)

    def post(self, path, body=None, headers=None):
        return self.request("POST", path, headers, json={} if body is None else body)

    def finished(self, **body):
        """Submit a run and wait for its end."""
        answer = self.post("/api/runs", body)
        assert answer.status_code == 200, answer.text
        name = answer.json()["run"]
        for _ in range(1200):
            state = self.get(f"/api/runs/{name}").json()
            if state["is_over"]:
                return state
            time.sleep(0.05)
        raise AssertionError("the run does not end")


@pytest.fixture
def client(session, worker, access):
    return Client(create_app(session, worker, access), access)
