"""The pages and the API of a server (docs/generating.md)."""

from __future__ import annotations

import asyncio
import ipaddress
import json
import sys
import traceback
import uuid
from collections.abc import AsyncIterator, Callable, Collection
from concurrent.futures import Future
from importlib import resources
from typing import TypeVar
from urllib.parse import quote, urlsplit

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.schema import UserError
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.render.viewer import resource, viewer_script
from motionloom.pipeline.serve.requests import (
    Answer,
    MotionRequest,
    ServeConfig,
    Sounds,
    lines,
    make,
    notes_of,
    stream,
)
from motionloom.pipeline.serve.work import Busy, Stopped, Worker

T = TypeVar("T")

_BROKEN = "something broke here; the server's log says what"

_UPLOADS = 4
"""Sounds that are received at a time; others wait unread."""

_LOOK = 0.25
"""Seconds after which a waiting request looks whether its client is still there."""


class Site:
    """A model, its worker and the answers."""

    def __init__(self, model: MotionModel, config: ServeConfig, worker: Worker, name: str) -> None:
        self.model, self.config, self.worker, self.name = model, config, worker, name
        self.sounds = Sounds(config)
        self._uploads = asyncio.Semaphore(_UPLOADS)
        self.assets = {
            "serve.css": (resource("viewer/viewer.css") + own("serve.css"), "text/css; charset=utf-8"),
            "viewer.js": (viewer_script(), "text/javascript; charset=utf-8"),
            "serve.js": (own("serve.js"), "text/javascript; charset=utf-8"),
        }

    @property
    def app(self) -> ASGIApp:
        """The ASGI application. The guard is outermost, so that every answer has its headers."""
        return Guard(self._routes(), self.config.host, self.config.allow_hosts)

    def _routes(self) -> Starlette:
        return Starlette(
            routes=[
                Route("/", self.page),
                Route("/assets/{name}", self.asset),
                Route("/api/info", self.info),
                Route("/api/generate", self.generate, methods=["POST"]),
                Route("/api/stream", self.stream, methods=["POST"]),
                Route("/api/sounds", self.add_sound, methods=["POST"]),
            ],
            exception_handlers={HTTPException: _said, Exception: _broken},
        )

    async def page(self, request: Request) -> Response:
        return Response(own("page.html"), media_type="text/html; charset=utf-8")

    async def asset(self, request: Request) -> Response:
        """Script and style, from memory."""
        found = self.assets.get(request.path_params["name"])
        if found is None:
            raise HTTPException(404)
        return Response(found[0], media_type=found[1])

    async def info(self, request: Request) -> Response:
        bundle, limits = self.model.bundle, self.config
        longest = min(limits.max_seconds, self.model.max_seconds)
        skeleton = bundle.layout.skeleton
        return JSONResponse(
            {
                "model": self.name,
                "modalities": sorted(self.model.modalities),
                "face": bool(bundle.faces),
                "examples": self.model.examples(),
                "fps": self.model.fps,
                "joint_names": list(skeleton.joints),
                "parents": [int(parent) for parent in skeleton.parents],
                "settings": sorted(bundle.generator.settings),
                "sampling": bundle.recommended.model_dump(mode="json", exclude_unset=True),
                "limits": {
                    "seconds": longest,
                    "caption": limits.max_caption,
                    "sound_bytes": _bytes(limits),
                    "sound_seconds": limits.max_sound_seconds,
                    "waiting": limits.waiting,
                },
                "waiting": self.worker.length,
            }
        )

    async def generate(self, request: Request) -> Response:
        asked, sound = await self._asked(request)
        future = self._submit(asked, lambda: make(self.model, asked, sound, self.config))
        answer: Answer = await self._outcome(request, future, asked)
        headers = {"x-request": asked.request}
        if answer.file:
            headers["content-disposition"] = f"attachment; filename*=UTF-8''{quote(answer.file)}"
        return Response(answer.body, media_type=answer.kind, headers=headers)

    async def stream(self, request: Request) -> Response:
        """One motion as JSON lines, while it is made."""
        asked, sound = await self._asked(request)
        loop, pieces = asyncio.get_running_loop(), asyncio.Queue[str | None]()
        gone = False

        def work() -> None:
            try:
                made = stream(self.model, asked, sound, self.config)
                for piece in lines(made, asked, self.name, notes_of(self.model, asked, sound)):
                    loop.call_soon_threadsafe(pieces.put_nowait, piece)
                    if gone or self.worker.stopped:
                        break
            except Exception as error:
                words = str(error) if isinstance(error, UserError) else _BROKEN
                if words is _BROKEN:
                    traceback.print_exception(error, file=sys.stderr)
                said = json.dumps({"error": words, "request": asked.request}) + "\n"
                loop.call_soon_threadsafe(pieces.put_nowait, said)
            finally:
                loop.call_soon_threadsafe(pieces.put_nowait, None)

        future = self._submit(asked, work)

        async def body() -> AsyncIterator[str]:
            nonlocal gone
            try:
                while not future.cancelled() and not (future.done() and pieces.empty()):
                    try:
                        piece = await asyncio.wait_for(pieces.get(), 1.0)
                    except TimeoutError:
                        continue
                    if piece is None:
                        return
                    yield piece
            finally:
                gone = True
                future.cancel()

        return StreamingResponse(
            body(), media_type="application/x-ndjson", headers={"x-request": asked.request}
        )

    async def add_sound(self, request: Request) -> Response:
        """Keep the sound file that the body is, under a name for later requests."""
        if "audio" not in self.model.modalities:
            raise HTTPException(400, "this model knows no music; give it captions")
        async with self._uploads:
            data = await _body(request, "the sound", _bytes(self.config), self.config.patience)
        try:
            name, sound = await asyncio.to_thread(self.sounds.add, data)
        except UserError as error:
            raise HTTPException(400, str(error)) from None
        return JSONResponse({"sound": name, "seconds": round(sound.seconds, 3)})

    async def _asked(self, request: Request) -> tuple[MotionRequest, Sound | None]:
        kind = request.headers.get("content-type", "").split(";")[0].strip().lower()
        if kind != "application/json":
            raise HTTPException(415, "send JSON with Content-Type: application/json")
        most = round(self.config.max_request_kb * 1024)
        data = await _body(request, "the request", most, self.config.patience)
        try:
            given = json.loads(data)
            json.dumps(given, ensure_ascii=False).encode()
        except UnicodeEncodeError:
            raise HTTPException(400, "the request holds half of a letter (a lone surrogate)") from None
        except (ValueError, RecursionError):
            raise HTTPException(400, "the request is not JSON") from None
        if not isinstance(given, dict):
            raise HTTPException(400, 'the request is not a JSON object like {"caption": "a person waves"}')
        try:
            asked = MotionRequest.parse(given, "request")
            asked.require_within(self.config, self.model)
            sound = None if asked.sound is None else self.sounds.get(asked.sound)
        except UserError as error:
            name = given.get("request")
            raise HTTPException(400, str(error), {"x-request": _plain(name)} if name else None) from None
        return asked.model_copy(update={"request": _plain(asked.request) or uuid.uuid4().hex}), sound

    def _submit(self, asked: MotionRequest, call: Callable[[], T]) -> Future[T]:
        named = {"x-request": asked.request}
        try:
            return self.worker.submit(call)
        except Busy:
            said = f"{self.config.waiting} requests are waiting already; try again in a moment"
            raise HTTPException(429, said, {"retry-after": "2", **named}) from None
        except Stopped:
            raise HTTPException(503, "the server is stopping", named) from None

    async def _outcome(self, request: Request, future: Future[T], asked: MotionRequest) -> T:
        """The result; the call is dropped where its client goes away before it is begun."""
        result, named = asyncio.wrap_future(future), {"x-request": asked.request}
        try:
            while not (await asyncio.wait({result}, timeout=_LOOK))[0]:
                if await request.is_disconnected():
                    result.cancel()
                    raise HTTPException(400, "the client has gone away", named)
            return result.result()
        except UserError as error:
            raise HTTPException(400, str(error), named) from None
        except Stopped:
            raise HTTPException(503, "the server is stopping", named) from None


def own(name: str) -> str:
    """Text of a file that ships beside this module."""
    return (resources.files("motionloom.pipeline.serve") / name).read_text(encoding="utf-8")


def _plain(name: object) -> str:
    """A request's name as a header can carry it."""
    return "".join(letter for letter in str(name)[:64] if letter.isascii() and letter.isprintable()).strip()


def _bytes(config: ServeConfig) -> int:
    return round(config.max_sound_mb * 2**20)


async def _body(request: Request, what: str, most: int, patience: float) -> bytes:
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


async def _said(request: Request, error: Exception) -> Response:
    """A refusal as JSON of one sentence, which names its request."""
    assert isinstance(error, HTTPException)
    words = {404: "no such page", 405: "no such method here"}.get(error.status_code, error.detail)
    said: dict[str, str] = {"error": words}
    headers = dict(error.headers or {})
    if "x-request" in headers:
        said["request"] = headers["x-request"]
    return JSONResponse(said, error.status_code, headers)


async def _broken(request: Request, error: Exception) -> Response:
    """A bug: the log has it, by Starlette's own way, and the client a sentence."""
    return JSONResponse({"error": _BROKEN}, 500)


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
