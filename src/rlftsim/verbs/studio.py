"""`rlftsim studio`: the goal studio in the browser."""

import sys
from pathlib import Path

import tyro

from rlftsim.errors import ConfigError
from rlftsim.jobs.progress import print_line
from rlftsim.studio import check_extra
from rlftsim.verbs.arguments import Device

LOOPBACK = ("127.0.0.1", "localhost", "::1")


def studio(
    data: str = "synthetic",
    model: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    rollouts: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    split: str | None = None,
    out: Path = Path("studio"),
    port: int = 0,
    browser: bool = True,
    json: bool = False,
    token_file: Path | None = None,
    host: str = "127.0.0.1",
    allow_remote: bool = False,
    trust_host: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    device: Device = "auto",
) -> None:
    """Open the goal studio in the browser: watch scenarios, ask agents for things, simulate, compare, explain, save.

    Serves a page on this machine until Ctrl-C. Without options it shows the synthetic scenarios with the model that
    ships with the package. Needs `pip install 'rlftsim[studio]'`.

    Args:
        data: Folder of a data set, or "synthetic" for the scenarios that ship with the package.
        model: Run, model folder, or registered name; may be given many times. Left out: "demo-goals".
        rollouts: File or folder of rollouts, of any simulator, for a panel of its own; may be given many
            times.
        split: Split that is shown first. Left out: validation, where there is one.
        out: Folder of everything that the page saves.
        port: Port to listen on; 0 takes a free one.
        browser: Open the page in a browser; without, only the address is printed.
        json: Print the address as JSON.
        token_file: File of the token, for scripts; made where it is missing. With it and --port an open page
            survives a restart.
        host: Address to listen on; any other one needs --allow-remote.
        allow_remote: Listen on another address: the token, and everything else, travels there unencrypted.
        trust_host: Further Host header that is answered, such as a proxy's "hub.example".
        device: Device of the models; auto: the GPU if torch has one.
    """
    if host not in LOOPBACK and not allow_remote:
        raise ConfigError(
            f"--host {host} makes the studio reachable from other machines: add --allow-remote if that is "
            "meant, or use ssh -L."
        )
    check_extra()
    from rlftsim.studio.server import Studio, announce, load_token
    from rlftsim.studio.session import Session

    if host not in LOOPBACK:
        print_line(f"rlftsim: listening on {host}, unencrypted: keep the address secret.", file=sys.stderr)
    session = Session(data, model or ("demo-goals",), split, out, device, rollouts)
    token = None if token_file is None else load_token(token_file)
    server = Studio(session, host=host, port=port, token=token, trusted_hosts=trust_host)
    announce(server, as_json=json, open_browser=browser)
    server.run()
