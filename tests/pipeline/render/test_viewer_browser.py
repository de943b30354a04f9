"""The viewer and the report page in a real headless Chromium."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.render.charts import Line
from motionloom.pipeline.render.page import Page
from motionloom.pipeline.render.viewer import ViewerMotion, write_viewer

PARENTS = Skeleton.named("smplx52").parents
NASTY = "</script><img src=x onerror='window.hacked=1'><b>bold</b> & \"q\""

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def single(tmp_path_factory: pytest.TempPathFactory, walk: Any, face_track: Any) -> Path:
    path = tmp_path_factory.mktemp("single") / "viewer.html"
    motion = ViewerMotion(walk(60), 20, PARENTS, "truth", "a person walks in a circle", "", face_track(60))
    write_viewer(path, [motion], "One motion")
    return path


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory, walk: Any) -> Path:
    path = tmp_path_factory.mktemp("rows") / "viewer.html"
    motions = []
    for group, options in (("walks", {}), (NASTY, {"wave": True, "turn": 0.0})):
        for label, frames in (("truth", 60), ("reconstruction", 60), ("generated", 30)):
            motions.append(
                ViewerMotion(walk(frames, **options), 20, PARENTS, label, f"{group} ({label})", group)
            )
    motions[3] = replace(motions[3], note=NASTY)
    write_viewer(path, motions, NASTY, NASTY)
    return path


def changed(a: np.ndarray, b: np.ndarray) -> float:
    """Share of pixels that differ clearly."""
    return float((np.abs(a - b).max(axis=-1) > 24).mean())


def figure_box(image: np.ndarray) -> tuple[int, int, int, int]:
    """Left, top, right, bottom of the saturated (limb-coloured) pixels."""
    rgb = image[..., :3]
    strong = (rgb.max(axis=-1) - rgb.min(axis=-1) > 90) & (image[..., 3] > 250)
    rows_used, columns_used = np.flatnonzero(strong.any(axis=1)), np.flatnonzero(strong.any(axis=0))
    return int(columns_used[0]), int(rows_used[0]), int(columns_used[-1]), int(rows_used[-1])


def still(page: Any, frame: int = 0) -> None:
    page.evaluate(f"() => {{ __viewer.play(false); __viewer.setFrame({frame}); }}")


def test_plays_by_itself_and_pauses(visit: Any, until: Any, single: Path) -> None:
    page = visit(single, plays=True)
    first = page.evaluate("__viewer.frame")
    until(page, f"Math.abs(__viewer.frame - {first}) >= 5")
    page.keyboard.press("Space")
    stopped = page.evaluate("[__viewer.frame, __viewer.playing]")
    page.wait_for_timeout(250)
    assert page.evaluate("[__viewer.frame, __viewer.playing]") == stopped and stopped[1] is False
    page.keyboard.press("Space")
    until(page, f"__viewer.frame !== {stopped[0]}")


def test_frames_differ_and_keys_step(visit: Any, single: Path, pixels: Any) -> None:
    page = visit(single)
    still(page, 10)
    before = pixels(page)
    np.testing.assert_array_equal(before, pixels(page))  # a still frame stays still
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowLeft")
    assert page.evaluate("__viewer.frame") == 11
    still(page, 20)
    assert changed(before, pixels(page)) > 0.01
    page.keyboard.press("End")
    assert page.evaluate("__viewer.frame") == 59
    page.keyboard.press("Home")
    assert page.evaluate("__viewer.frame") == 0


def test_drag_wheel_and_reset_change_the_view(visit: Any, single: Path, pixels: Any) -> None:
    page = visit(single)
    still(page, 10)
    before, camera = pixels(page), page.evaluate("__viewer.camera")
    box = page.locator("canvas").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 150, y + 30, steps=4)
    page.mouse.up()
    turned = page.evaluate("__viewer.camera")
    assert turned["yaw"] != camera["yaw"] and turned["pitch"] > camera["pitch"]
    after = pixels(page)
    assert changed(before, after) > 0.02
    page.mouse.wheel(0, -400)
    near = pixels(page)
    assert page.evaluate("__viewer.camera.zoom") > 1.3
    _, top, _, bottom = figure_box(after)
    _, near_top, _, near_bottom = figure_box(near)
    assert near_bottom - near_top > bottom - top
    page.keyboard.down("Shift")
    page.mouse.down()
    page.mouse.move(x, y, steps=3)
    page.mouse.up()
    page.keyboard.up("Shift")
    assert page.evaluate("__viewer.camera.panX") != 0
    page.mouse.dblclick(x, y)
    assert page.evaluate("__viewer.camera") == camera
    assert changed(before, pixels(page)) < 0.002


def test_scrub_bar_and_buttons(visit: Any, until: Any, single: Path, pixels: Any) -> None:
    page = visit(single)
    bar = page.get_by_label("Time")
    box = bar.bounding_box()
    page.mouse.click(box["x"] + box["width"] * 0.75, box["y"] + box["height"] / 2)
    assert 38 <= page.evaluate("__viewer.frame") <= 50
    assert page.evaluate("__viewer.playing") is False
    until(page, "document.querySelector('.mlv-count').textContent.startsWith(String(__viewer.frame + 1))")
    before = pixels(page)
    page.get_by_role("button", name="View: side (2)").or_(
        page.get_by_role("button", name="View: side (3)")
    ).click()
    assert changed(before, pixels(page)) > 0.02
    page.get_by_role("button", name="Close-up").click()
    close = pixels(page)
    skin = (np.abs(close[..., :3] - [237, 199, 163]).max(axis=-1) < 45).mean()
    assert skin > 0.01
    page.get_by_role("button", name="Camera follows").click()
    assert page.evaluate("__viewer.follow") is False


def test_rows_share_one_clock_and_short_ones_hold(visit: Any, until: Any, rows: Path) -> None:
    page = visit(rows, width=1280, height=1000)
    assert page.locator("canvas").count() == 6
    assert page.locator(".mlv-label").all_text_contents() == ["truth", "reconstruction", "generated"] * 2
    assert page.locator(".mlv-group h2").count() == 2
    still(page, 45)
    until(page, "document.querySelectorAll('.mlv-count')[0].textContent === '46 / 60'")
    counts = page.locator(".mlv-count").all_text_contents()
    assert counts[0] == counts[1] == "46 / 60" and counts[2] == "30 / 30 · ended"
    tops = [page.locator("canvas").nth(k).bounding_box()["y"] for k in range(6)]
    assert tops[0] == tops[1] == tops[2] < tops[3] == tops[4] == tops[5]


def test_untrusted_captions_stay_text(visit: Any, rows: Path) -> None:
    page = visit(rows, width=1280, height=1000)
    assert page.locator("h1").text_content() == NASTY
    assert page.title() == NASTY
    assert page.locator("figcaption").nth(3).text_content() == f"{NASTY} (truth)"
    assert page.locator("figure:has(.mlv-note) figcaption").all_text_contents() == [f"{NASTY} (truth)"]
    assert page.locator(".mlv-note").text_content() == NASTY
    assert page.locator("img, b").count() == 0
    assert page.evaluate("window.hacked") is None


def test_unknown_skeletons_and_single_poses_draw(visit: Any, tmp_path: Path, pixels: Any) -> None:
    chain = np.array([[[0, 1, 0], [0, 1.5, 0], [0, 1.8, 0], [0.5, 1, 0], [-0.5, 1, 0]]], float)
    write_viewer(tmp_path / "v.html", [ViewerMotion(chain, 30, [-1, 0, 1, 0, 0], "pose")], "still")
    page = visit(tmp_path / "v.html")
    page.keyboard.press("ArrowRight")
    assert page.evaluate("__viewer.frame") == 0
    left, top, right, bottom = figure_box(pixels(page))
    assert right - left > 50 and bottom >= top


def test_report_page_with_two_viewers_and_charts(visit: Any, until: Any, tmp_path: Path, walk: Any) -> None:
    motions = [
        ViewerMotion(walk(30), 20, PARENTS, label, "walks", "walks") for label in ("truth", "generated")
    ]
    page = Page("Report", "of a run").add_heading("Curves").add_text("text")
    page.add_plot([Line("train", range(100), np.linspace(2, 1, 100)), Line("val", [0, 99], [2, 1.2])], "Loss")
    page.add_histogram({"uses": np.arange(64) % 7}, (0, 64), "Codes", "code", "uses")
    page.add_heading("Motions").add_viewer(motions, "two").add_viewer(motions[:1])
    page.add_table(["a", "b"], [["x", 1.0]]).write(tmp_path / "page.html")
    sheet = visit(tmp_path / "page.html", width=1100, height=900, plays=True)
    assert sheet.evaluate("__viewers.length") == 2
    sheet.locator("svg.chart").first.hover()
    assert "train: 1.5" in sheet.locator("#tip").text_content()
    canvas = sheet.locator("canvas").first
    canvas.scroll_into_view_if_needed()
    zoom = "__viewers[0].camera.zoom"
    canvas.hover()
    sheet.mouse.wheel(0, -10)
    assert sheet.evaluate(zoom) == 1  # the wheel scrolls the page until the viewer is in use
    canvas.click()
    sheet.mouse.wheel(0, -300)
    until(sheet, f"{zoom} > 1")
    frames = sheet.evaluate("__viewers.map(v => v.playing)")
    sheet.keyboard.press("Space")
    assert sheet.evaluate("__viewers.map(v => v.playing)") == [not frames[0], frames[1]]
    sheet.get_by_role("button", name="Dark or light").first.click()
    assert sheet.evaluate("document.documentElement.dataset.theme") == "dark"
    assert sheet.evaluate("document.documentElement.scrollWidth") <= 1100
