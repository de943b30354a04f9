"""Figures and music in step, and the time line, in a real headless Chromium."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.render.page import Page
from motionloom.pipeline.render.sound import Segment
from motionloom.pipeline.render.viewer import ViewerMotion, write_viewer

PARENTS = Skeleton.named("smplx52").parents
FPS = 20
NASTY = "</script><img src=x onerror='window.hacked=1'>"
SCRIPT = [(0, 2, "a person walks"), Segment(2, 5, "song 04", "music"), Segment(5, 8, NASTY)]
Make = Callable[..., Any]

pytestmark = pytest.mark.browser


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
    """Return what is drawn and heard, `count` times or for 1.5 s, right after the page has drawn.

    `frame` is the number written on the figure; `late` the seconds since the browser began this drawing:
    the sound has gone on for that long, at most, since the page looked at its clock.
    """
    return page.evaluate(
        """([count, gap]) => new Promise((done) => {
            const out = [], end = performance.now() + 1500, more = requestAnimationFrame; let k = 0;
            const look = (start) => {
                const frame = parseInt(document.querySelector(".mlv-count").textContent) - 1;
                const audio = __viewer.audio;
                if (k++ % gap === 0) out.push({
                    frame, time: __viewer.time, heard: audio.currentTime, rate: audio.playbackRate,
                    late: (performance.now() - start) / 1000, paused: audio.paused,
                });
                if (out.length < count && performance.now() < end) more(look); else done(out);
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
    # Far from the end, where a slow machine would hear the beginning again.
    page.evaluate("__viewer.setFrame(60)")
    until(page, "!__viewer.audio.seeking && __viewer.audio.currentTime > 3.05")
    seen = moments(page)
    assert seen[0]["heard"] > 3.0
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
