"""The built-in band: synthesised drums, a bass and chords, which play a song without anything installed.

Every beat can be heard in every genre, and which of them begins a bar.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.synth.actions.maths import Array
from motionloom.datasets.synth.music.genres import Wave
from motionloom.datasets.synth.music.song import BEATS, Song

_LEVEL = {"x": 1.0, "o": 0.45}


def synthesize(song: Song, rate: int) -> NDArray[np.float32]:
    """The whole song as mono samples [seconds * rate] in -1..1; the same bytes each time."""
    total = round(song.seconds * rate)
    rng = np.random.default_rng([song.seed, song.number, 229])
    genre = song.style
    out = np.zeros(total + rate)
    drums = (
        (genre.kick, _kick(rate), 0.55),
        (genre.snare, _snare(rate, rng), 0.4),
        (genre.hat, _hat(rate, rng), 0.2),
        # Every beat can be heard in every genre, and which of them begins a bar.
        ("x...............", _tick(rate, rng, high=True), 0.5),
        ("....x...x...x...", _tick(rate, rng, high=False), 0.4),
    )
    bars = int(np.ceil(song.seconds / (BEATS * song.beat)))
    sixteenth = song.beat / 4
    for bar in range(bars):
        kind = song.section_of(bar * BEATS).kind
        begin = bar * BEATS * song.beat
        for pattern, sound, loud in drums:
            for step, level in _hits(pattern):
                _add(out, round((begin + step * sixteenth) * rate), sound, loud * level)
        if kind:  # B is denser: an open hat between the beats
            for step in (2, 6, 10, 14):
                _add(out, round((begin + step * sixteenth) * rate), drums[2][1], 0.1)
        degree = genre.progressions[kind][bar % 4]
        _harmony(out, song, degree, kind, begin, rate)
    out = out[:total] + genre.air * rng.standard_normal(total)
    out = equalize(out, rate, genre.tone)
    # A soft limiter; driven hard it is the distortion of rock.
    out = 0.95 * np.tanh(genre.drive * out)
    return np.asarray(out, dtype=np.float32)


def equalize(sound: Array, rate: int, decibels: tuple[float, ...]) -> Array:
    """Low, middle and high bands (edges at 250 Hz and 2.5 kHz) of samples made louder by `decibels`."""
    from scipy import signal

    edges = [signal.butter(1, hertz, fs=rate, output="sos") for hertz in (250.0, 2500.0)]
    low, below = (np.asarray(signal.sosfilt(edge, sound)) for edge in edges)
    bands = (low, below - low, sound - below)
    return sum((10 ** (gain / 20) * band for gain, band in zip(decibels, bands, strict=True)), np.zeros(1))


def _harmony(out: Array, song: Song, degree: int, kind: int, begin: float, rate: int) -> None:
    """Bass, chord and, in section B, an upper voice of one bar that begins at `begin` seconds."""
    genre = song.style
    sixteenth = song.beat / 4
    root = 55.0 * 2 ** ((song.key + genre.semitones(degree)) / 12)
    for place, (step, gap, level) in enumerate(_notes(genre.bass)):
        # Octaves in turn are what makes a disco bass.
        up = 2.0 if genre.name == "disco" and place % 2 else 1.0
        sound = _bass(rate, root * up, min(gap, 8) * sixteenth)
        _add(out, round((begin + step * sixteenth) * rate), sound, 0.34 * level)
    base = 110.0 * 2 ** (genre.octave + song.key / 12 - (1.0 if song.key > 6 else 0.0))
    tones = [base * 2 ** (genre.semitones(degree + third) / 12) for third in (0, 2, 4)]
    for place, (step, gap, level) in enumerate(_notes(genre.chord)):
        at = round((begin + step * sixteenth) * rate)
        # A ballad breaks its chords, the others strike them.
        chosen = [tones[place % 3]] if genre.name == "ballad" else tones
        for hertz in chosen:
            loud = (0.5 if len(chosen) == 1 else 0.26) * level
            _add(out, at, _note(rate, genre.wave, hertz, gap * sixteenth), loud)
    if kind:
        for beat in range(BEATS):
            hertz = 2 * tones[beat % 3]
            sound = _note(rate, genre.wave, hertz, song.beat)
            _add(out, round((begin + beat * song.beat) * rate), sound, 0.2)


def _hits(pattern: str) -> list[tuple[int, float]]:
    return [(step, _LEVEL[sign]) for step, sign in enumerate(pattern) if sign != "."]


def _notes(pattern: str) -> list[tuple[int, int, float]]:
    """(sixteenth, sixteenths to the next note, level) of a bar's notes."""
    hits = _hits(pattern)
    ends = [*(step for step, _ in hits[1:]), 16]
    return [(step, end - step, level) for (step, level), end in zip(hits, ends, strict=True)]


