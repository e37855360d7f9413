"""The studio in a notebook: a server in a thread, and a frame below the cell."""

import importlib.util
import os
import sys
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlftsim.errors import ConfigError, in_short
from rlftsim.scenario.open import Name
from rlftsim.studio import check_extra

if TYPE_CHECKING:
    from rlftsim.studio.server import Studio

FRAME_HEIGHT = 760
NOTEBOOK_ORIGINS = ("http://localhost:*", "http://127.0.0.1:*")
"""Origins that may show the page: notebooks on this machine."""


class StudioCell:
    """A running studio that a notebook shows in a frame.

    Args:
        studio: Server that answers already; `stop()` ends it.
    """

    def __init__(self, studio: "Studio") -> None:
        self.studio = studio

    @property
    def url(self) -> str:
        """Address with the token, for a separate tab."""
        return self.studio.url

    def stop(self) -> None:
        """End the server."""
        self.studio.stop()

    def __repr__(self) -> str:
        return f"StudioCell({self.url!r}: .stop() ends it)"

    def _repr_html_(self) -> str:
        token, port = self.studio.access.token, self.studio.port
        if "google.colab" in sys.modules:
            # Colab forwards a port by its own frame, from an origin that only it knows.
            colab: Any = sys.modules["google.colab"]
            colab.output.serve_kernel_port_as_iframe(port, path=f"/?token={token}", height=FRAME_HEIGHT)
            return ""
        proxied = "JPY_SESSION_NAME" in os.environ and importlib.util.find_spec("jupyter_server_proxy") is not None
        # "localhost", as most notebooks are opened there: the cookie is kept only where both names are the same.
        address = f"/proxy/{port}/?token={token}" if proxied else f"http://localhost:{port}/?token={token}"
        frame = f'<iframe style="width:100%;height:{FRAME_HEIGHT}px;border:0" src="{escape(address)}"></iframe>'
        return f'{frame}<p><a href="{escape(address)}" target="_blank" rel="noopener">open in a tab</a></p>'


def open_studio(
    data: str | os.PathLike[str] = "synthetic",
    models: Name | Sequence[Name] = ("demo-goals",),
    *,
    rollouts: Name | Sequence[Name] = (),
    split: str | None = None,
    out: str | os.PathLike[str] = "studio",
    trusted_hosts: str | Sequence[str] = (),
) -> StudioCell:
    """Start the goal studio for a notebook cell.

    Args:
        data: Folder of a data set, or "synthetic" for the embedded data set.
        models: Run, model folder or registered name, or several of these.
        rollouts: File or folder of rollouts, or several; each gets a separate panel.
        split: Split that the page shows first; None = validation, if the data set has that split.
        out: Folder of all files that the page saves.
        trusted_hosts: Host headers of a proxy, such as "hub.example", whose origin may show the page, too.

    Returns:
        A value that a notebook displays; `stop()` ends the server.

    Raises:
        RlftsimError: No such data set, split or model, a policy in place of a name, or the extra is not installed.
    """
    check_extra()
    # Not at the top: `import rlftsim` works without the extra.
    from rlftsim.studio.server import Studio
    from rlftsim.studio.session import Session

    names, files = _to_names("models", models), _to_names("rollouts", rollouts)
    hosts = _to_names("trusted_hosts", trusted_hosts)
    session = Session(os.fspath(data), names, split, Path(out), rollouts=files)
    origins = (*NOTEBOOK_ORIGINS, *(f"https://{host}" for host in hosts))
    studio = Studio(session, trusted_hosts=hosts, frame_ancestors=origins)
    studio.start()
    return StudioCell(studio)


def _to_names(argument: str, names: object) -> tuple[str, ...]:
    """Names as text; a single name counts as a list.

    Raises:
        ConfigError: A value that is no name, such as a policy.
    """
    listed = [names] if isinstance(names, str | os.PathLike) else names
    if not isinstance(listed, Sequence) or not all(isinstance(name, str | os.PathLike) for name in listed):
        raise ConfigError(
            f"{argument} must be names or folders, got {in_short(names)}: write what is in memory to a folder first."
        )
    return tuple(os.fspath(name) for name in listed)
