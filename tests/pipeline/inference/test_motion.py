"""A motion as an object: its facts, the files it saves itself as, and what a notebook shows."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.generation import Prompt
from motionloom.pipeline.inference.motion import WRITERS, GeneratedMotion

NASTY = "a \"person\" </iframe><script>window.hacked=1</script> & 'waves'"


@pytest.fixture
def motion(walk: Callable[..., Any]) -> GeneratedMotion:
    layout = MotionLayout.named("wholebody363", fps=20.0)
    features = np.zeros((30, 313), np.float32)
    return GeneratedMotion(Prompt(NASTY), features, walk(30), None, layout, seed=9)


def test_its_facts(motion: GeneratedMotion) -> None:
    assert (motion.fps, motion.seconds, motion.joints.shape) == (20.0, 1.5, (30, 52, 3))
    assert motion.joint_names[0] == "pelvis" and len(motion.joint_names) == 52


@pytest.mark.parametrize("ending", [".npz", ".bvh", ".glb", ".html", ".mp4", ".BVH"])
def test_saves_by_its_ending(motion: GeneratedMotion, tmp_path: Path, ending: str) -> None:
    path = motion.save(tmp_path / f"made{ending}")
    start = {
        ".npz": b"PK",
        ".bvh": b"HIERARCHY",
        ".glb": b"glTF",
        ".html": b"<!doctype html>",
        ".mp4": b"\0\0\0",
    }
    assert path.read_bytes().startswith(start[ending.lower()])
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_what_the_file_holds(motion: GeneratedMotion, tmp_path: Path) -> None:
    with np.load(motion.save(str(tmp_path / "made.npz")), allow_pickle=False) as file:
        np.testing.assert_allclose(file["joints"], motion.joints, atol=1e-3)  # of one rigid skeleton
        facts = json.loads(str(file["metadata"]))
    assert facts["seed"] == 9 and facts["caption"] == NASTY and facts["fps"] == 20.0


def test_endings_that_are_none(motion: GeneratedMotion, tmp_path: Path) -> None:
    with pytest.raises(
        UserError, match=r"cannot be saved with '\.fbx'; name a file that ends in \.npz, \.bvh"
    ):
        motion.save(tmp_path / "made.fbx")
    with pytest.raises(UserError, match="no ending"):
        motion.save(tmp_path / "made")
    for ending in WRITERS:
        with pytest.raises(UserError, match=r"there is no folder .*missing; make it first"):
            motion.save(tmp_path / "missing" / f"made{ending}")
    assert not list(tmp_path.iterdir())


class _Tags(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))


def test_a_notebook_shows_it_apart(motion: GeneratedMotion) -> None:
    reader = _Tags()
    reader.feed(motion._repr_html_())
    ((tag, attributes),) = reader.tags  # one frame and nothing else, whatever the caption says
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


def test_every_ending_is_documented() -> None:
    text = (Path(__file__).resolve().parents[3] / "docs" / "python.md").read_text(encoding="utf-8")
    assert re.findall(r"^\| `(\.\w+)` \|", text, re.M) == list(WRITERS)
