"""Geometry, quantisation, pictures, film and pages, without a browser."""

from __future__ import annotations

import base64
import json
import re
import time
from collections.abc import Callable
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import UserError
from motionloom.datasets.synth.face import APEX, BASIS
from motionloom.pipeline.render.body.palette import PALETTE
from motionloom.pipeline.render.camera import FIELD_OF_VIEW, Camera, fit_distance, smooth_path
from motionloom.pipeline.render.charts import Line
from motionloom.pipeline.render.face import synthetic_face_controls
from motionloom.pipeline.render.figure import CENTRE, LEFT, RIGHT, figure_for, human_figure
from motionloom.pipeline.render.lettering import font, wrap
from motionloom.pipeline.render.page import Page
from motionloom.pipeline.render.picture import contact_sheet
from motionloom.pipeline.render.raster import SKY
from motionloom.pipeline.render.video import render_frames, write_mp4
from motionloom.pipeline.render.viewer import ViewerMotion, quantise, safe_json, viewer_script, write_viewer

SMPLX = Skeleton.named("smplx52")
Walk = Callable[..., np.ndarray]
NASTY = "</script><script>alert('x')</script> <!-- & \"q\" \u2028 </style>"


def data_of(page: Path) -> dict:
    return json.loads(re.search(r'id="viewer-data">(.*?)</script>', page.read_text("utf-8"), re.S)[1])


class Tags(HTMLParser):
    def __init__(self, html: str) -> None:
        super().__init__()
        self.seen: list[tuple[str, dict]] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list) -> None:
        self.seen.append((tag, dict(attrs)))

    def count(self, tag: str) -> int:
        return sum(name == tag for name, _ in self.seen)


# ---- figure


@pytest.mark.parametrize(("name", "hands"), [("smplx52", True), ("smpl22", False)])
def test_human_figure_draws_every_joint_and_both_sides_alike(name: str, hands: bool) -> None:
    skeleton, figure = Skeleton.named(name), human_figure(name)
    used = (
        {c.a for c in figure.capsules}
        | {c.b for c in figure.capsules}
        | {n for h in figure.hulls for n in h.nodes}
    )
    reached = {joint for node in used for joint, _ in figure.blends[node]}
    assert reached | {skeleton.index("spine3")} == set(range(len(skeleton)))
    sides = [c.side for c in figure.capsules] + [h.side for h in figure.hulls]
    assert sides.count(LEFT) == sides.count(RIGHT) > 0
    assert sum(c.fine for c in figure.capsules) == (30 if hands else 0)
    for blend in figure.blends:
        assert sum(w for _, w in blend) == pytest.approx(1.0)  # translation moves every node with the body


def test_nodes_mirror_and_scale(walk: Walk) -> None:
    figure, joints = human_figure("smplx52"), walk(3)
    assert figure.scale(joints) == pytest.approx(1.0, abs=1e-6)
    assert figure.scale(joints * 0.6) == pytest.approx(0.6, abs=1e-6)
    rest = np.array([sum(w * SMPLX.rest_joints[j] for j, w in blend) for blend in figure.blends])
    left = {n for c in figure.capsules if c.side == LEFT for n in (c.a, c.b)}
    right = {n for c in figure.capsules if c.side == RIGHT for n in (c.a, c.b)}
    assert all(rest[n, 0] > 0 for n in left) and all(rest[n, 0] < 0 for n in right)


def test_unknown_skeletons_get_plain_capsules() -> None:
    parents = [-1, 0, 1, 0, 0]
    pose = np.array([[[0, 1, 0], [0, 1.5, 0], [0, 1.8, 0], [0.4, 1, 0], [-0.4, 1, 0]]], float)
    figure = figure_for(parents, pose)
    assert [(c.a, c.b, c.side) for c in figure.capsules] == [
        (0, 1, CENTRE),
        (1, 2, CENTRE),
        (0, 3, LEFT),
        (0, 4, RIGHT),
    ]
    assert figure.head is None and figure.scale(pose) == 1.0


