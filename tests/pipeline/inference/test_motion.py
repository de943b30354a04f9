"""A motion and its files: facts, formats (one more is one function and one line), what a notebook shows."""

from __future__ import annotations

import html
import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.generation import Prompt
from motionloom.pipeline.inference.motion import GeneratedMotion
from motionloom.pipeline.inference.writers import WRITERS, default_formats
from motionloom.pipeline.serve.requests import MotionRequest
from motionloom.pipeline.stages.results.generate import GenerateConfig

NASTY = "a \"person\" </iframe><script>window.hacked=1</script> & 'waves'"


@pytest.fixture
def motion(walk: Callable[..., Any]) -> GeneratedMotion:
    layout = MotionLayout.named("wholebody363", fps=20.0)
    features = np.zeros((30, 313), np.float32)
    return GeneratedMotion(Prompt(NASTY), features, walk(30), None, layout, seed=9)


@pytest.mark.parametrize("ending", [".npz", ".bvh", ".glb", ".html", ".BVH"])
def test_saves_by_its_ending(motion: GeneratedMotion, tmp_path: Path, ending: str) -> None:
    path = motion.save(tmp_path / f"made{ending}")
    start = {"npz": b"PK", "bvh": b"HIER", "glb": b"glTF", "html": b"<!doctype html>"}
    assert path.read_bytes().startswith(start[ending.lower()[1:]])
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_endings_that_are_none(motion: GeneratedMotion, tmp_path: Path) -> None:
    with pytest.raises(
        UserError, match=r"cannot be saved with '\.fbx'; name a file that ends in \.npz, \.bvh"
    ):
        motion.save(tmp_path / "made.fbx")
    with pytest.raises(UserError, match="no ending"):
        motion.save(tmp_path / "made")
    for ending in (writer.suffix for writer in WRITERS.values()):
        with pytest.raises(UserError, match=r"there is no folder .*missing; make it first"):
            motion.save(tmp_path / "missing" / f"made{ending}")
    assert not list(tmp_path.iterdir())


def test_a_notebook_shows_it_apart(motion: GeneratedMotion) -> None:
    assert repr(motion) == f"GeneratedMotion({NASTY!r}, 1.5 s, 30 frames, 52 joints)"
    tags: list[tuple[str, dict[str, str | None]]] = []
    reader = HTMLParser()
    reader.handle_starttag = lambda tag, attrs: tags.append((tag, dict(attrs)))  # type: ignore[method-assign]
    reader.feed(motion._repr_html_())
    ((tag, attributes),) = tags  # one frame and nothing else, whatever the caption says
    assert tag == "iframe" and attributes["sandbox"] == "allow-scripts" and attributes["title"] == NASTY
    page = attributes["srcdoc"] or ""
    assert page.startswith("<!doctype html>") and "default-src 'none'" in page
    assert "<script>window.hacked" not in page
    assert not re.search(r"""(?:src|href)=["']?https?:""", page)
    assert html.unescape(page).count("motionloomViewer(") >= 1


@pytest.mark.browser
def test_it_plays_in_the_frame(motion: GeneratedMotion, browser: Any, until: Any, tmp_path: Path) -> None:
    path = tmp_path / "notebook.html"
    path.write_text(f"<!doctype html><body>{motion._repr_html_()}</body>", encoding="utf-8")
    page = browser.new_page(viewport={"width": 800, "height": 600})
    try:
        page.goto(path.as_uri())
        page.wait_for_timeout(300)
        frame = page.frames[1]
        until(frame, "window.__viewer && window.__viewer.draws > 1")
        assert frame.evaluate("__viewer.frames") == 30
        assert frame.locator("figcaption").text_content() == NASTY
        assert frame.evaluate("window.hacked") is None and page.evaluate("window.hacked") is None
        page.screenshot(path=str(tmp_path / "notebook.png"))
    finally:
        page.close()


def test_formats_are_names_of_the_table() -> None:
    assert default_formats() == ["npz", "html"]  # other files only where it is asked for
    with pytest.raises(UserError, match="formats"):
        GenerateConfig.parse({"formats": ["npz", "fbx"]}, "generate")
    with pytest.raises(ValidationError):
        MotionRequest(caption="a", format="fbx")
