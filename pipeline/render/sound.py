"""Sound beside pictures: cut to a motion's length, compressed for a page.

Pages carry MP3 at a constant bit rate. Why this format **[ours]**:

* Every browser plays it: also Safari before 18.4, which has no Opus in Ogg, and Chromium built without AAC.
* A constant rate makes a seek exact: Chromium finds a place in an MP3 by arithmetic on the bytes, which is
  only right where all frames are equally long.
* The encoder's delay stands in its header, so players skip it: sample 0 is heard at 0 s, with frame 0.
"""

from __future__ import annotations

import base64
import hashlib
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.audio.sound import Sound, resample_sound
from motionloom.datasets.base.errors import UserError

RATE = 44_100
"""Hz of every sound written: one that MP3 and all players know, whatever rate the features asked for."""
BIT_RATE = 96_000
"""Bits a second in a page: transparent enough for mono, 0.7 MB a minute (0.96 MB as base64)."""
_BLOCK = 2**16


def embed_sounds(
    uses: Iterable[tuple[Sound | None, float]],
) -> tuple[list[dict[str, object]], list[int | None]]:
    """Each distinct sound once, as long as the longest motion that plays it; and which one each use plays.

    `uses` are motions: what each plays, and its seconds.
    """
    order: dict[tuple[float, bytes], int] = {}
    distinct: list[tuple[NDArray[np.float32], float]] = []
    chosen: list[int | None] = []
    for sound, seconds in uses:
        if sound is None:
            chosen.append(None)
            continue
        # By content, since clips cut from one piece bring equal copies of it.
        content = hashlib.sha256(np.ascontiguousarray(sound.samples).tobytes()).digest()
        number = order.setdefault((sound.rate, content), len(distinct))
        if number == len(distinct):
            distinct.append((playable(sound), seconds))
        samples, longest = distinct[number]
        distinct[number] = (samples, max(longest, seconds))
        chosen.append(number)
    sounds: list[dict[str, object]] = []
    for samples, seconds in distinct:
        part = samples[: round(seconds * RATE)]
        data = base64.b64encode(_mp3(part)).decode("ascii")
        sounds.append({"mime": "audio/mpeg", "seconds": len(part) / RATE, "data": data})
    return sounds, chosen


def playable(sound: Sound) -> NDArray[np.float32]:
    """Samples [S] of a sound at `RATE` Hz."""
    if not len(sound.samples):
        raise UserError("a sound without samples cannot be played; leave it out")
    return np.clip(resample_sound(sound.samples, sound.rate, RATE), -1.0, 1.0)


def _mp3(samples: NDArray[np.float32]) -> bytes:
    """MP3 of samples [S] at `BIT_RATE`."""
    import soundfile

    file = io.BytesIO()
    # libsndfile spreads its 0..1 evenly over MPEG-1's rates, 320 down to 32 kbit/s.
    level = (320_000 - BIT_RATE) / (320_000 - 32_000)
    with soundfile.SoundFile(
        file,
        "w",
        samplerate=RATE,
        channels=1,
        format="MP3",
        subtype="MPEG_LAYER_III",
        bitrate_mode="CONSTANT",
        compression_level=level,
    ) as out:
        for start in range(0, len(samples), _BLOCK):
            out.write(samples[start : start + _BLOCK])
    return file.getvalue()


# The time line of a motion: its sound, its beats, and what drives it when.

Driver = Literal["text", "music"]


class Segment(NamedTuple):
    """A stretch of a motion in seconds and what drives it: words, or the name of the music."""

    start: float
    end: float
    label: str
    kind: Driver = "text"


Segments = Sequence[Segment | tuple[float, float, str]]
"""Plain triples are text segments."""


@dataclass(frozen=True)
class Score:
    """Sound, beats and segments on the time line of one motion, in seconds from frame 0."""

    sound: Sound | None = None
    beats: Sequence[float] = ()
    segments: Segments = ()


def score_data(beats: Sequence[float], segments: Segments, seconds: float) -> dict[str, object]:
    """`beats` in seconds and `segments` [start, end, label, kind] as plain JSON types, up to `seconds`."""
    times = np.asarray(beats, np.float64)
    bands = [
        (float(start), min(float(end), seconds), label, kind)
        for start, end, label, kind in (Segment(*s) for s in segments)
        if start < seconds
    ]
    inside = np.unique(times[(times >= 0) & (times <= seconds)])
    return {"beats": [round(float(t), 4) for t in inside], "segments": bands}
