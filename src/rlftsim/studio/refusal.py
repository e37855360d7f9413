"""Error of the studio's server: a sentence, a hint and a status."""

from rlftsim.errors import RlftsimError


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
