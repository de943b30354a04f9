"""Audio of the dances: a click on every beat over chords that change with the bar, at a known tempo."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SAMPLE_RATE = 16_000
_CHORDS = ((0, 4, 7), (9, 12, 16), (5, 9, 12), (7, 11, 14), (2, 5, 9), (4, 7, 11))
"""Triads in semitones above the key note: I, vi, IV, V, ii, iii."""


def beat_times(bpm: float, offset: float, seconds: float) -> NDArray[np.float64]:
    """Times of the beats that lie inside the clip."""
    beat = 60.0 / bpm
    times = offset + beat * np.arange(-1, int(seconds / beat) + 2)
    return np.asarray(times[(times >= 0) & (times < seconds)], dtype=np.float64)


def render(bpm: float, offset: float, seconds: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """Mono float32 audio [seconds * SAMPLE_RATE] in -1..1 whose first beat is at `offset` seconds."""
    total = round(seconds * SAMPLE_RATE)
    beat = 60.0 / bpm
    t = np.arange(total) / SAMPLE_RATE
    out = np.zeros(total)
    key = 110.0 * 2 ** (rng.integers(0, 12) / 12)
    progression = rng.permutation(len(_CHORDS))[:4]
    bars = np.arange(-1, int(seconds / (4 * beat)) + 1)
    for bar in bars:
        begin = offset + 4 * beat * bar
        a, b = (int(np.clip(round(x * SAMPLE_RATE), 0, total)) for x in (begin, begin + 4 * beat))
        if a >= b:
            continue
        local = t[a:b] - begin
        # The chord swells a little with each beat so that it carries the tempo as well.
        swell = np.exp(-1.5 * ((local / beat) % 1.0)) * np.minimum(1.0, (4 * beat - local) / 0.02)
        for note in _CHORDS[progression[bar % 4]]:
            tone = key * 2 ** (note / 12)
            wave = np.sin(2 * np.pi * tone * local) + 0.3 * np.sin(4 * np.pi * tone * local)
            out[a:b] += 0.07 * swell * wave
    length = int(0.06 * SAMPLE_RATE)
    decay = np.exp(-np.arange(length) / (0.012 * SAMPLE_RATE))
    for k, at in enumerate(beat_times(bpm, offset, seconds)):
        pitch = 1600.0 if k % 4 == 0 else 1100.0
        click = np.sin(2 * np.pi * pitch * np.arange(length) / SAMPLE_RATE) + 0.5 * rng.standard_normal(
            length
        )
        a = round(at * SAMPLE_RATE)
        part = min(length, total - a)
        out[a : a + part] += 0.45 * (decay * click)[:part]
    return np.clip(out, -1.0, 1.0).astype(np.float32)
