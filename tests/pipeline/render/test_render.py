"""Pages and charts, without a browser."""

from __future__ import annotations

import base64
import io
import json
import re
from collections.abc import Callable
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
from hypothesis import given, settings
from hypothesis import strategies as st

from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.contract.generation import Prompt
from motionloom.pipeline.inference.files.outputs import score_of
from motionloom.pipeline.inference.motion import GeneratedMotion
from motionloom.pipeline.render.charts import Line, histogram, line_chart
from motionloom.pipeline.render.page import Page
from motionloom.pipeline.render.sound import RATE, Score, Segment, embed_sounds, playable, score_data
from motionloom.pipeline.render.viewer import ViewerMotion, safe_json, viewer_script, write_viewer

SMPLX = Skeleton.named("smplx52")
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


# ---- viewer file


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
    broken = ViewerMotion(np.full((3, 52, 3), np.nan), 20.0, SMPLX.parents, "mine")
    with pytest.raises(UserError, match=r"mine.*NaN"):
        write_viewer(tmp_path / "w.html", [broken], "t")
    assert [p.name for p in tmp_path.rglob("*.html")] == ["v.html"]


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


# ---- page


def test_page_is_whole_and_escapes(tmp_path: Path, walk: Walk) -> None:
    page = Page(NASTY, NASTY)
    page.add_heading(NASTY).add_text(f"one {NASTY}\n\ntwo").add_facts({NASTY: NASTY, "FID": 1.17399})
    page.add_table([NASTY, "n"], [[NASTY, 1.5], ["x", None]], NASTY).add_heading("Second")
    page.add_plot([Line(NASTY, [0, 1], [1, 2]), Line("b", [0, 1], [2, 1])], NASTY)
    page.add_histogram({NASTY: [1, 2], "b": [2, 3]}, (0, 2), NASTY, NASTY, NASTY)
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
    lines = [Line("train", np.arange(5000), y), Line("val", [0, 5000], [2, 1], dashed=True)]
    svg = line_chart(lines, "loss")
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
    svg = line_chart([Line("a", range(len(values)), values)], "t")
    assert svg.startswith("<svg") and "inf" not in svg and "nan" not in svg
    counts = np.abs(values)
    bars = histogram({"n": counts}, (0, len(values)), "t", "x", "y").count("<rect")
    assert bars == (len(values) if counts.any() else 0)


def test_charts_without_data_say_so() -> None:
    assert "no data" in line_chart([], "t") and "no data" in line_chart([Line("a", [1], [np.nan])], "t")
    assert "no data" in histogram({}, (0, 1), "t", "x", "y")
    assert histogram({"uses": [0] * 20 + [3]}, (0, 21), "t", "x", "y").count('class="dead"') == 20


# Sound, beats and segments in pages, without a browser.


Make = Callable[..., Any]


def policy_of(text: str) -> str:
    return re.search(r'Content-Security-Policy" content="(.*?)"', text)[1]


def lag(made: np.ndarray, wanted: np.ndarray) -> int:
    """Samples by which `made` comes later, by the peak of their correlation."""
    n = min(len(made), len(wanted))
    spectrum = np.fft.rfft(made[:n], 2 * n) * np.conj(np.fft.rfft(wanted[:n], 2 * n))
    k = int(np.argmax(np.fft.irfft(spectrum)))
    return k if k < n else k - 2 * n


# ---- what a page carries


def test_sound_for_a_page_is_mp3_of_constant_rate_in_its_place(song: Make) -> None:
    tune = song(3.0)
    (made,), chosen = embed_sounds([(tune, 2.0)])
    assert chosen == [0] and made["mime"] == "audio/mpeg" and made["seconds"] == 2.0
    assert len(base64.b64decode(made["data"])) == pytest.approx(
        2 * 96_000 / 8, rel=0.05
    )  # frames of 26 ms at both ends
    heard, rate = soundfile.read(io.BytesIO(base64.b64decode(made["data"])))
    wanted = playable(tune)
    assert rate == RATE and abs(len(heard) - 2 * RATE) <= 1
    assert abs(lag(heard, wanted)) <= 1
    error = heard - wanted[: len(heard)]
    assert np.square(error).mean() < 0.02 * np.square(wanted).mean()


