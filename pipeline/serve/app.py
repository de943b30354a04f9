"""The pages and the API of a server (docs/generating.md)."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from importlib import resources
from urllib.parse import quote

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import parse_json
from motionloom.datasets.base.register import discover
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.render.viewer import resource, viewer_script
from motionloom.pipeline.serve.guard import Bodies, OwnPage, WholeBodies, allowed_hosts
from motionloom.pipeline.serve.part import SERVED, A
from motionloom.pipeline.serve.requests import Answer, MotionRequest, Motions, ServeConfig, Sounds

_WEB = resources.files("motionloom.pipeline.serve") / "web"
_PARTS = "<!-- parts -->"
"""Where the page has the markup of its parts."""
_BROKEN = "something broke here; the server's log says what"

_UPLOADS = 4
"""Sounds and clips that are decoded at a time; a place is taken when all of one is here, so that slow senders
hold none."""


class Site:
    """A model and its answers, made one after another in a thread of its own, first come first served."""

    def __init__(self, model: MotionModel, config: ServeConfig, name: str) -> None:
        self.model = model
        self.config = config
        self.name = name
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="model")
        self._asked = 0
        self.sounds = Sounds(config)
        self.motions = Motions(model, config)
        self._bodies = Bodies(config.patience)
        self._uploads = asyncio.Semaphore(_UPLOADS)
        discover()
        self.parts = {part.name: part.open(self) for part in SERVED.values()}
        webs = [_WEB, *(part.web for part in SERVED.values())]
        files = {file.name: file.read_text(encoding="utf-8") for web in webs for file in web.iterdir()}
        styles = [text for name, text in files.items() if name.endswith(".css")]
        panels = [files[f"{name}.html"] for name in self.parts]
        self._page = files["page.html"].replace(_PARTS, "".join(panels))
        self._assets = {
            **{name: text for name, text in files.items() if name.endswith(".js")},
            "serve.css": resource("viewer/viewer.css") + "".join(styles),
            "viewer.js": viewer_script(),
        }

    def stop(self) -> None:
        """Drop all requests that wait; what runs is let finish."""
        self._thread.shutdown(wait=False, cancel_futures=True)

    @property
    def app(self) -> ASGIApp:
        """The ASGI application."""
        routes = [
            Route("/", self.page),
            Route("/assets/{name}", self.asset),
            Route("/api/info", self.info),
            Route("/api/generate", self.generate, methods=["POST"]),
            Route("/api/sounds", self.add_sound, methods=["POST"]),
        ]
        posts = {path: do for part in self.parts.values() for path, do in part.posts.items()}
        routes += [Route(path, do, methods=["POST"]) for path, do in posts.items()]
        hosts = allowed_hosts(self.config)
        return Starlette(
            routes=routes,
            middleware=[
                Middleware(WholeBodies, patience=self.config.patience),
                Middleware(TrustedHostMiddleware, allowed_hosts=hosts, www_redirect=False),
                Middleware(OwnPage),
            ],
            exception_handlers={**dict.fromkeys(_REFUSALS, refused), Exception: broken},
        )

    async def page(self, http: Request) -> Response:
        return Response(self._page, media_type="text/html; charset=utf-8")

    async def asset(self, http: Request) -> Response:
        """A script or the style, from memory."""
        name = http.path_params["name"]
        if name not in self._assets:
            raise HTTPException(404)
        kind = "text/css" if name.endswith(".css") else "text/javascript"
        return Response(self._assets[name], media_type=f"{kind}; charset=utf-8")

    async def info(self, http: Request) -> Response:
        bundle = self.model.bundle
        limits = self.config
        longest = min(limits.max_seconds, self.model.max_seconds)
        skeleton = bundle.layout.skeleton
        return JSONResponse(
            {
                "model": self.name,
                "modalities": sorted(self.model.modalities),
                "face": bool(bundle.faces),
                "examples": self.model.examples(),
                "credits": bundle.terms.credits,
                "fps": self.model.fps,
                "joint_names": list(skeleton.joints),
                "parents": [int(parent) for parent in skeleton.parents],
                "parts": list(self.parts),
                **{name: part.facts for name, part in self.parts.items()},
                "sampling": bundle.recommended.model_dump(mode="json", exclude_unset=True),
                "limits": {
                    "seconds": longest,
                    "caption": limits.max_caption,
                    "sound_bytes": _bytes(limits.max_sound_mb),
                    "clip_bytes": _bytes(limits.max_clip_mb),
                },
            }
        )

    async def generate(self, http: Request) -> Response:
        request = await self.read(http, MotionRequest)
        sound = None if request.sound is None else self.sounds.kept.get(request.sound)
        return await self.respond(lambda: self.motions.generate(request, sound))

    async def respond(self, make: Callable[[], Answer]) -> Response:
        """Return the answer of the model's thread; 429 where too many wait, besides the one that runs."""
        if self._asked > self.config.waiting:
            words = f"{self.config.waiting} requests are waiting already; try again in a moment"
            raise HTTPException(429, words, {"retry-after": "2"})
        self._asked += 1
        try:
            answer = await asyncio.get_running_loop().run_in_executor(self._thread, make)
        finally:
            self._asked -= 1
        headers = dict[str, str]()
        if answer.file:
            headers["content-disposition"] = f"attachment; filename*=UTF-8''{quote(answer.file)}"
        return Response(answer.body, media_type=answer.kind, headers=headers)

    async def add_sound(self, http: Request) -> Response:
        """Keep the sound file that the body is, under a name for later requests."""
        if "audio" not in self.model.modalities:
            raise HTTPException(400, "this model knows no music; give it captions")
        # Decoded in another thread, so that the server answers meanwhile.
        async with self.upload(http, "the sound", self.config.max_sound_mb) as data:
            name, sound = await asyncio.to_thread(self.sounds.add, data)
        return JSONResponse({"sound": name, "seconds": round(sound.seconds, 3)})

    @asynccontextmanager
    async def upload(self, http: Request, what: str, megabytes: float) -> AsyncIterator[bytes]:
        async with self._bodies.read(http, what, _bytes(megabytes)) as data, self._uploads:
            yield data

    async def read(self, http: Request, kind: type[A]) -> A:
        media = http.headers.get("content-type", "").split(";")[0].strip().lower()
        if media != "application/json":
            raise HTTPException(415, "send JSON with Content-Type: application/json")
        most = round(self.config.max_request_kb * 1024)
        async with self._bodies.read(http, "the request", most) as data:
            fields = parse_json(data, "the request")
        if not isinstance(fields, dict):
            raise HTTPException(400, 'the request is not a JSON object like {"caption": "a person waves"}')
        request = kind.parse(fields, "request")
        request.require_within(self.config, self.model)
        return request


_REFUSALS = (HTTPException, UserError, ClientDisconnect)


async def refused(http: Request, error: Exception) -> Response:
    """Return a refusal as JSON of one sentence."""
    status = 400
    words = str(error)
    headers = dict[str, str]()
    if isinstance(error, HTTPException):
        status = error.status_code
        headers = dict(error.headers or {})
        words = {404: "no such page", 405: "no such method here"}.get(status, error.detail)
    return JSONResponse({"error": words}, status, headers)


async def broken(http: Request, error: Exception) -> Response:
    """Return 500 for an error of ours, which Starlette logs."""
    return JSONResponse({"error": _BROKEN}, 500)


def _bytes(megabytes: float) -> int:
    return round(megabytes * 2**20)
