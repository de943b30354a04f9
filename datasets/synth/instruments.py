"""The sounds that songs are made of: drums, a bass and chords, all synthesised, at any sample rate.

Every function returns float64 samples of one stroke or one note, about 1 at its loudest. Bars repeat, so the
last notes are kept; they are not to be changed.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from motionloom.datasets.synth.genres import Wave
from motionloom.datasets.synth.maths import Array

_PARTIALS: dict[str, tuple[float, ...]] = {
    # Strength of the harmonics 1, 2, 3, ...
    "saw": tuple(1 / k for k in range(1, 13)),
    "square": tuple((1 / k if k % 2 else 0.25 / k) for k in range(1, 16)),
    "organ": (1.0, 0.9, 0.1, 0.6, 0.0, 0.3, 0.0, 0.4),
    "string": (1.0, 0.45, 0.3, 0.12, 0.08),
    "bell": (1.0, 0.05, 0.5, 0.02, 0.3, 0.0, 0.15),
}
_DECAY: dict[str, float] = {"saw": 3.0, "square": 1.2, "organ": 0.4, "string": 0.8, "bell": 5.0}
"""How fast a note fades, 1 / seconds."""
_ATTACK: dict[str, float] = {"saw": 0.005, "square": 0.003, "organ": 0.01, "string": 0.03, "bell": 0.002}
"""Seconds to the loudest."""

_KEPT = 96
"""Notes: the four chords of a section, with their bass and upper voice."""


def kick(rate: int) -> Array:
    """A bass drum: a tone that falls from 150 to 50 Hz, with a click in front."""
    t = np.arange(int(0.25 * rate)) / rate
    phase = 2 * np.pi * (50 * t + (100 / 30) * (1 - np.exp(-30 * t)))
    return np.asarray(np.sin(phase) * np.exp(-11 * t) + 0.35 * np.exp(-400 * t))


def snare(rate: int, rng: np.random.Generator) -> Array:
    """A snare drum: a short tone under a burst of noise."""
    t = np.arange(int(0.2 * rate)) / rate
    noise = rng.standard_normal(len(t))
    return np.asarray(0.5 * np.sin(2 * np.pi * 185 * t) * np.exp(-25 * t) + 0.4 * noise * np.exp(-20 * t))


def hat(rate: int, rng: np.random.Generator) -> Array:
    """A closed hi-hat: very short noise without low frequencies."""
    t = np.arange(int(0.06 * rate)) / rate
    noise = np.diff(np.diff(rng.standard_normal(len(t) + 2)))
    return np.asarray(0.3 * noise * np.exp(-70 * t))


def tick(rate: int, rng: np.random.Generator, high: bool) -> Array:
    """A wood block that counts the beats, audible in all bands; `high` on the first beat of a bar."""
    t = np.arange(int(0.07 * rate)) / rate
    tone = np.sin(2 * np.pi * (1600.0 if high else 1100.0) * t)
    return np.asarray(0.5 * tone * np.exp(-60 * t) + 0.5 * rng.standard_normal(len(t)) * np.exp(-90 * t))


@lru_cache(maxsize=_KEPT)
def bass(rate: int, hertz: float, seconds: float) -> Array:
    """A bass note: few harmonics, a soft start, a fading end."""
    t = np.arange(max(2, int(seconds * rate))) / rate
    wave = sum(
        strength * np.sin(2 * np.pi * hertz * (k + 1) * t) for k, strength in enumerate((1.0, 0.5, 0.2, 0.08))
    )
    return np.asarray(wave * _envelope(t, 0.006, 2.5))


@lru_cache(maxsize=_KEPT)
def note(rate: int, wave: Wave, hertz: float, seconds: float) -> Array:
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


def equalize(sound: Array, rate: int, decibels: tuple[float, float, float]) -> Array:
    """Low, middle and high bands (edges at 250 Hz and 2.5 kHz) of samples made louder by `decibels`."""
    from scipy import signal

    edges = [signal.butter(1, hertz, fs=rate, output="sos") for hertz in (250.0, 2500.0)]
    low, below = (np.asarray(signal.sosfilt(edge, sound)) for edge in edges)
    bands = (low, below - low, sound - below)
    return sum((10 ** (gain / 20) * band for gain, band in zip(decibels, bands, strict=True)), np.zeros(1))


def _envelope(t: Array, attack: float, decay: float) -> Array:
    """Rise, fade, and silence at the end, so that notes do not click."""
    end = t[-1]
    return np.asarray(np.minimum(1.0, t / attack) * np.exp(-decay * t) * np.minimum(1.0, (end - t) / 0.008))