def test_face_controls_follow_the_synthetic_basis() -> None:
    happy, sad, angry, surprised = (synthetic_face_controls(APEX * BASIS[None, :, k])[0] for k in range(4))
    neutral = synthetic_face_controls(np.zeros((1, 50)))[0]
    np.testing.assert_allclose(neutral, [0, 0, 1, 0, 0])
    assert happy[0] > 0.9 and happy[4] == pytest.approx(0, abs=1e-9)
    assert sad[4] > 0.9 and angry[1] < -0.5 < 0.5 < surprised[1]
    assert surprised[3] > 0.5 and surprised[2] > 1.3
    assert synthetic_face_controls(1.6 * BASIS[None, :, 4])[0, 2] == pytest.approx(0, abs=1e-6)


# ---- camera


def test_projection_agrees_with_a_plain_pinhole() -> None:
    camera = Camera(yaw=0.0, pitch=0.0, distance=5.0, width=400, height=300)
    focal = 150 / np.tan(FIELD_OF_VIEW / 2)
    x, y, depth, scale = camera.project(np.array([0.5, 1.2, 1.0]), np.array([0.0, 1.0, 0.0]))
    assert (x, y, depth) == pytest.approx((200 + 0.5 * focal / 4, 150 - 0.2 * focal / 4, 4.0))
    assert scale == pytest.approx(focal / 4)  # a figure that faces +Z shows its left (+X) on the right


@given(
    st.floats(-3, 3), st.floats(-0.1, 1.5), st.floats(0.5, 2.4), st.floats(0.2, 1.2), st.integers(100, 900)
)
@settings(max_examples=60, deadline=None)
def test_a_figure_fits_its_picture(
    yaw: float, pitch: float, height: float, radius: float, width: int
) -> None:
    radius = min(radius, height)
    camera = Camera(yaw, pitch, fit_distance(height, radius, width, 400), width, 400)
    around = np.linspace(0, 2 * np.pi, 30)
    top, middle = height / 2, np.array([0, height / 2, 0])
    body = [
        [0.25 * radius * np.cos(a), h, 0.25 * radius * np.sin(a)]
        for a in around
        for h in (middle[1] - top, middle[1] + top)
    ]
    arms = [[radius * np.cos(a), middle[1], radius * np.sin(a)] for a in around]
    seen = camera.project(np.array(body + arms), middle)
    slack = 0.06  # perspective and the tilt may cost a few percent
    assert seen[:, 0].min() > -slack * width and seen[:, 0].max() < (1 + slack) * width
    assert seen[:, 1].min() > -slack * 400 and seen[:, 1].max() < (1 + slack) * 400


def test_smooth_path_equals_a_plain_mean() -> None:
    root = np.random.default_rng(0).normal(size=(30, 3))
    path = smooth_path(root, fps=10.0)
    for k in range(30):
        window = [root[min(max(k + d, 0), 29)] for d in range(-4, 5)]
        np.testing.assert_allclose(path[k], np.mean(window, axis=0))


# ---- viewer file


def test_quantised_positions_are_tenths_of_millimetres(walk: Walk) -> None:
    joints = walk(100, turn=0.0)
    integers, low, step = quantise(joints)
    assert integers.dtype == np.uint16
    assert np.abs(low + step * integers - joints).max() < 1e-4
    still = np.tile(joints[:1, :1], (4, 3, 1))
    integers, low, step = quantise(still)
    np.testing.assert_allclose(low + step * integers, still, atol=1e-8)


