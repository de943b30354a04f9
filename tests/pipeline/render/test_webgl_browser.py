"""The WebGL2 view in a real headless Chromium, its pixels made on the processor; and what is behind it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageDraw
from scipy.ndimage import binary_dilation

from motionloom.datasets.motion.body.rigid import fit_rigid
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.render.body.mesh import Posing, body_for, posing_of
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


def bones_of(posing: Posing, frame: int) -> np.ndarray:
    """Rotations [N, 3, 3], each stretched along the one bone that begins there to the length that it has."""
    parents, rest = np.asarray(posing.skeleton.parents), posing.skeleton.offsets
    out = posing.turns[frame].copy()
    for end, start in enumerate(parents):
        if start >= 0 and (parents == start).sum() == 1:
            length = np.linalg.norm(rest[end])
            now = np.linalg.norm(posing.joints[frame, end] - posing.joints[frame, start])
            along = rest[end] / length
            out[start] = out[start] @ (np.eye(3) + (now / length - 1) * np.outer(along, along))
    return out


def outline(page: Any, posing: Posing, frame: int) -> np.ndarray:
    """Which pixels of the page's canvas the body's triangles cover, each skinned and drawn in turn [H, W]."""
    lens, body, bones = page.evaluate("__viewer.lens(0)"), body_for(posing.skeleton), bones_of(posing, frame)
    shift = posing.joints[frame] - np.einsum("nij,nj->ni", bones, posing.skeleton.rest_joints)
    rows = np.concatenate([bones, shift[..., None]], axis=2)[body.joints]
    mixed = np.einsum("vk,vkij->vij", body.shares, rows)
    places = np.einsum("vij,vj->vi", mixed[..., :3], body.vertices) + mixed[..., 3]
    back = np.array(lens["back"])
    right = np.array([back[2], 0, -back[0]]) / np.hypot(back[0], back[2])
    seen = (places - lens["eye"]) @ np.stack([right, np.cross(back, right), -back], axis=1)
    focal = lens["height"] / 2 / np.tan(0.25)
    flat = [lens["width"] / 2, lens["height"] / 2] + seen[:, :2] / seen[:, 2:] * [focal, -focal]
    mask = Image.new("1", (int(lens["width"]), int(lens["height"])))
    for triangle in flat[body.triangles]:
        ImageDraw.Draw(mask).polygon([tuple(corner) for corner in triangle], fill=1)
    return np.asarray(mask)


def test_the_body_is_drawn_where_its_triangles_are(
    visit: Any, page_file: Path, joints: np.ndarray, pixels: Any
) -> None:
    page = visit(page_file, **SIZE)
    assert page.evaluate("__viewer.view") == "webgl"
    posing = posing_of(joints, SMPLX)
    before = None
    for frame, view in ((0, "front"), (15, "3/4")):
        still(page, frame, view)
        image = pixels(page)
        blue, orange = limbs(image)
        assert blue.sum() > 400 and orange.sum() > 400
        if view == "front":  # the figure looks at us: its left is on our right
            assert np.nonzero(blue)[1].mean() > np.nonzero(orange)[1].mean() + 10
        expected = outline(page, posing, frame)
        around = binary_dilation(expected)  # its edges are soft
        assert (around & (blue | orange)).sum() > 0.98 * (blue | orange).sum()
        # Skin and trunk are drawn too: where the figure is, the page has no bright ground.
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
        np.testing.assert_allclose(rows[:count, :, :3], bones_of(posing, 11), atol=8e-3)
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


def test_without_webgl2_there_are_sticks(
    browser: Any, until: Callable[..., None], page_file: Path, pixels: Any
) -> None:
    refuse = """const get = HTMLCanvasElement.prototype.getContext;
        HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
            return kind === "webgl2" ? null : get.call(this, kind, ...rest);
        };"""
    page = browser.new_page(viewport=SIZE)
    page.add_init_script(refuse)
    page.goto(page_file.as_uri())
    until(page, "window.__viewer && __viewer.draws > 0")
    assert page.evaluate("__viewer.view") == "2d"
    still(page, 5)
    assert all(mask.sum() > 300 for mask in limbs(pixels(page)))
    page.close()
