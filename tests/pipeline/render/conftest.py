"""Pages opened in a browser, and music to play in them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray


@dataclass(frozen=True)
class Song:
    """Sound as the renderers take it."""

    samples: NDArray[np.float32]
    rate: int


@pytest.fixture(scope="session")
def song() -> Callable[..., Song]:
    """`song(seconds, rate, beat)`: a soft tone with a sharp click at each multiple of `beat` seconds."""

    def make(seconds: float, rate: int = 30_720, beat: float = 0.5) -> Song:
        t = np.arange(round(seconds * rate)) / rate
        since = t % beat
        # The click is band-limited, so that compression and resampling leave its place alone.
        click = 0.7 * np.sin(2 * np.pi * 1500 * since) * np.exp(-since * 400)
        return Song((0.05 * np.sin(2 * np.pi * 220 * t) + click).astype(np.float32), rate)

    return make


@pytest.fixture
def visit(browser: Any, until: Callable[..., None]) -> Iterator[Callable[..., Any]]:
    """Opens a file and fails the test if the page ever complains or asks for anything."""
    trouble: list[str] = []
    pages = []

    def go(path: Path, width: int = 900, height: int = 760, **options: Any) -> Any:
        page = browser.new_page(viewport={"width": width, "height": height}, **options)
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
