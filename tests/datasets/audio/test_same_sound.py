"""One piece in several files is found, whatever was done to the file; other pieces are not."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import soundfile

from motionloom.datasets.audio.same_sound import NO_LANDMARKS, landmarks, same_pieces
from motionloom.datasets.audio.sound import Sound


def packed(sound: Sound) -> Sound:
    with io.BytesIO() as file:
        soundfile.write(file, sound.samples, sound.rate, format="MP3")
        file.seek(0)
        samples, rate = soundfile.read(file, dtype="float32")
    return Sound(np.clip(samples, -1, 1), rate)


def noisy(sound: Sound) -> Sound:
    loud = np.sqrt(np.square(sound.samples).mean())
    noise = np.random.default_rng(0).normal(0, 0.1 * loud, len(sound.samples))
    return Sound(np.clip(sound.samples + noise, -1, 1).astype(np.float32), sound.rate)


@pytest.mark.parametrize(
    "changed",
    [
        packed,
        noisy,
        lambda sound: Sound(0.2 * sound.samples, sound.rate),
        lambda sound: sound.resampled(16_000),
        lambda sound: sound.slice(11.03, 29.5),
    ],
    ids=["mp3", "noise", "quiet", "rate", "part"],
)
def test_one_piece_in_two_files(shared: Path, changed: Callable[[Sound], Sound]) -> None:
    songs = {
        path.stem: Sound.read(path).slice(0, 40) for path in sorted((shared / "data/music").glob("*.ogg"))
    }
    known = {name: landmarks(song) for name, song in songs.items()}
    assert same_pieces(known) == []
    again = changed(songs["calmrace-ks"])
    assert same_pieces({**known, "again": landmarks(Sound(again.samples, again.rate))}) == [
        ("calmrace-ks", "again")
    ]


def test_silence_is_no_piece() -> None:
    silence = landmarks(Sound(np.zeros(80_000, np.float32), 8000))
    assert same_pieces({"a": silence, "b": silence, "c": NO_LANDMARKS}) == []
    assert same_pieces({}) == []
