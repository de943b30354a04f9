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
from motionloom.pipeline.render.page import Page
from motionloom.pipeline.render.sound import Segment
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


# Figures and music in step, and the time line, in a real headless Chromium.

PARENTS = Skeleton.named("smplx52").parents
FPS = 20
NASTY = "</script><img src=x onerror='window.hacked=1'>"
SCRIPT = [(0, 2, "a person walks"), Segment(2, 5, "song 04", "music"), Segment(5, 8, NASTY)]
Make = Callable[..., Any]


@pytest.fixture(scope="module")
def dance(tmp_path_factory: pytest.TempPathFactory, walk: Make, song: Make) -> Path:
    """Eight seconds in two figures that share their music."""
    path = tmp_path_factory.mktemp("dance") / "viewer.html"
    write_viewer(
        path,
        [
            ViewerMotion(walk(8 * FPS), FPS, PARENTS, label, "dances", "dances", None, tune, beats, SCRIPT)
            for tune in (song(10.0),)
            for beats in (np.arange(0, 8, 0.5),)
            for label in ("recorded", "generated")
        ],
        "Dance",
    )
    return path


@pytest.fixture(scope="module")
def songs(tmp_path_factory: pytest.TempPathFactory, walk: Make, song: Make) -> Path:
    """A long motion to a short song, a short motion to another, and one without any."""
    path = tmp_path_factory.mktemp("songs") / "viewer.html"
    long = ViewerMotion(walk(100), FPS, PARENTS, "long", "x", "", None, song(1.5), [0.5, 1.0])
    short = ViewerMotion(walk(30), FPS, PARENTS, "short", "y", "", None, song(9.0, beat=0.3), [0.3, 0.6])
    write_viewer(path, [long, short, ViewerMotion(walk(100), FPS, PARENTS, "quiet", "z")], "Songs")
    return path


def turn_on(page: Any, until: Make) -> None:
    page.get_by_role("button", name="Sound on").click()
    until(page, "__viewer.sound && !__viewer.audio.paused && __viewer.audio.currentTime > 0.05")


def moments(page: Any, count: int = 20, gap: int = 3) -> list[dict[str, float]]:
    """What is drawn and what is heard, `count` times, right after the page has drawn.

    `frame` is the number written on the figure; `late` the seconds since the browser began this drawing:
    the sound has gone on for that long, at most, since the page looked at its clock.
    """
    return page.evaluate(
        """([count, gap]) => new Promise((done) => {
            const out = []; let k = 0;
            const look = (start) => {
                const frame = parseInt(document.querySelector(".mlv-count").textContent) - 1;
                const audio = __viewer.audio;
                if (k++ % gap === 0) out.push({
                    frame, time: __viewer.time, heard: audio.currentTime, rate: audio.playbackRate,
                    late: (performance.now() - start) / 1000, paused: audio.paused,
                });
                if (out.length < count) requestAnimationFrame(look); else done(out);
            };
            requestAnimationFrame(look);
        })""",
        [count, gap],
    )


def assert_in_step(seen: list[dict[str, float]], speed: float = 1.0) -> None:
    """Every frame drawn is the one that belongs to what is heard, to one frame."""
    assert seen[-1]["heard"] - seen[0]["heard"] > 0.2 * speed  # it did play
    for moment in seen:
        assert not moment["paused"] and moment["rate"] == speed
        latest = moment["heard"] * FPS + 1
        earliest = (moment["heard"] - moment["late"] * speed) * FPS - 1
        assert earliest <= moment["frame"] <= latest, moment


def test_frames_follow_the_sound_after_seek_pause_and_at_half_speed(
    visit: Make, until: Make, dance: Path
) -> None:
    page = visit(dance, plays=True)
    until(page, "__viewer.frame > 5")
    assert page.evaluate("[__viewer.sound, __viewer.audio.paused]") == [False, True]  # silent at first
    turn_on(page, until)
    assert_in_step(moments(page))
    page.evaluate("__viewer.setFrame(100)")
    until(page, "!__viewer.audio.seeking && __viewer.audio.currentTime > 5.05")
    seen = moments(page)
    assert seen[0]["heard"] > 5.0
    assert_in_step(seen)

    page.locator("canvas").first.focus()
    page.keyboard.press("Space")
    until(page, "__viewer.audio.paused")
    assert page.evaluate("[__viewer.playing, __viewer.sound]") == [False, True]
    stopped = page.evaluate("[__viewer.time, __viewer.audio.currentTime]")
    assert abs(stopped[0] - stopped[1]) < 1.5 / FPS
    page.wait_for_timeout(150)
    assert page.evaluate("[__viewer.time, __viewer.audio.currentTime]") == stopped

    page.get_by_label("Speed").select_option("0.5")
    page.evaluate("() => { __viewer.setFrame(20); __viewer.play(true); }")
    until(page, "!__viewer.audio.paused && !__viewer.audio.seeking && __viewer.audio.currentTime > 1.02")
    seen = moments(page)
    assert seen[0]["heard"] < 5.0
    assert_in_step(seen, 0.5)