def test_page_holds_what_was_given(tmp_path: Path, walk: Walk) -> None:
    joints, face = walk(30), np.tile([0.5, -1, 0.8, 0, 0.25], (30, 1))
    motion = ViewerMotion(joints, 20, SMPLX.parents, "truth", "a person walks", "row", face)
    write_viewer(tmp_path / "deep" / "v.html", [motion], "Title", "Note")
    data = data_of(tmp_path / "deep" / "v.html")
    (clip,) = data["motions"]
    packed = np.frombuffer(base64.b64decode(clip["positions"]), "<u2").reshape(30, 52, 3)
    assert np.abs(np.array(clip["low"]) + np.array(clip["step"]) * packed - joints).max() < 1e-4
    controls = np.frombuffer(base64.b64decode(clip["face"]), "<i2").reshape(30, 5) * data["faceStep"]
    np.testing.assert_allclose(controls, face, atol=6e-4)
    assert (clip["label"], clip["caption"], clip["group"], clip["fps"]) == (
        "truth",
        "a person walks",
        "row",
        20,
    )
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["v.html"]


def test_24_motions_stay_below_3_6_mb_and_load_nothing(tmp_path: Path, walk: Walk) -> None:
    joints = walk(200)
    motions = [ViewerMotion(joints, 20, SMPLX.parents, f"m{k}", "walks", f"g{k // 3}") for k in range(24)]
    write_viewer(tmp_path / "v.html", motions, "many")
    text = (tmp_path / "v.html").read_text("utf-8")
    assert len(text) < 3_600_000  # 0.5 MB of it are the body
    assert len(data_of(tmp_path / "v.html")["figures"]) == 1
    tags = Tags(text)
    assert not [a for _, a in tags.seen if "src" in a or "href" in a]
    assert not re.search(r"https?://", text.replace("http://www.w3.org/2000/svg", ""))


def test_untrusted_text_cannot_leave_its_place(tmp_path: Path, walk: Walk) -> None:
    motion = ViewerMotion(walk(2), 20, SMPLX.parents, NASTY, NASTY, NASTY)
    write_viewer(tmp_path / "v.html", [motion], NASTY, NASTY)
    text = (tmp_path / "v.html").read_text("utf-8")
    assert "alert('x')</script>" not in text
    assert Tags(text).count("script") == 2
    data = data_of(tmp_path / "v.html")
    assert data["motions"][0]["caption"] == data["title"] == data["note"] == NASTY
    assert not set("<>&") & set(safe_json({"a": NASTY}))
    assert "</script" not in viewer_script()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"joints": np.full((3, 52, 3), np.nan)}, "NaN"),
        ({"joints": np.zeros((3, 51, 3))}, "51 joints but 52 parents"),
        ({"joints": np.zeros((0, 52, 3))}, r"\[T, N, 3\]"),
        ({"fps": 0}, "fps"),
        ({"face_controls": np.zeros((2, 5))}, "face_controls"),
    ],
)
def test_viewer_refuses_what_it_cannot_draw(tmp_path: Path, change: dict, words: str) -> None:
    given_motion = {
        "joints": np.zeros((3, 52, 3)),
        "fps": 20.0,
        "parents": SMPLX.parents,
        "label": "mine",
        **change,
    }
    with pytest.raises(UserError, match=words) as caught:
        write_viewer(tmp_path / "v.html", [ViewerMotion(**given_motion)], "t")
    assert "mine" in str(caught.value)
    assert not (tmp_path / "v.html").exists()
    with pytest.raises(UserError, match="at least one"):
        write_viewer(tmp_path / "v.html", [], "t")


# ---- pictures and film


def colour_share(image: np.ndarray, colour: tuple[int, int, int]) -> float:
    """Share of pixels of a colour, in light or shade."""
    return float((np.abs(image.astype(int) - colour).max(axis=-1) < 55).mean())


def test_frames_show_the_figure_in_both_colours_and_move(walk: Walk) -> None:
    frames = [
        np.asarray(f)
        for f in render_frames(walk(12, wave=True), SMPLX, 20, "a person waves", size=(240, 200))
    ]
    assert len(frames) == 12 and frames[0].shape == (200, 240, 3)
    for frame in frames:
        assert colour_share(frame, PALETTE[LEFT]) > 0.003 and colour_share(frame, PALETTE[RIGHT]) > 0.003
        edge = np.concatenate([frame[:3].reshape(-1, 3), frame[:, :3].reshape(-1, 3)[: 3 * 120]])
        assert np.abs(edge.astype(int) - SKY).max() < 60  # the whole figure fits
    moved = [np.abs(a.astype(int) - b).max(axis=-1).mean() for a, b in pairwise(frames)]
    assert min(moved) > 0.2


