"""The studio in a notebook: a server in a thread, and a frame below the cell."""

import importlib.util
import os
import sys
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlftsim.errors import ConfigError, in_short
from rlftsim.scenario.any_form import Name
from rlftsim.studio import check_extra

if TYPE_CHECKING:
    from rlftsim.studio.serving import Studio

FRAME_HEIGHT = 760
NOTEBOOK_ORIGINS = ("http://localhost:*", "http://127.0.0.1:*")
"""Origins that may show the page: notebooks on this machine."""


class StudioCell:
    """A running studio that a notebook shows in a frame.

    Args:
        studio: started.
    """

    def __init__(self, studio: "Studio") -> None:
        self.studio = studio

    @property
    def url(self) -> str:
        """Address with the token, for a tab of its own."""
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
        data: folder of a data set, or "synthetic".
        models: runs, model folders or registered names, one or several.
        rollouts: files or folders of rollouts, for panels of their own, one or several.
        split: shown first; None = validation, where there is one.
        out: folder of everything that the page saves.
        trusted_hosts: Host headers of a proxy, such as "hub.example"; its origin may show the page, too.

    Returns:
        A value that a notebook displays; `stop()` ends the server.

    Raises:
        RlftsimError: no such data set, split or model, a policy in place of a name, or the extra is not installed.
    """
    check_extra()
    # Not at the top: `import rlftsim` works without the extra.
    from rlftsim.studio.serving import Studio
    from rlftsim.studio.session import Session

    names, files = _several("models", models), _several("rollouts", rollouts)
    hosts = _several("trusted_hosts", trusted_hosts)
    session = Session(os.fspath(data), names, split, Path(out), rollouts=files)
    origins = (*NOTEBOOK_ORIGINS, *(f"https://{host}" for host in hosts))
    studio = Studio(session, trusted_hosts=hosts, frame_ancestors=origins)
    studio.start()
    return StudioCell(studio)


def _several(argument: str, names: object) -> tuple[str, ...]:
    """Names as text; a single one counts as a list of one.

    Raises:
        ConfigError: something else, such as a policy.
    """
    listed = [names] if isinstance(names, str | os.PathLike) else names
    if not isinstance(listed, Sequence) or not all(isinstance(one, str | os.PathLike) for one in listed):
        raise ConfigError(
            f"{argument} must be names or folders, got {in_short(names)}: write what is in memory to a folder first."
        )
    return tuple(os.fspath(one) for one in listed)
