"""The studio as a running server: a free port, a printed address, an end within two seconds."""

import errno
import json
import logging
import os
import socket
import threading
import time
import webbrowser
from pathlib import Path
from types import FrameType

import uvicorn

from rlftsim.errors import ConfigError
from rlftsim.jobs.files import errors_name
from rlftsim.studio.guard import LOCAL_NAMES, Access, new_token
from rlftsim.studio.runs import Worker
from rlftsim.studio.server import create_app
from rlftsim.studio.session import Session

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