def test_left_is_blue_and_on_the_right_when_the_figure_faces_us() -> None:
    joints = (SMPLX.rest_joints + np.array([0, 0.95, 0]))[None]
    frame = np.asarray(next(iter(render_frames(joints, SMPLX, 20, size=(240, 240), view="front")))).astype(
        int
    )
    blue = np.abs(frame - PALETTE[LEFT]).max(axis=-1) < 30
    orange = np.abs(frame - PALETTE[RIGHT]).max(axis=-1) < 30
    assert blue[:, 125:].sum() > 10 * blue[:, :115].sum() + 50
    assert orange[:, :115].sum() > 10 * orange[:, 125:].sum() + 50


def test_mp4_has_every_frame_and_reports_progress(tmp_path: Path, walk: Walk) -> None:
    seen: list[tuple[int, int]] = []
    path = tmp_path / "films" / "walk.mp4"
    start = time.process_time()
    write_mp4(path, walk(40), SMPLX, 20, "walks", size=(255, 201), progress=lambda k, n: seen.append((k, n)))
    spent = time.process_time() - start
    assert seen == [(k, 40) for k in range(1, 41)]
    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    assert meta["size"] == (256, 202) and meta["fps"] == 20
    assert sum(1 for _ in reader) == 40
    assert "yuv420p" in meta["pix_fmt"] and meta["codec"] == "h264"
    assert [p.name for p in path.parent.iterdir()] == ["walk.mp4"]
    assert spent < 8.0  # about 25 frames a second of this process's time, with room for a busy machine


def test_broken_film_leaves_no_file(tmp_path: Path, walk: Walk) -> None:
    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_mp4(tmp_path / "a.mp4", walk(5), SMPLX, 20, size=(64, 64), progress=stop)
    with pytest.raises(UserError, match="NaN"):
        write_mp4(tmp_path / "a.mp4", np.full((2, 52, 3), np.nan), SMPLX, 20)
    with pytest.raises(UserError, match="3/4"):
        write_mp4(tmp_path / "a.mp4", walk(2), SMPLX, 20, view="behind")
    assert not list(tmp_path.iterdir())


def test_contact_sheet_has_a_row_a_motion_and_a_cell_a_pose(tmp_path: Path, walk: Walk) -> None:
    path = tmp_path / "sheet.png"
    long = "a person " + "walks and " * 60 + "stops"
    contact_sheet(
        path, [walk(40), walk(25)[:, :22]], ["truth", "body only"], ["walks", long], frames=4, cell=(100, 140)
    )
    sheet = np.asarray(Image.open(path).convert("RGB"))
    assert sheet.shape == (2 * (140 + 48), 400, 3)
    for row in range(2):
        for column in range(4):
            top = row * 188 + 48
            cell = sheet[top : top + 140, column * 100 : column * 100 + 100]
            assert colour_share(cell, PALETTE[LEFT]) > 0.01, (row, column)
        heading = sheet[row * 188 : row * 188 + 46]
        assert heading.min() < 120  # there are words
    with pytest.raises(UserError, match="parents"):
        contact_sheet(path, [np.zeros((2, 7, 3))], ["a"], ["b"])
    with pytest.raises(UserError, match="as many"):
        contact_sheet(path, [walk(2)], [], ["b"])


