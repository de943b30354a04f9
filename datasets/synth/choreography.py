"""Dances to songs: legs, arms, hands and face by the genre, every pose on a beat of the music.

Between two beats the body eases from pose to pose with a minimum-jerk curve, which has no speed at its ends:
every beat is a minimum of the body's speed, which is what Beat Align looks for (UDE section 4.3). The first
beat of a bar is always down and to the left, the section of the song picks the pair of arm poses, and hands
and face are at their strongest on the first beat of a bar, so that all of it can be heard. Size, posture and
whether the arms go together are the dancer's own.
"""

from __future__ import annotations

import numpy as np

from motionloom.datasets.synth.arms import Hold, play
from motionloom.datasets.synth.dance import side_steps
from motionloom.datasets.synth.face import express_with
from motionloom.datasets.synth.hands import grip_hand
from motionloom.datasets.synth.maths import Array, keys
from motionloom.datasets.synth.pose import Track
from motionloom.datasets.synth.song import BEATS, Song

_LEGS = {
    # Metres aside and down, radians of the pelvis' roll and of the spine's twist.
    "step": (0.0, 0.05, 0.05, 0.2),
    "bounce": (0.0, 0.13, 0.0, 0.1),
    "sway": (0.1, 0.045, 0.09, 0.25),
}
_STEP = 0.13
"""Metres to either side."""


def choreograph(song: Song, start: float, frames: int, fps: float, rng: np.random.Generator) -> Track:
    """A dance of `frames` frames to the music from `start` seconds of a song on."""
    genre = song.style
    track = Track.standing(frames / fps, fps, rng, width=rng.uniform(0.0, 0.05))
    first = beat_number(song, start)
    numbers = np.arange(first - first % BEATS - BEATS, first + int(frames / fps / song.beat) + 3)
    beats: Array = np.asarray(numbers * song.beat - start, dtype=np.float64)
    track.first_beat = float(first * song.beat - start)
    amount = rng.uniform(0.85, 1.15)
    aside, down, roll, twist = (amount * value for value in _LEGS[genre.style])
    turns = np.where(numbers % 2 == 0, 1.0, -1.0)
    side = keys(track.t, beats, turns)
    if genre.style == "step":
        side_steps(track, beats, song.beat, _STEP * amount)
    track.root[:, 0] += aside * side
    track.root[:, 1] -= 0.03 + down * (0.5 + 0.5 * side)
    track.pelvis[:, 2] += roll * side
    track.spine[:, 2] -= 2.0 * roll * side
    track.spine[:, 1] += twist * side
    # The head nods deeper where a bar begins.
    nods = np.where(numbers % BEATS == 0, 1.0, np.where(numbers % 2 == 0, 0.6, 0.0))
    track.head[:, 0] += rng.uniform(0.12, 0.2) * keys(track.t, beats, nods)
    track.knee_out += 0.1 * (0.5 + 0.5 * side)
    together = rng.random() < 0.5
    for hand in (0, 1):
        holds: list[Hold] = []
        for number, at in zip(numbers.tolist(), beats.tolist(), strict=True):
            pair = genre.arms[song.section(number)]
            even = (number % 2 == 0) != (hand == 1 and not together)
            holds.append((at, *pair[1 if even else 0]))
        play(track, hand, holds)
    track.lower_to_reach(0.5 / fps)
    return track


def dancing_hands(song: Song, start: float, t: Array, rng: np.random.Generator) -> Array:
    """Finger rotations [2, T, 15, 3, 3]: the genre's hand shape, loosened in the second half of each bar."""
    shape = song.style.hand
    grip = accents(song, start, t, 1.0, 0.7)
    hands = [grip_hand(shape, t, grip, rng) for _ in (0, 1)]
    return np.stack(hands)


def dancing_face(song: Song, start: float, t: Array, rng: np.random.Generator) -> Array:
    """Expression values [T, 50]: the genre's emotion, lighting up where a bar begins."""
    return express_with(song.style.face, t, rng.uniform(0.9, 1.1) * accents(song, start, t, 1.1, 0.5), rng)


def accents(song: Song, start: float, t: Array, high: float, low: float) -> Array:
    """A curve [T]: `high` on the first beat of each bar, falling to `low` on the third, and back."""
    end = start + float(t[-1])
    bar = BEATS * song.beat
    halves = np.arange(int(np.floor(start / bar)) * 2, int(np.ceil(end / bar)) * 2 + 2)
    at = np.asarray(halves * (bar / 2), dtype=np.float64)
    return keys(t + start, at, np.where(halves % 2 == 0, high, low))


def beat_number(song: Song, start: float) -> int:
    """Number of the first beat at or after `start` seconds."""
    return int(np.ceil(start / song.beat - 1e-9))
