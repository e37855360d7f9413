"""The gate before every route: host, token, origin, content type and size of a request.

A page that makes the user's browser speak to the port could run models and write files. So a request needs the name of
this machine as its host (a foreign name that resolves to 127.0.0.1 is "DNS rebinding"), the token of this start, and
where it changes something, the studio's own origin.
"""

import secrets
from dataclasses import dataclass, field
from urllib.parse import parse_qs

from starlette.datastructures import Headers
from starlette.requests import cookie_parser
from starlette.responses import JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

MAX_BODY_BYTES = 1 << 20
SAFE_METHODS = ("GET", "HEAD")
LOCAL_NAMES = ("127.0.0.1", "localhost", "[::1]")


def new_token() -> str:
    """256 random bits as text."""
    return secrets.token_urlsafe(32)


@dataclass(frozen=True)
class Access:
    """Names and secrets of a start of the studio."""

    port: int
    token: str = field(repr=False)
    trusted_hosts: tuple[str, ...] = ()
    """Further values of the Host header, such as a proxy's "hub.example"."""
    frame_ancestors: tuple[str, ...] = ()
    """Origins of notebooks that may show the page in a frame."""

    @property
    def hosts(self) -> frozenset[str]:
        """Host headers that are answered."""
        local = (f"{name}:{self.port}" for name in LOCAL_NAMES)
        return frozenset([*local, *(host.lower() for host in self.trusted_hosts)])

    @property
    def cookie(self) -> str:
        """Name of the cookie: cookies are shared by the ports of a host."""
        return f"rlftsim-studio-{self.port}"

    def is_token(self, offered: str) -> bool:
        """True for the token of this start; compared in constant time."""
        return secrets.compare_digest(offered.encode(), self.token.encode())

    @property
    def headers(self) -> list[tuple[bytes, bytes]]:
        """Headers of every answer."""
        frames = " ".join(("'self'", *self.frame_ancestors)) if self.frame_ancestors else "'none'"
        policy = (
            "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self'; "
            f"base-uri 'none'; form-action 'none'; frame-ancestors {frames}"
        )
        return [
            (b"content-security-policy", policy.encode()),
            (b"x-content-type-options", b"nosniff"),
            (b"cross-origin-resource-policy", b"same-origin"),
            (b"referrer-policy", b"no-referrer"),
        ]


class Guard:
    """ASGI middleware that lets a request through or answers it with 401, 403, 413 or 415.

    Args:
        app: Application behind the gate, which gets only requests that pass.
        access: Hosts, token and headers of this start of the studio.
    """

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self.app = app
        self.access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Check a request, then call the application."""
        send = self._with_headers(send)
        if scope["type"] == "lifespan":
            return await self.app(scope, receive, send)
        if scope["type"] != "http":  # no route is a WebSocket
            return await send({"type": "websocket.close", "code": 1008})
        headers = Headers(scope=scope)
        offered = parse_qs(scope["query_string"].decode("latin-1")).get("token", []) if scope["path"] == "/" else []
        refusal = self._find_refusal(scope, headers, offered)
        if refusal is not None:
            return await _build_refusal(*refusal)(scope, receive, send)
        if offered:
            # The address bar, the history and logs of proxies must not keep the token.
            cookie = f"{self.access.cookie}={self.access.token}; HttpOnly; SameSite=Strict; Path=/"
            answer = Response(status_code=303, headers={"location": "./", "set-cookie": cookie})
            return await answer(scope, receive, send)
        body = b""
        while scope["method"] not in SAFE_METHODS:
            message = await receive()
            body += message.get("body", b"")
            if len(body) > MAX_BODY_BYTES:
                refusal = 413, f"the request is larger than {MAX_BODY_BYTES} bytes: send less."
                return await _build_refusal(*refusal)(scope, receive, send)
            if not message.get("more_body"):
                break
        await self.app(scope, _replay(body, receive), send)

    def _find_refusal(self, scope: Scope, headers: Headers, offered: list[str]) -> tuple[int, str] | None:
        """Status and sentence for a request that is not let through."""
        hosts, is_change = headers.getlist("host"), scope["method"] not in SAFE_METHODS
        if len(hosts) != 1 or hosts[0].lower() not in self.access.hosts:
            return 403, "this host name is not the studio's: open the address that `rlftsim studio` printed."
        bearer = headers.get("authorization", "").partition("Bearer ")[2]
        # Not the standard library's parser: one odd cookie of another program on this host would hide all others.
        cookies = [cookie_parser(line).get(self.access.cookie, "") for line in headers.getlist("cookie")]
        if not any(self.access.is_token(word) for word in (bearer, *cookies, *offered)):
            return 401, "no token, or that of an earlier start: open the address that `rlftsim studio` printed."
        if is_change:
            # "null", or a scheme and a host; a script that knows the token has none.
            origin = headers.get("origin")
            is_same_origin = self.access.is_token(bearer) if origin is None else origin.partition("://")[2] == hosts[0]
            if not is_same_origin:
                return 403, "the request comes from another page: only the studio's own page may change something."
            if headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
                return 415, "the body must be application/json."
        return None

    def _with_headers(self, send: Send) -> Send:
        async def send_on(message: Message) -> None:
            if message["type"] == "http.response.start":
                present = [name for name, _ in message["headers"]]
                fresh = [] if b"cache-control" in present else [(b"cache-control", b"no-store")]
                message["headers"] = [*message["headers"], *self.access.headers, *fresh]
            await send(message)

        return send_on


def _build_refusal(status: int, sentence: str) -> Response:
    """Answer to a request that is not let through, in the form of all errors."""
    return JSONResponse({"error": sentence, "hint": ""}, status)


def _replay(body: bytes, receive: Receive) -> Receive:
    """Messages with the body that has been read already, then new messages, such as the end of the connection."""
    messages = [{"type": "http.request", "body": body, "more_body": False}]

    async def receive_message() -> Message:
        return messages.pop() if messages else await receive()

    return receive_message
