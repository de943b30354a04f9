"""Pages opened in a browser, and music to play in them."""

from __future__ import annotations

import base64
import io
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from motionloom.datasets.audio.sound import Sound


@pytest.fixture(scope="session")
def song() -> Callable[..., Sound]:
    """`song(seconds, rate, beat)`: a soft tone with a sharp click at each multiple of `beat` seconds."""

    def make(seconds: float, rate: int = 30_720, beat: float = 0.5) -> Sound:
        t = np.arange(round(seconds * rate)) / rate
        since = t % beat
        # The click is band-limited, so that compression and resampling leave its place alone.
        click = 0.7 * np.sin(2 * np.pi * 1500 * since) * np.exp(-since * 400)
        return Sound((0.05 * np.sin(2 * np.pi * 220 * t) + click).astype(np.float32), rate)

    return make


@pytest.fixture
def visit(browser: Any, until: Callable[..., None]) -> Iterator[Callable[..., Any]]:
    """Opens a file and fails the test if the page ever complains or asks for anything.

    Figures stand still until they are told to play, unless `plays`: pictures without a GPU are dear.
    """
    trouble: list[str] = []
    pages = []

    def go(path: Path, width: int = 900, height: int = 760, *, plays: bool = False, **options: Any) -> Any:
        motion = "no-preference" if plays else "reduce"
        page = browser.new_page(viewport={"width": width, "height": height}, reduced_motion=motion, **options)
        page.on("console", lambda m: trouble.append(m.text) if m.type in ("error", "warning") else None)
        page.on("pageerror", lambda e: trouble.append(str(e)))
        page.on(
            "request",
            lambda r: trouble.append(r.url) if not r.url.startswith(("file:", "data:", "blob:")) else None,
        )
        page.goto(path.as_uri())
        until(page, "window.__viewer && window.__viewer.draws > 0")
        pages.append(page)
        return page

    yield go
    for page in pages:
        page.close()
    assert not trouble


@pytest.fixture(scope="session")
def data_of() -> Callable[[Path], dict[str, Any]]:
    """`data_of(page)`: what a viewer's page carries."""

    def read(page: Path) -> dict[str, Any]:
        found = re.search(r'id="viewer-data">(.*?)</script>', page.read_text("utf-8"), re.S)
        assert found is not None
        data: dict[str, Any] = json.loads(found[1])
        return data

    return read


@pytest.fixture(scope="session")
def pixels() -> Callable[..., NDArray[np.int64]]:
    """`pixels(page)`: RGBA [H, W, 4] of a page's first canvas, drawn to date unless `paint` is false."""

    def read(page: Any, paint: bool = True) -> NDArray[np.int64]:
        address = page.evaluate(
            """(paint) => {
                if (paint && window.__viewer) __viewer.paint();
                return document.querySelector("canvas").toDataURL("image/png");
            }""",
            paint,
        )
        image = Image.open(io.BytesIO(base64.b64decode(address.split(",")[1]))).convert("RGBA")
        return np.asarray(image).astype(int)

    return read


@pytest.fixture(scope="session")
def webgl_arguments() -> list[str]:
    """How Chromium is started to have WebGL2 without a GPU."""
    return ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
