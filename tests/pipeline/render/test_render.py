"""Camera, raster, films and pages, without a browser."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable
from html import unescape
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import UserError
from motionloom.pipeline.render.camera import FIELD_OF_VIEW, Camera, fit_distance
from motionloom.pipeline.render.charts import Line, histogram, line_chart
from motionloom.pipeline.render.film import write_mp4
from motionloom.pipeline.render.page import Page
from motionloom.pipeline.render.scene import LAMP, SKY, SOLE, Actor, Ground, cover, draw_figure
from motionloom.pipeline.render.viewer import ViewerMotion, quantise, safe_json, viewer_script, write_viewer

SMPLX = Skeleton.named("smplx52")
BLUE, ORANGE = (47, 143, 196), (229, 121, 63)
Walk = Callable[..., np.ndarray]
NASTY = "</script><script>alert('x')</script> <!-- & \"q\" \u2028 </style>"


class Tags(HTMLParser):
    def __init__(self, html: str) -> None:
        super().__init__()
        self.seen: list[tuple[str, dict]] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list) -> None:
        self.seen.append((tag, dict(attrs)))

    def count(self, tag: str) -> int:
        return sum(name == tag for name, _ in self.seen)


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
    ring = np.stack([np.cos(around), 0 * around, np.sin(around)], axis=1)
    body = [0.25 * radius * ring + middle + [0, h, 0] for h in (-top, top)]
    seen = camera.project(np.concatenate([*body, radius * ring + middle]), middle)
    slack = 0.06  # perspective and the tilt may cost a few percent
    assert seen[:, 0].min() > -slack * width and seen[:, 0].max() < (1 + slack) * width
    assert seen[:, 1].min() > -slack * 400 and seen[:, 1].max() < (1 + slack) * 400


# ---- viewer file


def test_quantised_positions_are_tenths_of_millimetres(walk: Walk) -> None:
    joints = walk(100, turn=0.0)
    integers, low, step = quantise(joints)
    assert integers.dtype == np.uint16
    assert np.abs(low + step * integers - joints).max() < 1e-4
    still = np.tile(joints[:1, :1], (4, 3, 1))
    integers, low, step = quantise(still)
    np.testing.assert_allclose(low + step * integers, still, atol=1e-8)


def test_page_holds_what_was_given(tmp_path: Path, data_of: Any, walk: Walk) -> None:
    joints, face = walk(30), np.tile([0.5, -1, 0.8, 0, 0.25], (30, 1))
    motion = ViewerMotion(joints, 20, SMPLX.parents, "truth", "a person walks", "row", face)
    write_viewer(tmp_path / "deep" / "v.html", [motion], "Title", "Note")
    data = data_of(tmp_path / "deep" / "v.html")
    (clip,) = data["motions"]
    packed = np.frombuffer(base64.b64decode(clip["positions"]), "<u2").reshape(30, 52, 3)
    assert np.abs(np.array(clip["low"]) + np.array(clip["step"]) * packed - joints).max() < 1e-4
    controls = np.frombuffer(base64.b64decode(clip["face"]), "<i2").reshape(30, 5) * data["faceStep"]
    np.testing.assert_allclose(controls, face, atol=6e-4)
    named = [clip[key] for key in ("label", "caption", "group", "fps")]
    assert named == ["truth", "a person walks", "row", 20]
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["v.html"]


def test_24_motions_stay_below_3_6_mb_and_load_nothing(tmp_path: Path, data_of: Any, walk: Walk) -> None:
    joints = walk(200)
    motions = [ViewerMotion(joints, 20, SMPLX.parents, f"m{k}", "walks", f"g{k // 3}") for k in range(24)]
    write_viewer(tmp_path / "v.html", motions, "many")
    text = (tmp_path / "v.html").read_text("utf-8")
    assert len(text) < 3_600_000  # 0.5 MB of it are the body
    assert len(data_of(tmp_path / "v.html")["skeletons"]) == 1
    tags = Tags(text)
    assert not [a for _, a in tags.seen if "src" in a or "href" in a]
    assert not re.search(r"https?://", text.replace("http://www.w3.org/2000/svg", ""))


def test_untrusted_text_cannot_leave_its_place(tmp_path: Path, data_of: Any, walk: Walk) -> None:
    motion = ViewerMotion(walk(2), 20, SMPLX.parents, NASTY, NASTY, NASTY)
    write_viewer(tmp_path / "v.html", [motion], NASTY, NASTY)
    text = (tmp_path / "v.html").read_text("utf-8")
    assert "alert('x')</script>" not in text
    assert Tags(text).count("script") == 2
    data = data_of(tmp_path / "v.html")
    assert data["motions"][0]["caption"] == data["title"] == data["note"] == NASTY
    assert not set("<>&") & set(safe_json({"a": NASTY}))
    assert "</script" not in viewer_script()


def test_viewer_refuses_what_it_cannot_draw(tmp_path: Path) -> None:
    broken = ViewerMotion(np.full((3, 52, 3), np.nan), 20.0, SMPLX.parents, "mine")
    with pytest.raises(UserError, match=r"mine.*NaN"):
        write_viewer(tmp_path / "v.html", [broken], "t")
    assert not (tmp_path / "v.html").exists()


# ---- raster, pictures and film


def test_cover_is_what_a_loop_over_pixels_finds() -> None:
    rng = np.random.default_rng(0)
    points, nearness = rng.uniform(-6, 38, (60, 2)), rng.uniform(0.2, 1, 60)
    points[:20, 1] = 9.25  # level edges too
    triangles = rng.integers(0, 60, (40, 3))
    for both in (False, True):
        found = cover(points, nearness, triangles, (32, 24), both_sides=both)
        seen = dict(zip(found.pixels.tolist(), found.triangles.tolist(), strict=True))
        for pixel in range(32 * 24):
            middle = np.array([pixel % 32 + 0.5, pixel // 32 + 0.5])
            best, front = None, -np.inf
            for number, (a, b, c) in enumerate(points[triangles]):
                matrix = np.stack([b - a, c - a], axis=1)
                size = np.linalg.det(matrix)
                if abs(size) < 1e-9 or (size > 0 and not both):
                    continue
                shares = np.linalg.solve(matrix, middle - a)
                shares = np.array([1 - shares.sum(), *shares])
                near = shares @ nearness[triangles[number]]
                if (shares >= 0).all() and near > front:
                    best, front = number, near
            assert seen.get(pixel) == best
        middles = np.stack([found.pixels % 32 + 0.5, found.pixels // 32 + 0.5], axis=1)
        np.testing.assert_allclose(found.mixed(triangles, points.astype(np.float32)), middles, atol=1e-3)


def picture(actor: Actor, view: tuple[float, float]) -> np.ndarray:
    camera, target = Camera(*view, 5.0, 200, 240), np.array([0, 0.85, 0])
    image = np.full((240, 200, 3), 250, np.uint8)
    Ground(camera, 0.85, -SOLE).cast_shadow(image, target, actor, 0)
    draw_figure(image, camera, target, actor, 0, "near")
    return image.astype(int)


def test_the_face_shows_and_the_shadow_is_away_from_the_lamp() -> None:
    standing = SMPLX.rest_joints[None] + [0, 0.95, 0]
    calm = picture(Actor.of(standing, SMPLX), (0.0, 0.08))
    glad = picture(Actor.of(standing, SMPLX, None, np.array([[1, 1, 1.6, 0.9, 0.0]])), (0.0, 0.08))
    changed = np.argwhere(np.abs(calm - glad).max(axis=-1) > 30)
    assert len(changed) > 8 and changed[:, 0].max() < 90
    from_above = picture(Actor.of(standing, SMPLX), (0.0, 1.3))
    grey = (from_above.max(axis=-1) < 245) & (np.ptp(from_above, axis=-1) < 12)
    rows, columns = np.nonzero(grey)
    # Light comes from the left and from ahead: on the picture the shadow is to the right and above.
    assert LAMP[0] < 0 < LAMP[2] and grey.sum() > 300
    assert columns.mean() > 100 and rows.mean() < 120
    from_below = picture(Actor.of(standing, SMPLX), (0.0, -0.1))
    assert (from_below[215:] == 250).all()  # nothing is seen of it


def colour_share(image: np.ndarray, colour: tuple[int, int, int]) -> float:
    """Share of pixels of a colour, in light or shade."""
    return float((np.abs(image.astype(int) - colour).max(axis=-1) < 55).mean())


def test_a_film_has_every_frame_of_the_figure_in_both_colours(tmp_path: Path, walk: Walk) -> None:
    seen: list[tuple[int, int]] = []
    path = tmp_path / "films" / "walk.mp4"
    write_mp4(
        path, walk(40, wave=True), SMPLX, 20, "a person waves " * 9, size=(255, 201),
        progress=lambda k, n: seen.append((k, n)),
    )  # fmt: skip
    assert seen == [(k, 40) for k in range(1, 41)]
    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    assert meta["size"] == (256, 202) and meta["fps"] == 20
    assert "yuv420p" in meta["pix_fmt"] and meta["codec"] == "h264"
    frames = [np.frombuffer(frame, np.uint8).reshape(202, 256, 3) for frame in reader]
    assert len(frames) == 40 and [p.name for p in path.parent.iterdir()] == ["walk.mp4"]
    for frame in frames[:12]:
        assert min(colour_share(frame, BLUE), colour_share(frame, ORANGE)) > 0.001
        edge = np.concatenate([frame[:3].reshape(-1, 3), frame[:, :3].reshape(-1, 3)[: 3 * 120]])
        assert np.abs(edge.astype(int) - SKY).max() < 60  # the whole figure fits
    moved = [np.abs(a.astype(int) - b).max(axis=-1).mean() for a, b in pairwise(frames)]
    assert min(moved) > 0.2


def test_broken_film_leaves_no_file(tmp_path: Path, walk: Walk) -> None:
    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_mp4(tmp_path / "a.mp4", walk(5), SMPLX, 20, size=(64, 64), progress=stop)
    with pytest.raises(UserError, match="NaN"):
        write_mp4(tmp_path / "a.mp4", np.full((2, 52, 3), np.nan), SMPLX, 20)
    assert not list(tmp_path.iterdir())


# ---- page


def test_page_is_whole_and_escapes(tmp_path: Path, walk: Walk) -> None:
    page = Page(NASTY, NASTY)
    page.add_heading(NASTY).add_text(f"one {NASTY}\n\ntwo").add_facts({NASTY: NASTY, "FID": 1.17399})
    page.add_table([NASTY, "n"], [[NASTY, 1.5], ["x", None]], NASTY).add_heading("Second")
    page.add_plot([Line(NASTY, [0, 1], [1, 2]), Line("b", [0, 1], [2, 1])], NASTY, NASTY, NASTY)
    page.add_histogram({NASTY: [1, 2], "b": [2, 3]}, (0, 2), NASTY)
    motion = ViewerMotion(walk(2), 20, SMPLX.parents, NASTY, NASTY, NASTY)
    page.add_viewer([motion], NASTY).add_viewer([motion])
    page.write(tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text("utf-8")
    tags = Tags(text)
    assert "<script>alert" not in text
    assert tags.count("script") == 2 + 2 * 2 and tags.count("table") == 1 and tags.count("svg") == 2
    assert text.count("function mountViewer") == 1
    assert [a["href"] for t, a in tags.seen if t == "a"] == ["#section-1", "#section-2"]
    assert '<td class="number">1.500</td>' in text and '<td class="number">–</td>' in text
    plain = Page("t").add_text("x").html()
    assert "mountViewer" not in plain and len(plain) < 16_000


# Charts and folds as HTML: right numbers, readable names, nothing unescaped.

MARKUP = '<b onclick="x">&'


def test_folds_of_a_page() -> None:
    page = Page("t")
    with page.folded(MARKUP):
        for title in ("two", "three"):
            page.add_plot([Line("x", [1, 2], [1, 2])], title)
    body = page.html().split("<main>")[1].split("</main>")[0]
    assert MARKUP not in body
    assert body.count('<div class="plots">') == 1
    assert body.index("<details") < body.index("three") < body.index("</details>")


def test_line_chart_keeps_spikes_and_drops_what_is_not_finite() -> None:
    y = np.ones(5000)
    y[1234], y[77] = 9.0, np.nan
    svg = line_chart(
        [Line("train", np.arange(5000), y), Line("val", [0, 5000], [2, 1], dashed=True)], y_label="loss"
    )
    hover = json.loads(unescape(re.search(r'data-hover="([^"]*)"', svg)[1]))
    train = hover["lines"][0]
    assert 9.0 in [v for _, v in train["values"]] and len(train["values"]) <= 402
    assert "nan" not in svg.lower()
    assert svg.count("<polyline") == 2 and svg.count("stroke-dasharray") == 1
    inside = np.array(train["at"])
    assert (inside >= 0).all() and (inside <= [640, 320]).all()


@given(st.lists(st.floats(-1e12, 1e12), min_size=1, max_size=20))
@settings(max_examples=80, deadline=None)
def test_charts_draw_any_numbers(values: list[float]) -> None:
    svg = line_chart([Line("a", range(len(values)), values)])
    assert svg.startswith("<svg") and "inf" not in svg and "nan" not in svg
    counts = np.abs(values)
    assert histogram({"n": counts}, (0, len(values))).count("<rect") == (len(values) if counts.any() else 0)


def test_charts_without_data_say_so() -> None:
    assert "no data" in line_chart([]) and "no data" in line_chart([Line("a", [1], [np.nan])])
    assert "no data" in histogram({}, (0, 1))
    assert histogram({"uses": [0] * 20 + [3]}, (0, 21)).count('class="dead"') == 20
