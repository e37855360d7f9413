"""Goal studio: a page on this machine that gives agents goals and shows the rollouts.

`serving.Studio` starts and stops a server; `server.create_app` has the routes, `guard.Guard` stands before all
routes, `session.Session` holds data and models, `runs.Worker` simulates in one thread. The page is in `static/`, plain
ES modules, which share `viewer/drawing.js` with the pages that stand alone. Needs the extra: `pip install
'rlftsim[studio]'`.
"""

from rlftsim.errors import ConfigError, RlftsimError


class Refusal(RlftsimError):
    """A request that is not carried out.

    Args:
        message: Sentence with the value, the cause and the way out.
        status: Status of the HTTP answer, 4xx.
        hint: Further advice, which the page shows below the message.
    """

    def __init__(self, message: str, *, status: int = 422, hint: str = "") -> None:
        super().__init__(message)
        self.status = status
        self.hint = hint


def check_extra() -> None:
    """Check that the server's libraries are installed.

    Raises:
        ConfigError: A library is missing; the message has the command that installs the extra.
    """
    try:
        import fastapi  # noqa: F401
        import uvicorn  # noqa: F401
    except ModuleNotFoundError as error:
        raise ConfigError(f"the studio needs {error.name}: pip install 'rlftsim[studio]'.") from None
