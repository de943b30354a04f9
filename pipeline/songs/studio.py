"""Played songs: the band's dry music goes through rooms, equalisers, compression, noise, gain and coding."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.register import register
from motionloom.datasets.synth.actions.maths import Array
from motionloom.datasets.synth.music.recording import PLAYED, SongPlayer
from motionloom.datasets.synth.music.song import Song
from motionloom.datasets.synth.music.synthesizer import equalize
from motionloom.pipeline.songs.band import band_version, play_band

_CODECS = (("OGG", "VORBIS"), ("MP3", "MPEG_LAYER_III"))


def play(song: Song, rate: int) -> NDArray[np.float32]:
    """The song as a band plays and a studio records it: mono samples [seconds * rate] in -1..1."""
    return record(play_band(song, rate), rate, np.random.default_rng([song.seed, song.number, 257]))


def record(
    dry: NDArray[np.float32], rate: int, rng: np.random.Generator, coded: bool = True
) -> NDArray[np.float32]:
    """Dry samples [n], loudest 1 -> a recording of them [n] in -1..1, at the same times.

    Each step is drawn, the last one, a lossy codec, only where `coded`; none moves a beat by more than the
    room's first reflections.
    """
    out = np.asarray(dry, dtype=np.float64)
    if rng.random() < 0.6:
        out = _room(out, rate, rng)
    if rng.random() < 0.7:
        out = equalize(out, rate, tuple(rng.uniform(-9.0, 6.0, 3)))
    if rng.random() < 0.6:  # a compressor, or the distortion of one that is driven hard
        drive = float(np.exp(rng.uniform(0.0, 2.3)))
        out = np.tanh(drive * out) / np.tanh(drive)
    if rng.random() < 0.4:
        out = out + 10 ** (rng.uniform(-60, -30) / 20) * rng.standard_normal(len(out))
    gain = 10 ** (rng.uniform(-20.0, 0.0) / 20)
    out = gain * out / max(1e-9, float(np.abs(out).max()))
    samples = np.asarray(np.clip(out, -1.0, 1.0), dtype=np.float32)
    return _coded(samples, rate, rng) if coded and rng.random() < 0.5 else samples


def _room(sound: Array, rate: int, rng: np.random.Generator) -> Array:
    """Reverberation: noise that fades within 0.15 to 1.2 seconds, behind the direct sound."""
    from scipy import signal

    fades = rng.uniform(0.15, 1.2)
    t = np.arange(int(fades * rate)) / rate
    tail = rng.standard_normal(len(t)) * np.exp(-6.9 * t / fades)
    tail *= rng.uniform(0.05, 0.5) / np.sqrt((tail**2).sum())
    return np.asarray(sound + signal.oaconvolve(sound, tail)[: len(sound)])


def _coded(samples: NDArray[np.float32], rate: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Through a lossy codec and back, with the delay that it adds taken off."""
    import soundfile

    kind, subtype = _CODECS[int(rng.integers(len(_CODECS)))]
    file = io.BytesIO()
    level = float(rng.uniform(0.3, 0.95))
    soundfile.write(file, samples, rate, format=kind, subtype=subtype, compression_level=level)
    file.seek(0)
    decoded, _ = soundfile.read(file, dtype="float32")
    out = np.zeros_like(samples)
    kept = min(len(out), len(decoded))
    out[:kept] = np.clip(decoded[:kept], -1.0, 1.0)
    return out


register(SongPlayer(PLAYED, play, band_version))
