"""The verb that opens the goal studio: studio."""

import sys
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from rlftsim.errors import ConfigError
from rlftsim.policies.registry import Device
from rlftsim.studio import check_extra

LOOPBACK = ("127.0.0.1", "localhost", "::1")


@dataclass(frozen=True)
class StudioVerb:
    """Open the goal studio in the browser: watch scenarios, ask agents for things, simulate, compare, explain, save.

    Serves a page on this machine until Ctrl-C. Without options it shows the synthetic scenarios with the model that
    ships with the package. Needs `pip install 'rlftsim[studio]'`.
    """

    data: str = "synthetic"
    """Folder of a data set, or "synthetic" for the scenarios that ship with the package."""
    model: tyro.conf.UseAppendAction[list[str]] = field(default_factory=list)
    """A run, a model folder, or a registered name; may be given many times. Left out: "demo-goals"."""
    rollouts: tyro.conf.UseAppendAction[list[str]] = field(default_factory=list)
    """A file or folder of rollouts, of any simulator, for a panel of its own; may be given many times."""
    split: str | None = None
    """Split that is shown first. Left out: validation, where there is one."""
    out: Path = Path("studio")
    """Folder of everything that the page saves."""
    port: int = 0
    """Port to listen on; 0 takes a free one."""
    no_browser: bool = False
    """Only print the address."""
    json: bool = False
    """Print the address as JSON."""
    token_file: Path | None = None
    """File of the token, for scripts; made where it is missing. With it and --port an open page survives a restart."""
    host: str = "127.0.0.1"
    """Address to listen on; any other one needs --allow-remote."""
    allow_remote: bool = False
    """Listen on another address: the token, and everything else, travels there unencrypted."""
    trust_host: tyro.conf.UseAppendAction[list[str]] = field(default_factory=list)
    """Further Host header that is answered, such as a proxy's "hub.example"."""
    device: Device = "auto"
    """auto: the GPU if torch has one."""

    def run(self) -> int:
        """Serve the page until Ctrl-C."""
        if self.host not in LOOPBACK and not self.allow_remote:
            raise ConfigError(
                f"--host {self.host} makes the studio reachable from other machines: add --allow-remote if that is "
                "meant, or use ssh -L."
            )
        check_extra()
        from rlftsim.studio.serving import Studio, announce, load_token
        from rlftsim.studio.session import Session

        if self.host not in LOOPBACK:
            print(f"rlftsim: listening on {self.host}, unencrypted: keep the address secret.", file=sys.stderr)
        session = Session(
            self.data, tuple(self.model) or ("demo-goals",), self.split, self.out, self.device, tuple(self.rollouts)
        )
        token = None if self.token_file is None else load_token(self.token_file)
        studio = Studio(session, host=self.host, port=self.port, token=token, trusted_hosts=tuple(self.trust_host))
        announce(studio, as_json=self.json, open_browser=not self.no_browser)
        studio.run()
        return 0
