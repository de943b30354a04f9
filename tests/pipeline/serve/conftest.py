"""A server in this process, with a model that is quick and says in its motions which request they are of."""

from __future__ import annotations

import http.client
import json
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.pipeline.contract.generation import Capabilities
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.inference.motion import GeneratedMotion
from motionloom.pipeline.inference.request import Request
from motionloom.pipeline.serve.app import Site
from motionloom.pipeline.serve.requests import ServeConfig
from motionloom.pipeline.serve.server import listen, server_of
from motionloom.pipeline.store.artifact import Terms
from motionloom.pipeline.store.known_captions import Unknown

LAYOUT = MotionLayout.named("wholebody363", fps=20.0)


class QuickGenerator:
    """Leaves a clip that it is to edit as it is, so that it differs by pins and path alone."""

    modalities, settings = frozenset({"text", "audio"}), frozenset({"cfg_scale"})
    prepared: ClassVar[dict[str, object]] = {}
    layout, part, method, unit_frames, max_frames = LAYOUT, "bodyhand", "quick", 1, None
    decides_length = True

    def generate(self, request: Any) -> list[Any]:
        raise NotImplementedError

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities(more={"edit": self.edit})

    def edit(self, frames: Any, words: Any, seeds: Any, sampling: Any) -> list[Any]:
        return [frames.features[:, LAYOUT.part("bodyhand")] for _ in seeds]


class QuickModel:
    """Answers at once, or when `open` is set; the root of a motion stands at x = seed / 1000."""

    modalities = frozenset({"text", "audio"})
    fps, max_seconds = LAYOUT.fps, 10.0

    def __init__(self, walk: Callable[..., Any]) -> None:
        self.walk = walk
        self.open = threading.Event()
        self.open.set()
        self.asked: list[str] = []
        self.sampling: list[SamplingConfig] = []
        self.edited: list[Any] = []
        generator = QuickGenerator()
        self.bundle = SimpleNamespace(
            layout=LAYOUT, faces={"gpt": None}, generator=generator, main="body",
            recommended=SamplingConfig(cfg_scale=1.25, top_p=0.9), stages=(),
            terms=Terms(credits=("Motion of nobody.",)),
            generator_of=lambda stage: SimpleNamespace(modalities=()), device="cpu", notes=lambda *_: [],
            choose_face=lambda name: None, drawing=lambda sampling: sampling,
        )  # fmt: skip

    def ability(self, name: str) -> Any:
        """As of a `MotionModel`."""
        return MotionModel.ability(self, name)  # type: ignore[arg-type]

    def threads(self, motions: int) -> Any:
        return nullcontext()

    def edit(self, clip: GeneratedMotion, task: Any, *, seed: int = 0) -> list[Any]:
        self.edited.append(task)
        assert self.open.wait(20)
        return MotionModel.edit(self, clip, task, seed=seed)  # type: ignore[arg-type]

    def examples(self) -> list[str]:
        return ["a person stretches"]

    def notes(self, request: Request, motions: Sequence[GeneratedMotion]) -> list[Any]:
        """All that is said of a violin, and remarks on sounds."""
        known = ("a person <b>claps</b>", "a person stretches")
        words = [text for prompt in request.prompts for text in (prompt.text, prompt.face_text)]
        unknown = [Unknown(text, known) for text in words if "violin" in text]
        return [*unknown, *(prompt.remark for prompt in request.prompts if prompt.remark)]

    def make(self, request: Request) -> list[GeneratedMotion]:
        [prompt], [seconds] = request.prompts, request.lengths
        self.asked.append(prompt.text)
        self.sampling.append(request.sampling)
        if prompt.text == "break":
            raise ZeroDivisionError
        assert self.open.wait(20)
        joints = self.walk(round((seconds or 2.0) * LAYOUT.fps))
        joints[..., 0] += request.seed / 1000 - joints[:1, :1, 0]
        features = np.zeros((len(joints), 313), np.float32)
        return [GeneratedMotion(prompt, features, joints, None, LAYOUT, seed=request.seed)]


@dataclass(frozen=True)
class Reply:
    """An answer."""

    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)


@dataclass(frozen=True)
class Served:
    """A server that runs."""

    port: int
    server: Any
    thread: threading.Thread
    site: Site

    def ask(self, method: str, path: str, body: bytes = b"", headers: dict[str, str] | None = None) -> Reply:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=200)
        try:
            connection.request(method, path, body or None, headers or {})
            got = connection.getresponse()
            return Reply(got.status, {k.lower(): v for k, v in got.getheaders()}, got.read())
        finally:
            connection.close()

    def post(self, path: str, data: Any, **headers: str) -> Reply:
        kind = {"Content-Type": "application/json", **headers}
        return self.ask("POST", path, json.dumps(data).encode(), kind)

    def wait_for(self, what: Callable[[], bool], seconds: float = 20.0) -> None:
        end = time.monotonic() + seconds
        while not what():
            assert time.monotonic() < end
            time.sleep(0.01)


@contextmanager
def _run_server(model: Any, **settings: Any) -> Iterator[Served]:
    config = ServeConfig(port=0, **settings)
    place, site = listen(config), Site(model, config, "quick")
    server = server_of(site)
    thread = threading.Thread(target=server.run, args=([place],), daemon=True)
    thread.start()
    made = Served(place.getsockname()[1], server, thread, site)
    made.wait_for(lambda: server.started)
    try:
        yield made
    finally:
        site.stop()
        server.should_exit = True
        thread.join(20)
        place.close()
    assert not thread.is_alive()


@pytest.fixture(scope="session")
def run_server() -> Callable[..., Any]:
    """`with run_server(model, waiting=4) as served`."""
    return _run_server


@pytest.fixture
def quick(walk: Callable[..., Any]) -> QuickModel:
    """The model."""
    return QuickModel(walk)


@pytest.fixture
def visit(browser: Any, until: Callable[..., None], run_server: Any, quick: Any) -> Iterator[Any]:
    """Opens the page of a server with the quick model; fails if the page complains or asks elsewhere."""
    trouble: list[str] = []
    with run_server(quick, max_seconds=6.0) as served:
        own = f"http://127.0.0.1:{served.port}/"
        pages = []

        def go(width: int = 1200, height: int = 800) -> Any:
            page = browser.new_page(viewport={"width": width, "height": height}, accept_downloads=True)
            page.on("pageerror", lambda error: trouble.append(str(error)))
            page.on("console", lambda m: trouble.append(m.text) if "Content Security" in m.text else None)
            page.on("request", lambda r: r.url.startswith((own, "blob:", "data:")) or trouble.append(r.url))
            page.goto(own)
            until(page, "document.getElementById('status').textContent.startsWith('quick')")
            pages.append(page)
            return page

        yield go
        for page in pages:
            page.close()
    assert not trouble
