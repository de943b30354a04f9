"""Parts of sound files by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import soundfile

from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.schema import UserError

RATE = 8000


@pytest.fixture
def song(tmp_path: Path) -> Path:
    """100 s whose samples say where they are."""
    path = tmp_path / "song.flac"
    soundfile.write(path, np.arange(100 * RATE) / (100 * RATE), RATE, subtype="PCM_24")
    return path


@pytest.mark.parametrize(
    ("part", "start", "end"),
    [
        ("0:30-1:00", 30, 60),
        ("45-", 45, 100),
        ("-1:20", 0, 80),
        ("1.5-2.25", 1.5, 2.25),
        ("0:00:10-0:01:00.5", 10, 60.5),
        ("90-100.4", 90, 100),
    ],
)
def test_start_and_end(song: Path, part: str, start: float, end: float) -> None:
    sound = Sound.read(f"{song}@{part}")
    assert sound.seconds == pytest.approx(end - start)
    assert sound.samples[0] * 100 == pytest.approx(start, abs=1e-3)
    assert sound.piece is not None and sound.piece.seconds == 100, "features are those of the whole piece"


@pytest.mark.parametrize(
    ("part", "fix"),
    [
        ("60-30", "swap them"),
        ("1:75-", "m:ss"),
        ("1.2.3-", "m:ss"),
        ("30", "0:30-1:00"),
        ("-", "0:30-1:00"),
        ("200-", "100.0 s long"),
        ("20-200", "100.0 s long"),
    ],
)
def test_mistakes_name_the_file_and_the_fix(song: Path, part: str, fix: str) -> None:
    with pytest.raises(UserError, match=fix) as caught:
        Sound.read(f"{song}@{part}")
    assert f"song.flac@{part}" in str(caught.value)


def test_a_file_with_that_very_name_is_taken_whole(song: Path) -> None:
    named = song.rename(song.parent / "me@0:10-0:20")
    assert Sound.read(named).seconds == 100
    assert Sound.read(f"{named}@10-30").seconds == 20


def test_what_is_not_read_says_how_to_convert_it(tmp_path: Path) -> None:
    path = tmp_path / "song.m4a"
    path.write_bytes(b"\0\0\0\x1cftypM4A \0\0\2\0" + bytes(4000))
    with pytest.raises(UserError, match=r"song\.m4a: .*ffmpeg"):
        Sound.read(path)
