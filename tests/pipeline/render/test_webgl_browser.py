"""The WebGL2 view in a real headless Chromium, its pixels made on the processor; and what is behind it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from motionloom.datasets.motion.body.rigid import fit_rigid
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.render.body.mesh import posing_of
from motionloom.pipeline.render.camera import VIEWS, Camera
from motionloom.pipeline.render.scene import Actor, cover
from motionloom.pipeline.render.viewer import ViewerMotion, write_viewer

SMPLX = Skeleton.named("smplx52")
SIZE = {"width": 420, "height": 520}

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def browser_arguments(webgl_arguments: list[str]) -> list[str]:
    return webgl_arguments


@pytest.fixture(scope="module")
def joints(walk: Any) -> np.ndarray:
    """A walk whose bones change their length by a few percent, as generated ones do."""
    loose = walk(24, wave=True) + np.random.default_rng(0).normal(0, 0.004, (1, 52, 3))
    return np.asarray(loose)


@pytest.fixture(scope="module")
def page_file(tmp_path_factory: pytest.TempPathFactory, joints: np.ndarray, face_track: Any) -> Path:
    """One figure that follows loose joints."""
    path = tmp_path_factory.mktemp("webgl") / "viewer.html"
    motion = ViewerMotion(joints, 20, SMPLX.parents, "generated", "walks", "", face_track(len(joints)))
    write_viewer(path, [motion], "One figure")
    return path


def still(page: Any, frame: int, view: str = "3/4") -> None:
    page.evaluate(
        "([k, view]) => { __viewer.play(false); __viewer.setView(view); __viewer.setFrame(k); }",
        [frame, view],
    )


def limbs(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the picture is blue, but not the trail's violet, and where orange."""
    red, green, blue = (image[..., k] for k in range(3))
    return (blue - red > 60) & (green > red), red - blue > 70


def outline(page: Any, actor: Actor, frame: int, view: str) -> np.ndarray:
    """Which pixels of the page's canvas the film's drawing of the same frame covers [H, W]."""
    lens = page.evaluate("__viewer.lens(0)")
    camera = Camera(*VIEWS[view], lens["distance"], int(lens["width"]), int(lens["height"]))
    target = np.array(lens["eye"]) - lens["distance"] * np.array(lens["back"])
    seen, size = camera.project(actor.at(frame, "near")[0], target), (camera.width, camera.height)
    found = cover(seen[:, :2], 0.1 / seen[:, 2], actor.body("near").triangles, size)
    out = np.zeros(camera.width * camera.height, dtype=bool)
    out[found.pixels] = True
    return out.reshape(camera.height, camera.width)


def test_the_body_is_drawn_and_is_that_of_the_film(
    visit: Any, page_file: Path, joints: np.ndarray, face_track: Any, pixels: Any
) -> None:
    page = visit(page_file, **SIZE)
    assert page.evaluate("__viewer.view") == "webgl"
    actor = Actor.of(joints, SMPLX, None, face_track(len(joints)))
    before = None
    for frame, view in ((0, "front"), (15, "3/4")):
        still(page, frame, view)
        image = pixels(page)
        blue, orange = limbs(image)
        assert blue.sum() > 400 and orange.sum() > 400
        if view == "front":  # the figure looks at us: its left is on our right
            assert np.nonzero(blue)[1].mean() > np.nonzero(orange)[1].mean() + 10
        expected = outline(page, actor, frame, view)
        around = binary_dilation(expected)  # its edges are soft
        assert (around & (blue | orange)).sum() > 0.98 * (blue | orange).sum()
        # Skin and trunk are drawn too: where the film has the figure, the page has no bright ground.
        dark = image[..., :3].min(axis=-1) < 200
        assert dark[expected].mean() > 0.95
        if before is not None:
            assert (np.abs(image - before).max(axis=-1) > 24).mean() > 0.02
        before = image
    np.testing.assert_array_equal(image, pixels(page))  # a still frame stays still


