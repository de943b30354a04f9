"""Sound, beats and segments in pages, without a browser."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile

from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.contract.generation import Prompt
from motionloom.pipeline.inference.motion import GeneratedMotion
from motionloom.pipeline.inference.outputs import score_of
from motionloom.pipeline.render.page import Page
from motionloom.pipeline.render.sound import RATE, Score, Segment, embed_sounds, playable, score_data
from motionloom.pipeline.render.viewer import ViewerMotion, write_viewer

SMPLX = Skeleton.named("smplx52")
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
