"""Access to the server: host names, origins, security headers, and bodies within limits.

A page of another site in the same browser must not reach the model. Under its own name it is refused by
`Origin` (`OwnPage`); under a name that it has made to point at this machine (DNS rebinding) by `Host`
(Starlette's `TrustedHostMiddleware`). The limit of connections is uvicorn's (`server.py`), their end is here
(`Connection`); whoever lets others in puts a proxy in front, which asks for a password.
"""

from __future__ import annotations

import asyncio
import ipaddress
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from typing import Any

import h11
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.serve.requests import ServeConfig

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
"""Sent with every answer, also those of uvicorn itself."""

MOST_HELD = 2**28
"""Bytes of all bodies that are held at a time: a dozen of the largest."""


def allowed_hosts(config: ServeConfig) -> list[str]:
    """Return the `Host` names that are answered: loopback, the address listened at, and `allow_hosts`."""
    if (wild := next((name for name in config.allow_hosts if "*" in name), None)) is not None:
        raise UserError(f"allow_hosts: {wild!r} has a wildcard; give each name whole")
    host = f"[{config.host}]" if ":" in config.host else config.host
    return ["localhost", "127.0.0.1", "[::1]", host, *config.allow_hosts]


def is_loopback(host: str) -> bool:
    """Return whether only this machine reaches an address."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class Connection(H11Protocol):
    """uvicorn's protocol, which closes a connection whose headers are not here `patience` seconds after it
    was made, or after the first byte of a further request; and one that goes on sending a body for so long
    after the request was answered. uvicorn itself waits for them without end.
    """

    def __init__(self, *, patience: float, **how: Any) -> None:
        super().__init__(**how)
        self._patience = patience
        self._end: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._watch()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._unwatch()

    def _watch(self) -> None:
        answered = self.conn.our_state is h11.DONE and self.conn.their_state is h11.SEND_BODY
        if self.conn.their_state is not h11.IDLE and not answered:
            self._unwatch()
        elif self._end is None:  # the time of what is awaited runs on, whatever comes of it
            self._end = self.loop.call_later(self._patience, self.transport.close)

    def _unwatch(self) -> None:
        if self._end is not None:
            self._end.cancel()
            self._end = None


class WholeBodies:
    """Read and drop what still comes of a body before its request is answered, for `patience` seconds: a
    client that has to close its connection while it sends sees a reset in place of the sentence (ASGI
    middleware)."""

    def __init__(self, app: ASGIApp, patience: float) -> None:
        self.app = app
        self.patience = patience

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        is_whole = False
        end = asyncio.get_running_loop().time() + self.patience

        async def reading() -> Message:
            nonlocal is_whole
            message = await receive()
            is_whole = not message.get("more_body")
            return message

        async def sending(message: Message) -> None:
            with suppress(TimeoutError):
                async with asyncio.timeout_at(end):
                    while not is_whole:
                        await reading()
            with suppress(h11.LocalProtocolError):  # what came was no HTTP: uvicorn has said so
                await send(message)

        await self.app(scope, reading, sending)


class OwnPage:
    """Answer 403 to requests that a page of another site makes (ASGI middleware)."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if (reason := self._refusal(Headers(scope=scope), scope["method"])) is not None:
            await JSONResponse({"error": reason}, 403)(scope, receive, send)
        else:
            await self.app(scope, receive, send)

    @staticmethod
    def _refusal(headers: Headers, method: str) -> str | None:
        host = headers.get("host", "")
        origin = headers.get("origin")
        if origin is not None and origin not in (f"http://{host}", f"https://{host}"):
            return f"a page of {origin[:80]!r} asks; only this server's own page may"
        # A link to the page may be followed from anywhere; browsers send no Origin with such a GET.
        followed = method == "GET" and headers.get("sec-fetch-mode") == "navigate"
        if headers.get("sec-fetch-site", "none") not in ("none", "same-origin") and not followed:
            return "a page of another site asks; only this server's own page may"
        return None


class Bodies:
    """Reads bodies within limits: of each of them, and of all that are held at a time."""

    def __init__(self, patience: float, most: int = MOST_HELD) -> None:
        self.patience = patience
        self.most = most
        self._held = 0

    @asynccontextmanager
    async def read(self, request: Request, what: str, most: int) -> AsyncIterator[bytes]:
        """Give the body, at most `most` bytes; 413 as soon as it is larger, 408 after `patience` seconds, 503
        where those of others, which wait or still come, take all memory that there is for bodies.
        """
        pieces = list[bytes]()
        size = 0

        async def read() -> None:
            nonlocal size
            async for piece in request.stream():
                pieces.append(piece)
                size = size + len(piece)
                self._held = self._held + len(piece)
                if size > most:
                    words = f"{what} is larger than this server takes: at most {most} bytes"
                    raise HTTPException(413, words)
                if self._held > self.most:
                    words = "too much is being uploaded already; try again in a moment"
                    raise HTTPException(503, words, {"retry-after": "5"})

        try:
            await asyncio.wait_for(read(), self.patience)
            yield b"".join(pieces)
        except TimeoutError:
            words = f"not all of it came within {self.patience:g} s"
            raise HTTPException(408, words, {"connection": "close"}) from None
        finally:
            self._held -= size