def test_one_sound_is_carried_once_and_as_long_as_its_longest_motion(song: Make) -> None:
    tune, other = song(4.0), song(1.0, beat=0.3)
    again = replace(tune, samples=tune.samples.copy())
    uses = [(tune, 1.5), (None, 9.0), (other, 3.0), (again, 2.5)]
    made, chosen = embed_sounds(uses)
    assert chosen == [0, None, 1, 0]
    assert [m["seconds"] for m in made] == [2.5, 1.0]
    slower = replace(tune, rate=tune.rate // 2)  # equal numbers at another rate are another sound
    assert embed_sounds([(tune, 1.0), (slower, 1.0)])[1] == [0, 1]


def test_score_keeps_what_lies_within_the_motion() -> None:
    beats = [1.0, -0.2, 0.5, 2.0, 2.5, 0.5]
    segments = [(0, 1.2, "walks"), Segment(1.2, 9.0, "song", "music"), (2.0, 3.0, "too late")]
    made = score_data(beats, segments, 2.0)
    assert made["beats"] == [0.5, 1.0, 2.0]
    assert made["segments"] == [(0.0, 1.2, "walks", "text"), (1.2, 2.0, "song", "music")]


def test_page_data_names_sounds_and_scores_by_number(
    tmp_path: Path, data_of: Make, song: Make, walk: Make
) -> None:
    tune = song(1.0)
    motions = [
        ViewerMotion(walk(20), 20, SMPLX.parents, "a", sound=tune, beats=[0.5]),
        ViewerMotion(walk(20), 20, SMPLX.parents, "b"),
        ViewerMotion(walk(20), 20, SMPLX.parents, "c", sound=tune, beats=np.array([0.5])),
        ViewerMotion(walk(20), 20, SMPLX.parents, "d", segments=[(0, 1, "</script>")]),
    ]
    write_viewer(tmp_path / "v.html", motions, "t")
    data = data_of(tmp_path / "v.html")
    assert [m.get("sound") for m in data["motions"]] == [0, None, 0, None]
    assert [m.get("score") for m in data["motions"]] == [0, None, 0, 1]
    assert [s["beats"] for s in data["scores"]] == [[0.5], []]
    assert data["scores"][1]["segments"] == [[0, 1, "</script>", "text"]]
    (sound,) = data["sounds"]
    assert soundfile.info(io.BytesIO(base64.b64decode(sound["data"]))).duration == pytest.approx(1, abs=0.05)


def test_only_pages_with_sound_allow_media_and_only_their_own(
    tmp_path: Path, data_of: Make, song: Make, walk: Make
) -> None:
    still = ViewerMotion(walk(5), 20, SMPLX.parents, "a", beats=[0.1])
    sounding = replace(still, sound=song(1.0))
    bare = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:"
    write_viewer(tmp_path / "a.html", [still], "t")
    write_viewer(tmp_path / "b.html", [sounding], "t")
    assert policy_of((tmp_path / "a.html").read_text("utf-8")) == bare
    assert policy_of((tmp_path / "b.html").read_text("utf-8")) == bare + "; media-src blob:"
    assert policy_of(Page("p").add_viewer([still]).html()) == bare
    assert (
        policy_of(Page("p").add_viewer([still]).add_viewer([sounding]).html()) == bare + "; media-src blob:"
    )
    write_viewer(tmp_path / "silent.html", [replace(still, beats=())], "t")
    silent = data_of(tmp_path / "silent.html")
    assert not {"sounds", "scores", "sound", "score"} & {*silent, *silent["motions"][0]}


# ---- from a generated motion to its files


@pytest.mark.slow
def test_a_motion_made_from_music_shows_its_beats(walk: Make) -> None:
    """Clicks twice a second; of a script, only beats of the stretches that music drove."""
    rate = 16_000
    clicks = np.zeros(8 * rate, np.float32)
    decay = np.exp(-np.arange(800) / 100).astype(np.float32)
    noise = np.random.default_rng(0).uniform(-1, 1, 800).astype(np.float32)
    for start in range(0, len(clicks), rate // 2):
        clicks[start : start + 800] = decay * noise
    layout = MotionLayout.named("tomato623")
    prompt = Prompt("a song", sound=Sound(clicks, rate))
    motion = GeneratedMotion(prompt, np.zeros((8, 1), np.float32), walk(8), None, layout)
    found = np.asarray(score_of(motion).beats)
    assert len(found) >= 10
    assert np.abs(found * 2 - np.round(found * 2)).max() / 2 < 0.06, "two frames of 30 a second"
    bands = (Segment(0, 4, "walks"), Segment(4, 8, "a song", "music"))
    part = np.asarray(score_of(replace(motion, segments=bands)).beats)
    np.testing.assert_array_equal(part, found[found >= 4])
    silent = GeneratedMotion(Prompt("walks"), motion.features, motion.joints, None, layout)
    assert score_of(silent) == Score()