def test_contact_sheet_of_named_frames_is_that_of_a_clip_of_them(tmp_path: Path, walk: Walk) -> None:
    one, other, clip = tmp_path / "a.png", tmp_path / "b.png", walk(40)
    contact_sheet(one, [clip], ["a"], ["b"], frames=2, at=[[0, 39]], cell=(100, 140))
    contact_sheet(other, [clip], ["a"], ["b"], frames=2, cell=(100, 140))
    assert one.read_bytes() == other.read_bytes()
    contact_sheet(other, [clip], ["a"], ["b"], frames=2, at=[[0, 11]], cell=(100, 140))
    assert one.read_bytes() != other.read_bytes()
    with pytest.raises(UserError, match="3 frames for each of 1 rows"):
        contact_sheet(one, [clip], ["a"], ["b"], frames=3, at=[[0, 39]])


def test_contact_sheet_shows_the_face(tmp_path: Path, walk: Walk) -> None:
    """What differs between a shut and an open mouth lies where the head is."""
    one, other, clip = tmp_path / "a.png", tmp_path / "b.png", np.repeat(walk(40)[:1], 2, axis=0)
    shut, wide = np.zeros((2, 5)), np.tile([0.0, 0, 1, 1, 0], (2, 1))
    for path, face in ((one, shut), (other, wide)):
        contact_sheet(
            path, [clip], ["a"], ["b"], frames=1, face_controls=[face], cell=(300, 400), view="front"
        )
    apart = (np.asarray(Image.open(one)) != np.asarray(Image.open(other))).any(axis=-1)
    rows, columns = np.nonzero(apart)
    assert len(rows) > 5 and np.ptp(rows) < 60 and np.ptp(columns) < 60
    assert rows.mean() < 30 + 200, "the upper half of the cell, below the heading"


def test_text_wraps_within_its_width() -> None:
    face = font(14)
    lines = wrap("word " * 50, 120, face, 3)
    assert len(lines) == 3 and all(face.getlength(line) <= 120 for line in lines)
    assert lines[-1].endswith("…")
    (single,) = wrap("x" * 400, 120, face, 3)
    assert face.getlength(single) <= 120 and single.endswith("…")
    assert wrap("short", 120, face, 2) == ["short"]


# ---- page


def test_page_is_whole_and_escapes(tmp_path: Path, walk: Walk) -> None:
    contact_sheet(tmp_path / "s.png", [walk(3)], ["a"], ["b"], frames=2)
    page = Page(NASTY, NASTY)
    page.add_heading(NASTY).add_text(f"one {NASTY}\n\ntwo").add_facts({NASTY: NASTY, "FID": 1.17399})
    page.add_table([NASTY, "n"], [[NASTY, 1.5], ["x", None]], NASTY).add_heading("Second")
    page.add_plot([Line(NASTY, [0, 1], [1, 2]), Line("b", [0, 1], [2, 1])], NASTY, NASTY, NASTY)
    page.add_bars([1, 2], NASTY, labels=[NASTY, "b"]).add_image(tmp_path / "s.png", NASTY, NASTY)
    motion = ViewerMotion(walk(2), 20, SMPLX.parents, NASTY, NASTY, NASTY)
    page.add_viewer([motion], NASTY).add_viewer([motion])
    page.write(tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text("utf-8")
    tags = Tags(text)
    assert "<script>alert" not in text
    assert tags.count("script") == 2 + 2 * 2 and tags.count("table") == 1 and tags.count("svg") == 2
    assert text.count("function mountViewer") == 1
    assert [a["href"] for t, a in tags.seen if t == "a"] == ["#section-1", "#section-2"]
    assert all(a["src"].startswith("data:image/png;base64,") for t, a in tags.seen if t == "img")
    assert '<td class="number">1.500</td>' in text and '<td class="number">–</td>' in text
    plain = Page("t").add_text("x").html()
    assert "mountViewer" not in plain and len(plain) < 16_000


def test_page_refuses_uneven_rows_and_unknown_pictures() -> None:
    with pytest.raises(UserError, match="1 cells for 2 columns"):
        Page("t").add_table(["a", "b"], [["x"]], "numbers")
    with pytest.raises(UserError, match="PNG and JPEG"):
        Page("t").add_image(b"<svg onload=alert(1)>", "bad")
