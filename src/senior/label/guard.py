"""What may come in to the labelling page, and the headers of what goes out."""

from __future__ import annotations

import hmac
import ipaddress
from dataclasses import dataclass
from urllib.parse import urlsplit

from starlette.requests import Request
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

MOST_BYTES = 16_384
"""Of what a page sends."""
SEALED = {
    "X-Frame-Options": "DENY",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
"""Headers that keep other sites out of a page of ours."""
HEADERS = {
    **SEALED,
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; media-src 'self'; "
        "connect-src 'self'; manifest-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
}


@dataclass(frozen=True)
class Access:
    """Who is let in."""

    token: str
    """Empty: everybody."""
    cookie: str
    """Its name. Cookies are the same for all ports of a machine, so it holds the port."""
    hosts: frozenset[str]
    """Names that the page may be called by; besides, by any address if ``anywhere``."""
    anywhere: bool


class Guard:
    """Refuses what must not come in, before anything looks at it, and puts the headers on what goes out.

    A page of another site cannot post here: its ``Origin`` is another, and the cookie is not sent along.
    """

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self.app = app
        self.access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        request = Request(scope)
        begun = False

        async def send_guarded(message: Message) -> None:
            nonlocal begun
            if message["type"] == "http.response.start":
                begun = True
                given = [(name.lower().encode(), value.encode()) for name, value in HEADERS.items()]
                message["headers"] = [*message["headers"], *given]
                if not any(name == b"cache-control" for name, _ in message["headers"]):
                    message["headers"].append((b"cache-control", b"no-store"))
            await send(message)

        refusal = self._refusal(request)
        if refusal is None and request.method == "POST":
            body = await _body(receive)
            if body is None:
                refusal = 413, f"More than {MOST_BYTES} bytes cannot be taken."
            else:
                receive = _again(body, receive)
        if refusal is not None:
            code, sentence = refusal
            await JSONResponse({"detail": sentence}, code)(scope, receive, send_guarded)
            return
        try:
            await self.app(scope, receive, send_guarded)
        except Exception:
            if not begun:
                told = {"detail": "The server failed; nothing was saved. The run's label/server.log says why."}
                await JSONResponse(told, 500)(scope, receive, send_guarded)
            raise

    def _refusal(self, request: Request) -> tuple[int, str] | None:
        host = request.headers.get("host", "")
        if not self._is_ours(host):
            return 403, "This page is not served under that name; allow it with --allowed-host."
        origin = request.headers.get("origin")
        if origin is not None and _split(origin) != ("http", host) and _split(origin) != ("https", host):
            return 403, "Only the page itself may send this."
        path = request.scope["path"]  # the router's; that of request.url is made from what is sent as host, too
        if path == "/health":
            return None
        given = request.cookies.get(self.access.cookie, "")
        if request.method in ("GET", "HEAD") and path in ("/", "/overview"):
            given = request.query_params.get("token", given)
        if self.access.token and not hmac.compare_digest(given.encode(), self.access.token.encode()):
            return 401, "Open the address that senior printed: it holds the token."
        return None

    def _is_ours(self, host: str) -> bool:
        name = (_split(f"http://{host}", named=True) or ("", ""))[1].lower()
        if name in self.access.hosts:
            return True
        if not self.access.anywhere:
            return False
        try:  # an address cannot be another site's name for this machine
            ipaddress.ip_address(name)
        except ValueError:
            return False
        return True


def _split(url: str, named: bool = False) -> tuple[str, str] | None:
    """Scheme and host with port (``named``: without) of a URL; None if it is none."""
    try:
        parts = urlsplit(url)
        return parts.scheme, (parts.hostname or "") if named else parts.netloc
    except ValueError:
        return None


async def _body(receive: Receive) -> bytes | None:
    """All that is sent; None if it is too much."""
    body = b""
    while True:
        message = await receive()
        if message["type"] != "http.request":
            return b""
        body += message.get("body", b"")
        if len(body) > MOST_BYTES:
            return None
        if not message.get("more_body"):
            return body


def _again(body: bytes, receive: Receive) -> Receive:
    """Have a body received once more."""
    told = False

    async def again() -> Message:
        nonlocal told
        if told:
            return await receive()
        told = True
        return {"type": "http.request", "body": body, "more_body": False}

    return again
