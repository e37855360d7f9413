"""Goal studio: a page on this machine that asks agents for things and shows what happens.

`serving.Studio` starts a server and stops it; `server.create_app` has the routes, `guard.Guard` stands before all of
them, `session.Session` holds data and models, `runs.Worker` simulates in one thread. The page is in `static/`, plain
ES modules; they share `viewer/drawing.js` with the pages that stand alone. Needs the extra: `pip install
'rlftsim[studio]'`.
"""

from rlftsim.errors import ConfigError


def check_extra() -> None:
    """Check that the server's libraries are installed.

    Raises:
        ConfigError: one is missing; names the command that installs it.
    """
    try:
        import fastapi  # noqa: F401
        import uvicorn  # noqa: F401
    except ModuleNotFoundError as error:
        raise ConfigError(f"the studio needs {error.name}: pip install 'rlftsim[studio]'.") from None
