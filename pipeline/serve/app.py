"""The pages and the API of a server (docs/generating.md)."""

from __future__ import annotations

import asyncio
import json
import sys
import traceback
import uuid
from collections.abc import AsyncIterator, Callable
from concurrent.futures import Future
from importlib import resources
from typing import TypeVar
from urllib.parse import quote

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import JSONResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp

from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.schema import UserError
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.render.viewer import resource, viewer_script
from motionloom.pipeline.serve.editing import CLIP, ChangeRequest, Clips, change, received, why_not
from motionloom.pipeline.serve.guard import OwnPage, allowed_hosts, read_body
from motionloom.pipeline.serve.requests import Answer, MotionRequest, ServeConfig, Sounds, lines, make
from motionloom.pipeline.serve.work import Busy, Stopped, Worker

T = TypeVar("T")
Asked = TypeVar("Asked", MotionRequest, ChangeRequest)

_BROKEN = "something broke here; the server's log says what"

_SCRIPTS = ("serve.js", "edit.js", "lanes.js", "figure.js", "task.js")
"""Scripts of the page, besides the viewer's."""

_UPLOADS = 4
"""Sounds and clips that are received at a time; others wait unread."""

_LOOK = 0.25
"""Seconds after which a waiting request looks whether its client is still there."""