def _add(out: Array, at: int, sound: Array, level: float) -> None:
    end = min(len(out), at + len(sound))
    if at < end:
        out[at:end] += level * sound[: end - at]


# ---- instruments: float64 samples of one stroke or one note, about 1 at its loudest. Bars repeat, so the
# last notes are cached; they must not be changed.

_PARTIALS: dict[str, tuple[float, ...]] = {
    # Strength of the harmonics 1, 2, 3, ...
    "saw": tuple(1 / k for k in range(1, 13)),
    "square": tuple((1 / k if k % 2 else 0.25 / k) for k in range(1, 16)),
    "organ": (1.0, 0.9, 0.1, 0.6, 0.0, 0.3, 0.0, 0.4),
    "string": (1.0, 0.45, 0.3, 0.12, 0.08),
    "bell": (1.0, 0.05, 0.5, 0.02, 0.3, 0.0, 0.15),
}
_DECAY: dict[str, float] = {"saw": 3.0, "square": 1.2, "organ": 0.4, "string": 0.8, "bell": 5.0}
"""Rate at which a note fades, 1 / seconds."""
_ATTACK: dict[str, float] = {"saw": 0.005, "square": 0.003, "organ": 0.01, "string": 0.03, "bell": 0.002}
"""Seconds to the loudest."""

_KEPT = 96
"""Notes: the four chords of a section, with their bass and upper voice."""


def _kick(rate: int) -> Array:
    """A bass drum: a tone that falls from 150 to 50 Hz, with a click in front."""
    t = np.arange(int(0.25 * rate)) / rate
    phase = 2 * np.pi * (50 * t + (100 / 30) * (1 - np.exp(-30 * t)))
    return np.asarray(np.sin(phase) * np.exp(-11 * t) + 0.35 * np.exp(-400 * t))


def _snare(rate: int, rng: np.random.Generator) -> Array:
    """A snare drum: a short tone under a burst of noise."""
    t = np.arange(int(0.2 * rate)) / rate
    noise = rng.standard_normal(len(t))
    return np.asarray(0.5 * np.sin(2 * np.pi * 185 * t) * np.exp(-25 * t) + 0.4 * noise * np.exp(-20 * t))


def _hat(rate: int, rng: np.random.Generator) -> Array:
    """A closed hi-hat: very short noise without low frequencies."""
    t = np.arange(int(0.06 * rate)) / rate
    noise = np.diff(np.diff(rng.standard_normal(len(t) + 2)))
    return np.asarray(0.3 * noise * np.exp(-70 * t))


def _tick(rate: int, rng: np.random.Generator, high: bool) -> Array:
    """A wood block that counts the beats, audible in all bands; `high` on the first beat of a bar."""
    t = np.arange(int(0.07 * rate)) / rate
    tone = np.sin(2 * np.pi * (1600.0 if high else 1100.0) * t)
    return np.asarray(0.5 * tone * np.exp(-60 * t) + 0.5 * rng.standard_normal(len(t)) * np.exp(-90 * t))


@lru_cache(maxsize=_KEPT)
def _bass(rate: int, hertz: float, seconds: float) -> Array:
    """A bass note: few harmonics, a soft start, a fading end."""
    t = np.arange(max(2, int(seconds * rate))) / rate
    wave = sum(
        strength * np.sin(2 * np.pi * hertz * (k + 1) * t) for k, strength in enumerate((1.0, 0.5, 0.2, 0.08))
    )
    return np.asarray(wave * _envelope(t, 0.006, 2.5))


@lru_cache(maxsize=_KEPT)
def _note(rate: int, wave: Wave, hertz: float, seconds: float) -> Array:
    """A note of a chord instrument; harmonics above half the sample rate are left out."""
    t = np.arange(max(2, int(seconds * rate))) / rate
    out = np.zeros(len(t))
    # Multiples of one rotation: one sine and one cosine for all harmonics.
    turn = np.exp(2j * np.pi * hertz * t)
    harmonic = np.ones(len(t), dtype=np.complex128)
    for k, strength in enumerate(_PARTIALS[wave], start=1):
        if k * hertz >= 0.45 * rate:
            break
        harmonic *= turn
        if strength:
            out += strength * harmonic.imag
    return out * _envelope(t, _ATTACK[wave], _DECAY[wave]) / sum(_PARTIALS[wave])


def _envelope(t: Array, attack: float, decay: float) -> Array:
    """Rise, fade, and silence at the end, so that notes do not click."""
    end = t[-1]
    return np.asarray(np.minimum(1.0, t / attack) * np.exp(-decay * t) * np.minimum(1.0, (end - t) / 0.008))