def test_a_pause_stands_where_the_sound_stopped(visit: Make, until: Make, dance: Path) -> None:
    """Also where the page has drawn nothing for a while, and the sound went on."""
    page = visit(dance, plays=True)
    turn_on(page, until)
    until(page, "__viewer.audio.currentTime > 0.3")
    busy = "const end = performance.now() + 500; while (performance.now() < end);"
    page.evaluate(f"() => {{ {busy} __viewer.play(false); }}")
    stopped = page.evaluate("[__viewer.time, __viewer.audio.currentTime]")
    assert abs(stopped[0] - stopped[1]) < 1.5 / FPS


def test_another_motions_music_is_heard_in_its_place(visit: Make, until: Make, songs: Path) -> None:
    page = visit(songs, plays=True)
    assert page.locator(".mlv-hear:visible").count() == 2
    turn_on(page, until)
    length = page.evaluate("__viewer.audio.duration")
    assert 1.4 < length < 1.6
    until(page, "__viewer.frame > 40")  # the song is over; the motion is not
    assert page.evaluate("__viewer.audio.paused || __viewer.audio.ended")
    ticks = "document.querySelector('.mlv-beats path').getAttribute('d')"
    first = page.evaluate(ticks)
    page.evaluate("() => { window.before = __viewer.audio; __viewer.setFrame(0); }")
    page.locator(".mlv-hear").nth(1).click()
    until(page, "!__viewer.audio.paused && __viewer.audio.currentTime > 0.05")
    assert page.evaluate("before.paused && before !== __viewer.audio")
    assert page.evaluate(ticks) != first
    pressed = [page.locator(".mlv-hear").nth(k).get_attribute("aria-pressed") for k in (0, 1)]
    assert pressed == ["false", "true"]
    page.locator(".mlv-hear").nth(1).click()  # once more: silence
    until(page, "!__viewer.sound && __viewer.audio.paused")


def test_one_viewer_of_a_page_sounds_at_a_time(
    visit: Make, until: Make, tmp_path: Path, walk: Make, song: Make
) -> None:
    motion = ViewerMotion(walk(100), FPS, PARENTS, "a", "b", sound=song(5.0))
    path = tmp_path / "page.html"
    Page("Report").add_viewer([motion]).add_viewer([motion]).write(path)
    page = visit(path, width=1000, height=1500, plays=True)
    for k in (0, 1):
        # The first viewer's button reads 'Sound off' once it sounds.
        page.get_by_role("button", name="Sound on").first.click()
        until(page, f"__viewers[{k}].sound && !__viewers[{k}].audio.paused")
    until(page, "!__viewers[0].sound && __viewers[0].audio.paused")
    assert page.evaluate("__viewers[1].sound && !__viewers[1].audio.paused")


def test_time_line_shows_beats_bands_and_the_band_that_plays(visit: Make, until: Make, dance: Path) -> None:
    page = visit(dance, plays=True)
    page.evaluate("() => { __viewer.play(false); __viewer.setFrame(60); }")
    until(page, "document.querySelector('.mlv-lit')?.textContent === '♪ song 04'")
    bands = page.locator(".mlv-band")
    assert bands.all_text_contents() == ["a person walks", "♪ song 04", NASTY]
    assert page.locator(".mlv-now").all_text_contents() == ["♪ song 04"] * 2
    assert page.get_by_label("Time").get_attribute("aria-valuetext") == "3.00 seconds, song 04"
    assert (
        page.evaluate("document.querySelector('.mlv-beats path').getAttribute('d').split('M').length - 1")
        == 16
    )
    # Bands lie where the scrub bar's knob, 22 px wide, has its middle at their times.
    box, last = page.get_by_label("Time").bounding_box(), 8 - 1 / FPS
    for k, (start, end) in enumerate(((0, 2), (2, 5), (5, last))):
        band = bands.nth(k).bounding_box()
        at = [box["x"] + 11 + (box["width"] - 22) * t / last for t in (start, end)]
        assert abs(band["x"] - at[0]) < 1 and abs(band["x"] + band["width"] - at[1]) < 1
    page.mouse.click(bands.nth(2).bounding_box()["x"] + 20, box["y"] + 12)
    until(page, "document.querySelector('.mlv-lit').textContent.startsWith('</script>')")
    assert page.evaluate("__viewer.segment[0]") == 5
    assert page.locator("img").count() == 0 and page.evaluate("window.hacked") is None