class Site:
    """A model, its worker and the answers."""

    def __init__(self, model: MotionModel, config: ServeConfig, worker: Worker, name: str) -> None:
        self.model, self.config, self.worker, self.name = model, config, worker, name
        self.sounds, self.clips = Sounds(config), Clips(model, config)
        self._uploads = asyncio.Semaphore(_UPLOADS)
        self._assets = {
            "serve.css": resource("viewer/viewer.css") + _web_file("serve.css"),
            "viewer.js": viewer_script(),
            **{script: _web_file(script) for script in _SCRIPTS},
        }

    @property
    def app(self) -> ASGIApp:
        """The ASGI application."""
        routes = [
            Route("/", self.page),
            Route("/assets/{name}", self.asset),
            Route("/api/info", self.info),
            Route("/api/generate", self.generate, methods=["POST"]),
            Route("/api/stream", self.stream, methods=["POST"]),
            Route("/api/sounds", self.add_sound, methods=["POST"]),
            Route("/api/clips", self.add_clip, methods=["POST"]),
            Route("/api/edit", self.edit, methods=["POST"]),
        ]
        hosts = allowed_hosts(self.config)
        return Starlette(
            routes=routes,
            middleware=[
                Middleware(TrustedHostMiddleware, allowed_hosts=hosts, www_redirect=False),
                Middleware(OwnPage),
            ],
            exception_handlers={HTTPException: refused, Exception: broken},
        )

    async def page(self, request: Request) -> Response:
        return Response(_web_file("page.html"), media_type="text/html; charset=utf-8")

    async def asset(self, request: Request) -> Response:
        """A script or the style, from memory."""
        name = request.path_params["name"]
        if name not in self._assets:
            raise HTTPException(404)
        kind = "text/css" if name.endswith(".css") else "text/javascript"
        return Response(self._assets[name], media_type=f"{kind}; charset=utf-8")

    async def info(self, request: Request) -> Response:
        bundle, limits = self.model.bundle, self.config
        longest = min(limits.max_seconds, self.model.max_seconds)
        skeleton, why = bundle.layout.skeleton, why_not(self.model)
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
                "edit": {"possible": why is None, "why": why or ""},
                "sampling": bundle.recommended.model_dump(mode="json", exclude_unset=True),
                "limits": {
                    "seconds": longest,
                    "caption": limits.max_caption,
                    "sound_bytes": _bytes(limits.max_sound_mb),
                    "clip_bytes": _bytes(limits.max_clip_mb),
                    "sound_seconds": limits.max_sound_seconds,
                    "waiting": limits.waiting,
                },
                "waiting": self.worker.length,
            }
        )

    async def generate(self, request: Request) -> Response:
        asked, sound = await self._asked(request, MotionRequest)
        return await self._made(request, asked, lambda: make(self.model, asked, sound, self.config))

    async def edit(self, request: Request) -> Response:
        """A clip of which a part is made anew."""
        asked, sound = await self._asked(request, ChangeRequest)
        return await self._made(request, asked, lambda: change(self.clips, asked, sound))

    async def _made(
        self, request: Request, asked: MotionRequest | ChangeRequest, call: Callable[[], Answer]
    ) -> Response:
        answer = await self._outcome(request, self._submit(asked, call), asked)
        headers = {"x-request": asked.request}
        if answer.file:
            headers["content-disposition"] = f"attachment; filename*=UTF-8''{quote(answer.file)}"
        return Response(answer.body, media_type=answer.kind, headers=headers)

    async def stream(self, request: Request) -> Response:
        """One motion as JSON lines, while it is made."""
        asked, sound = await self._asked(request, MotionRequest)
        loop, pieces = asyncio.get_running_loop(), asyncio.Queue[str | None]()
        gone = False

        def work() -> None:
            try:
                for piece in lines(self.model, self.name, asked, sound, self.config):
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
            most = _bytes(self.config.max_sound_mb)
            data = await read_body(request, "the sound", most, self.config.patience)
        try:
            name, sound = await asyncio.to_thread(self.sounds.add, data)
        except UserError as error:
            raise HTTPException(400, str(error)) from None
        return JSONResponse({"sound": name, "seconds": round(sound.seconds, 3)})

    async def add_clip(self, request: Request) -> Response:
        """Keep the motion file that the body is, under a name for later requests."""
        if (why := why_not(self.model)) is not None:
            raise HTTPException(400, why)
        async with self._uploads:
            data = await read_body(request, CLIP, _bytes(self.config.max_clip_mb), self.config.patience)
        try:
            return JSONResponse(await asyncio.to_thread(lambda: received(*self.clips.add(data))))
        except UserError as error:
            raise HTTPException(400, str(error)) from None

    async def _asked(self, request: Request, kind: type[Asked]) -> tuple[Asked, Sound | None]:
        media = request.headers.get("content-type", "").split(";")[0].strip().lower()
        if media != "application/json":
            raise HTTPException(415, "send JSON with Content-Type: application/json")
        most = round(self.config.max_request_kb * 1024)
        data = await read_body(request, "the request", most, self.config.patience)
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
            asked = kind.parse(given, "request")
            asked.require_within(self.config, self.model)
            sound = None if asked.sound is None else self.sounds.get(asked.sound)
            if isinstance(asked, ChangeRequest) and isinstance(asked.clip, str):
                self.clips.get(asked.clip)
        except UserError as error:
            name = given.get("request")
            raise HTTPException(400, str(error), {"x-request": _plain(name)} if name else None) from None
        return asked.model_copy(update={"request": _plain(asked.request) or uuid.uuid4().hex}), sound

    def _submit(self, asked: MotionRequest | ChangeRequest, call: Callable[[], T]) -> Future[T]:
        named = {"x-request": asked.request}
        try:
            return self.worker.submit(call)
        except Busy:
            said = f"{self.config.waiting} requests are waiting already; try again in a moment"
            raise HTTPException(429, said, {"retry-after": "2", **named}) from None
        except Stopped:
            raise HTTPException(503, "the server is stopping", named) from None

    async def _outcome(self, request: Request, future: Future[T], asked: MotionRequest | ChangeRequest) -> T:
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


async def refused(request: Request, error: Exception) -> Response:
    """Return a refusal as JSON of one sentence, which names its request."""
    assert isinstance(error, HTTPException)
    words = {404: "no such page", 405: "no such method here"}.get(error.status_code, error.detail)
    body, headers = {"error": words}, dict(error.headers or {})
    if "x-request" in headers:
        body["request"] = headers["x-request"]
    return JSONResponse(body, error.status_code, headers)


async def broken(request: Request, error: Exception) -> Response:
    """Return 500 for an error of ours, which Starlette logs."""
    return JSONResponse({"error": _BROKEN}, 500)


def _web_file(name: str) -> str:
    """Return the text of a file of the folder `web`."""
    return (resources.files("motionloom.pipeline.serve") / "web" / name).read_text(encoding="utf-8")


def _plain(name: object) -> str:
    """A request's name as a header can carry it."""
    return "".join(letter for letter in str(name)[:64] if letter.isascii() and letter.isprintable()).strip()


def _bytes(megabytes: float) -> int:
    return round(megabytes * 2**20)
