"""`motionloom search` as a page: type words, or choose or drop a clip, and watch the nearest clips move."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp

from motionloom.datasets.schema import Config, UserError
from motionloom.pipeline.evaluation.search import Hit, Search, Vectors
from motionloom.pipeline.render.viewer import ViewerData, viewer_data
from motionloom.pipeline.results.data_page import watch
from motionloom.pipeline.serve.guard import guarded, read_body
from motionloom.pipeline.serve.requests import ServeConfig
from motionloom.pipeline.serve.server import listen, run_site
from motionloom.pipeline.serve.work import Worker

SHOWN, SECONDS = 12, 5.0
"""Clips of an answer, and how much of each is shown."""
_LARGEST = 2**24
"""Bytes of a clip that is dropped: 25 minutes of body joints at 20 frames a second."""


class SearchRequest(Config):
    """What is looked for: words, or clips like one of the set."""

    words: str = ""
    like: str = ""


class SearchSite:
    """A data set's embeddings and the answers."""

    def __init__(self, search: Search, config: ServeConfig, name: str) -> None:
        self.search, self.config, self.name = search, config, name
        self._one = threading.Lock()

    @property
    def app(self) -> ASGIApp:
        """The ASGI application, guarded as that of `serve`."""
        routes = [
            Route("/api/info", self.info),
            Route("/api/search", self.find, methods=["POST"]),
            Route("/api/like", self.find_like, methods=["POST"]),
        ]
        return guarded("search.html", ("search.js",), routes, self.config.host, self.config.allow_hosts)

    async def info(self, request: Request) -> Response:
        return JSONResponse({"name": self.name, "clips": len(self.search.places) - len(self.search.excluded)})

    async def find(self, request: Request) -> Response:
        """Clips by words, or like one of the set."""
        most = round(self.config.max_request_kb * 1024)
        raw = await read_body(request, "the request", most, self.config.patience)
        try:
            asked = SearchRequest.parse(json.loads(raw), "request")
        except (ValueError, RecursionError):
            raise HTTPException(400, "the request is not JSON") from None
        except UserError as error:
            raise HTTPException(400, str(error)) from None
        if len(asked.words) > self.config.max_caption:
            raise HTTPException(400, f"at most {self.config.max_caption} letters are read")
        search = self.search
        return await self._answer(
            lambda: search.clip(asked.like) if asked.like else search.words(asked.words), asked.like
        )

    async def find_like(self, request: Request) -> Response:
        """Clips like the motion file that the body is."""
        raw = await read_body(request, "the clip", _LARGEST, self.config.patience)
        return await self._answer(lambda: self.search.motion(*self.search.motion_file(raw, "the clip")))

    async def _answer(self, query: Callable[[], Vectors], without: str = "") -> Response:
        def work() -> dict[str, object]:
            with self._one:
                hits = self.search.best(query(), SHOWN, without)
                return {"found": [hit.id for hit in hits], "viewer": shown(self.search, hits)}

        try:
            return JSONResponse(await asyncio.to_thread(work))
        except UserError as error:
            raise HTTPException(400, str(error)) from None


def shown(search: Search, hits: list[Hit]) -> ViewerData:
    """The clips that were found, for the viewer."""
    motions = [(hit, watch(search.splits[hit.place.split], hit.place.clip, seconds=SECONDS)) for hit in hits]
    return viewer_data([replace(one, label=f"{hit.score:.2f} · {one.label}") for hit, one in motions])


def serve_search(root: Path, model: str, config: ServeConfig, *, device: str, console: Console) -> None:
    """Serve the page about the data set in `root`; returns after Ctrl-C."""
    with closing(listen(config)) as place:
        search = Search.open(root, model, device=device, progress=True)
        search.words("a person stands")  # loads what reads words, so that the first search does not wait
        site = SearchSite(search, config, root.resolve().name)
        run_site(site, place, Worker(config.waiting), site.name, console)