def test_the_face_moves_by_its_track(
    visit: Any, joints: np.ndarray, face_track: Any, tmp_path: Path, pixels: Any
) -> None:
    still_pose = np.repeat(joints[:1], len(joints), axis=0)
    motion = ViewerMotion(still_pose, 20, SMPLX.parents, face_controls=face_track(len(joints)))
    write_viewer(tmp_path / "face.html", [motion], "A face")
    page = visit(tmp_path / "face.html", **SIZE)
    still(page, 3, "front")
    page.evaluate("__viewer.toggle('close')")
    one = pixels(page)
    page.evaluate("__viewer.setFrame(9)")
    assert (np.abs(one - pixels(page)).max(axis=-1) > 24).mean() > 0.002


def test_bones_are_those_of_numpy(visit: Any, page_file: Path, joints: np.ndarray, tmp_path: Path) -> None:
    figure = fit_rigid(joints, SMPLX)
    small = joints[:, :22]
    write_viewer(tmp_path / "two.html", [
        ViewerMotion(figure.joints, 20, SMPLX.parents, figure=figure),
        ViewerMotion(small, 20, Skeleton.named("smpl22").parents),
    ], "two")  # fmt: skip
    one, two = visit(page_file, **SIZE), visit(tmp_path / "two.html", **SIZE)
    cases = [
        (one, 0, posing_of(joints, SMPLX)),
        (two, 0, posing_of(figure.joints, SMPLX, figure)),
        (two, 1, posing_of(small, Skeleton.named("smpl22"))),
    ]
    for page, cell, posing in cases:
        still(page, 11)
        rows = np.array(page.evaluate(f"__viewer.bones({cell})")).reshape(52, 3, 4)
        count = len(posing.skeleton)
        # A quarter of a degree is what 32 bits a rotation leave.
        np.testing.assert_allclose(rows[:count, :, :3], posing.bones()[11], atol=8e-3)
        placed = (
            np.einsum("nij,nj->ni", rows[:count, :, :3], posing.skeleton.rest_joints) + rows[:count, :, 3]
        )
        np.testing.assert_allclose(placed, posing.joints[11], atol=1e-4)
        if count == 22:  # fingers that the skeleton lacks go with their wrist
            np.testing.assert_array_equal(rows[22:37], np.tile(rows[20], (15, 1, 1)))


def test_a_context_that_goes_leaves_sticks_and_comes_back(
    visit: Any, until: Callable[..., None], page_file: Path, pixels: Any
) -> None:
    page = visit(page_file, **SIZE)
    still(page, 5)
    skinned = pixels(page)
    page.evaluate("window.back = __viewer.stage.gl.getExtension('WEBGL_lose_context'); back.loseContext()")
    until(page, "__viewer.view === '2d'")
    sticks = pixels(page)
    assert all(mask.sum() > 300 for mask in limbs(sticks))
    assert (np.abs(sticks - skinned).max(axis=-1) > 24).mean() > 0.01
    page.evaluate("back.restoreContext()")
    until(page, "__viewer.view === 'webgl'")
    again = pixels(page)
    assert (np.abs(again - skinned).max(axis=-1) > 24).mean() < 0.002


def test_without_webgl2_or_when_asked_there_are_sticks(
    browser: Any, until: Callable[..., None], page_file: Path, pixels: Any
) -> None:
    refuse = """const get = HTMLCanvasElement.prototype.getContext;
        HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
            return kind === "webgl2" ? null : get.call(this, kind, ...rest);
        };"""
    for address, script in ((page_file.as_uri() + "?view=2d", ""), (page_file.as_uri(), refuse)):
        page = browser.new_page(viewport=SIZE)
        if script:
            page.add_init_script(script)
        page.goto(address)
        until(page, "window.__viewer && __viewer.draws > 0")
        assert page.evaluate("__viewer.view") == "2d"
        still(page, 5)
        assert all(mask.sum() > 300 for mask in limbs(pixels(page)))
        page.close()
