"""Who may ask a server, and what its pages share: bodies within limits, refusals of one sentence."""

from __future__ import annotations

import asyncio
import ipaddress
from collections.abc import Collection, Sequence
from importlib import resources
from urllib.parse import urlsplit

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from motionloom.pipeline.render.viewer import resource, viewer_script

BROKEN = "something broke here; the server's log says what"


def own(name: str) -> str:
    """Text of a file of the folder `web`."""
    return (resources.files("motionloom.pipeline.serve") / "web" / name).read_text(encoding="utf-8")


def guarded(
    page: str, scripts: Sequence[str], routes: Sequence[Route], host: str, allowed: Collection[str]
) -> ASGIApp:
    """The application of a page, its scripts, the viewer and what they ask for. The guard is outermost, so
    that every answer has its headers.
    """
    assets = {
        "serve.css": (resource("viewer/viewer.css") + own("serve.css"), "text/css; charset=utf-8"),
        "viewer.js": (viewer_script(), "text/javascript; charset=utf-8"),
        **{script: (own(script), "text/javascript; charset=utf-8") for script in scripts},
    }

    async def index(request: Request) -> Response:
        return Response(own(page), media_type="text/html; charset=utf-8")

    async def asset(request: Request) -> Response:
        """Script and style, from memory."""
        found = assets.get(request.path_params["name"])
        if found is None:
            raise HTTPException(404)
        return Response(found[0], media_type=found[1])

    app = Starlette(
        routes=[Route("/", index), Route("/assets/{name}", asset), *routes],
        exception_handlers={HTTPException: refused, Exception: broken},
    )
    return Guard(app, host, allowed)


async def read_body(request: Request, what: str, most: int, patience: float) -> bytes:
    """The body, refused as soon as it is too large or too slow."""
    data = bytearray()

    async def read() -> None:
        async for piece in request.stream():
            data.extend(piece)
            if len(data) > most:
                raise HTTPException(
                    413,
                    f"{what} is larger than this server takes: at most {most} bytes",
                    {"connection": "close"},
                )

    try:
        await asyncio.wait_for(read(), patience)
    except TimeoutError:
        raise HTTPException(
            408, f"not all of it came within {patience:g} s", {"connection": "close"}
        ) from None
    return bytes(data)


async def refused(request: Request, error: Exception) -> Response:
    """A refusal as JSON of one sentence, which names its request."""
    assert isinstance(error, HTTPException)
    words = {404: "no such page", 405: "no such method here"}.get(error.status_code, error.detail)
    said: dict[str, str] = {"error": words}
    headers = dict(error.headers or {})
    if "x-request" in headers:
        said["request"] = headers["x-request"]
    return JSONResponse(said, error.status_code, headers)


async def broken(request: Request, error: Exception) -> Response:
    """A bug: the log has it, by Starlette's own way, and the client a sentence."""
    return JSONResponse({"error": BROKEN}, 500)


LOOPBACK = ("localhost", "127.0.0.1", "::1")

POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data:; "
    "media-src blob:; form-action 'none'; base-uri 'none'; frame-ancestors 'none'"
)

HEADERS = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cache-control": "no-store",
}


class Guard:
    """Checks every request, and adds the headers of every answer (ASGI middleware).

    A page from elsewhere in the same browser must not reach the model. By its own name it is stopped by
    `Origin`; by a name of its own that it has made to point at this machine (DNS rebinding) it is stopped by
    `Host`, which then is that name: only localhost, the names in `allowed`, and where others may come in
    plain addresses pass. `host` is the address that is listened at.
    """

    def __init__(self, app: ASGIApp, host: str, allowed: Collection[str] = ()) -> None:
        self.app = app
        self.names = {*LOOPBACK, host.lower(), *(name.lower() for name in allowed)}
        self.addresses = not is_loopback(host)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                own = [(name.encode(), value.encode()) for name, value in HEADERS.items()]
                message["headers"] = [*message.get("headers", []), *own]
            await send(message)

        headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}
        refused = self.refusal(headers, scope["method"])
        if refused:
            await JSONResponse({"error": refused}, 403)(scope, receive, send_with_headers)
            return
        await self.app(scope, receive, send_with_headers)

    def refusal(self, headers: dict[str, str], method: str) -> str:
        """Why a request with these headers is refused; empty where it is not."""
        host = headers.get("host", "")
        if not self.knows(host):
            return f"this server is not called {host[:80]!r}; use localhost, or start it with --allow-host"
        origin = headers.get("origin")
        if origin is not None and origin not in (f"http://{host}", f"https://{host}"):
            return f"a page of {origin[:80]!r} asks; only this server's own page may"
        followed = method == "GET" and headers.get("sec-fetch-mode") == "navigate"  # a link to here
        if headers.get("sec-fetch-site", "none") not in ("none", "same-origin") and not followed:
            return "a page of another site asks; only this server's own page may"
        return ""

    def knows(self, host: str) -> bool:
        """Whether a `Host` header names this server."""
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        if name in self.names:
            return True
        return self.addresses and _is_address(name)


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches an address."""
    if host == "localhost":
        return True
    return _is_address(host) and ipaddress.ip_address(host).is_loopback


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
