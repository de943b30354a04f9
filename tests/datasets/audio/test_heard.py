"""Music, silence, speech and noise are told apart."""

from __future__ import annotations

import numpy as np
import pytest

from motionloom.datasets.audio.heard import heard
from motionloom.datasets.audio.sound import Sound

RATE, SECONDS = 16_000, 12
TIME = np.arange(SECONDS * RATE) / RATE


def drums(rng: np.random.Generator) -> np.ndarray:
    """Noise that is struck twice a second."""
    return np.asarray(rng.standard_normal(len(TIME)) * np.exp(-(TIME % 0.5) / 0.05))


def chords(rng: np.random.Generator) -> np.ndarray:
    """Notes of two to three seconds, without a beat."""
    out, at = np.zeros(len(TIME)), 0.0
    while at < SECONDS:
        length = rng.uniform(2, 3)
        here = (at <= TIME) & (at + length > TIME)
        for note in rng.choice([220, 262, 330, 392, 440], 3):
            out += here * np.sin(2 * np.pi * note * TIME)
        at += length
    return out


def words(rng: np.random.Generator) -> np.ndarray:
    """Syllables of uneven length, of a gliding voice between two formants, with pauses."""
    loud, pitch, at = np.zeros(len(TIME)), np.full(len(TIME), 120.0), 0.0
    tone = rng.uniform(400, 2500, (2, 1)) * np.ones(len(TIME))
    while at < SECONDS:
        length = rng.uniform(0.1, 0.28)
        here = (at <= TIME) & (at + length > TIME)
        place = (TIME[here] - at) / length
        loud[here] = np.sin(np.pi * place) ** 2 * rng.uniform(0.4, 1)
        pitch[here] = rng.uniform(95, 150) * (1 + rng.uniform(-0.25, 0.25) * place)
        tone[:, here] = rng.uniform([[300], [1000]], [[800], [2500]])
        at += length + (rng.uniform(0.3, 0.7) if rng.random() < 0.15 else rng.uniform(0.0, 0.05))
    phase = 2 * np.pi * np.cumsum(pitch) / RATE
    out = np.zeros(len(TIME))
    for number in range(1, 30):
        near = np.exp(-(((number * pitch - tone) / 150) ** 2)).sum(axis=0) + 0.02
        out += near * np.sin(number * phase)
    return np.asarray(loud * out)


def noise(rng: np.random.Generator) -> np.ndarray:
    return np.asarray(rng.standard_normal(len(TIME)))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("make", "kind"), [(drums, "music"), (chords, "music"), (words, "speech"), (noise, "noise")]
)
@pytest.mark.parametrize("loud", [0.5, 0.02])
def test_kinds(make: object, kind: str, seed: int, loud: float) -> None:
    assert callable(make)
    samples = make(np.random.default_rng(seed))
    found = heard(Sound((loud * samples / np.abs(samples).max()).astype(np.float32), RATE))
    assert found.kind == kind and bool(found.sentence) == (kind != "music")


@pytest.mark.parametrize("seconds", [0.1, 5.0])
@pytest.mark.parametrize("loud", [0.0, 1e-4])
def test_silence(seconds: float, loud: float) -> None:
    samples = loud * np.random.default_rng(0).standard_normal(round(seconds * RATE))
    assert heard(Sound(samples.astype(np.float32), RATE)).kind == "silence"


def test_what_is_too_short_to_tell_is_music() -> None:
    samples = 0.1 * np.random.default_rng(0).standard_normal(RATE)
    assert heard(Sound(np.clip(samples, -1, 1).astype(np.float32), RATE)).kind == "music"
