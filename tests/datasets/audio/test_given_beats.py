"""Beats that somebody gives a song stand in place of those that are heard, in features of either kind."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import soundfile

from motionloom.datasets.audio.features import BEAT, features_of
from motionloom.datasets.audio.given_beats import in_words, take_beats, with_beats
from motionloom.datasets.audio.rhythm_features import RHYTHM_DIM, beats_of_rows
from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.audio.tracker import track
from motionloom.datasets.base.errors import UserError

RATE = 16_000


@pytest.fixture(scope="module")
def song() -> Sound:
    """Clicks at 120 beats a minute from second .25 on."""
    samples = 0.001 * np.random.default_rng(0).standard_normal(12 * RATE)
    for beat in np.arange(0.25, 11.9, 0.5):
        at = round(beat * RATE)
        samples[at : at + 400] += 0.5 * np.exp(-np.arange(400) / 80) * np.sin(np.arange(400))
    return Sound(samples.astype(np.float32), RATE)


@pytest.mark.parametrize(
    ("said", "first", "step"),
    [("90@0.4", 0.4, 2 / 3), ("120@1.5", 0.0, 0.5), ("1 2 3 4\n5", 1.0, 1.0), ("[0.5, 1.25, 2.0]", 0.5, 0.75),
     ('{"beats": [2, 2.5, 3]}', 2.0, 0.5), ("shift", 0.5, 0.5), ("half", 0.25, 1.0), ("double", 0.25, 0.25)],
)  # fmt: skip
def test_what_is_said_is_what_is_danced_to(song: Sound, said: str, first: float, step: float) -> None:
    given = with_beats(song, said)
    times = track(given).times
    assert times[0] == pytest.approx(first, abs=0.03) and np.diff(times) == pytest.approx(step, abs=0.03)
    assert "as given" in in_words(given) and track(given).confidence == 1.0 and song.beats is None
    found = beats_of_rows(features_of(given, 20.0, RHYTHM_DIM), 20.0)
    inside = found[(found > times[0] - 0.01) & (found < times[-1] + 0.01)]
    assert inside == pytest.approx(times[: len(inside)], abs=0.03)
    # A part of a song has the song's beats, by its own clock.
    part = take_beats(song.slice(2.0, 6.0), "song.wav", said)
    marked = np.flatnonzero(features_of(part, 20.0)[:, BEAT]) / 20 + 2.0
    assert marked == pytest.approx(times[(times >= 1.975) & (times < 5.975)], abs=0.05)


def test_beats_beside_a_song_are_taken_and_others_before_them(song: Sound, tmp_path: Path) -> None:
    file = tmp_path / "song.wav"
    soundfile.write(file, song.samples, RATE)
    (tmp_path / "song.beats").write_text("0.1\n0.7\n1.3\n")
    assert take_beats(Sound.read(file), file).beats == pytest.approx([0.1, 0.7, 1.3])
    part = f"{file}@0:01-0:05"
    assert take_beats(Sound.read(part), part).piece.beats == pytest.approx([0.1, 0.7, 1.3])  # type: ignore[union-attr]
    (tmp_path / "mine.json").write_text("[1, 2, 3]")
    assert take_beats(Sound.read(file), file, str(tmp_path / "mine.json")).beats == pytest.approx([1, 2, 3])
    (tmp_path / "song.beats").unlink()
    assert take_beats(song, file) is song


@pytest.mark.parametrize(
    "said", ["3", "2 1", "nan 1", "a.txt", "{}", "[[1, 2]]", "30 31", "1000@0", "1 1.01 1.02", "{", "1e9 2e9"]
)
def test_what_are_no_beats_of_the_song_is_named(song: Sound, said: str) -> None:
    with pytest.raises(UserError, match="mine"):
        with_beats(song, said, "mine")
