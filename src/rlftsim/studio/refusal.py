"""The one error of the studio's server: a sentence, a hint and a status."""

from rlftsim.errors import RlftsimError


class Refusal(RlftsimError):
    """A request that is not carried out.

    Args:
        message: the value, the cause and the way out.
        status: of the HTTP answer.
        hint: what to do, where the page has room for it.
    """

    def __init__(self, message: str, *, status: int = 422, hint: str = "") -> None:
        super().__init__(message)
        self.status = status
        self.hint = hint
