"""Audio features that dances are conditioned on, equal to the published ones within 1e-3.

`audio_features`, 438 numbers a frame (Bailando, UDE):

| columns  | what |
|----------|------|
| 0:20     | MFCC of the mel spectrogram in dB against its loudest value (so it depends on the whole clip) |
| 20:40    | change of the MFCC over three frames |
| 40:52    | constant-Q chroma of the harmonic part, C first, the strongest note 1 |
| 52       | onset strength: median rise over the mel bands of the percussive part |
| 53       | 1 on a beat of that onset strength |
| 54:438   | tempogram: autocorrelation of the onset strength at lags of 0 .. 383 frames |

`baseline_features`, 35 numbers a frame (AI Choreographer, EDGE): 0 onset strength (mean), 1:21 MFCC, 21:33
smoothed chroma (CENS), 33 note onsets, 34 beats.

Notable choices:
- The frame rate is what is chosen; the sound is resampled to 512 samples a frame, as published: 60 frames a
  second are 30720 Hz, 7.5 are 3840 Hz.
- librosa computes everything, each spectrum once (`spectra`).
- Frames of chroma 140 dB below the loudest one have no notes: what is there is rounding, which librosa scales
  up to 1.
- A frame's number is time x frames a second; a sound of n samples has 1 + n // 512 frames.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from motionloom.datasets.audio import rhythm
from motionloom.datasets.audio.compiled import load_librosa
from motionloom.datasets.audio.sound import resample_sound
from motionloom.datasets.audio.spectra import HOP, mel_power, separate, tuning
from motionloom.datasets.schema import Config, UserError

DIM = 438
BEAT = 53
"""The column of beats."""

BASELINE_DIM = 35
VERSION = 2
"""Raised whenever the same sound and settings give other numbers: cached features are then made again."""

_MFCC = 20
_SHORTEST = 3
"""Frames; fewer have no change of MFCC."""

_BINS = 36
"""Constant-Q bins an octave."""

_SILENCE = 1e-7
"""-140 dB."""


class AudioSettings(Config):
    """Settings of audio features; the defaults are Bailando's and UDE's at 60 frames a second."""

    fps: float = Field(default=60.0, ge=5, le=240)
    """Frames a second: 60 (published), 7.5 (Bailando's GPT), or a motion's own 20 or 30."""

    octaves: int | None = Field(default=None, ge=1, le=7)
    """Octaves of chroma from C1. Default: 7, or as many as fit below half the sample rate (5 at 7.5 fps)."""

    start_bpm: float = Field(default=120.0, gt=0)
    """Tempo that beat tracking leans to; published 35-d features use the BPM in the name of AIST music."""

    tightness: float = Field(default=100.0, gt=0)
    """How evenly beats must be spaced."""

    @field_validator("fps")
    @classmethod
    def _whole_rate(cls, fps: float) -> float:
        if fps * HOP != int(fps * HOP):
            raise ValueError(f"512 times the frames a second must be a whole number of Hz, not {fps * HOP:g}")
        return fps

    @property
    def rate(self) -> int:
        """Sample rate that features are computed at, Hz."""
        return int(self.fps * HOP)


def audio_features(
    samples: NDArray[np.float32], rate: int, settings: AudioSettings | None = None
) -> NDArray[np.float32]:
    """Mono samples [n] at `rate` Hz -> float32 [1 + n' // 512, 438], n' the length at the settings' rate.

    `UserError` for sound of fewer than three frames, or more octaves than fit.
    """
    settings = settings or AudioSettings()
    samples = _prepared(samples, rate, settings)
    octaves = _octaves(settings)
    librosa = load_librosa()
    with _no_remarks():
        found = separate(samples, settings.rate)
        mfcc = librosa.feature.mfcc(S=librosa.power_to_db(found.mel, ref=np.max), n_mfcc=_MFCC)
        notes = _constant_q(found.harmonic, settings.rate, octaves)
        onsets = rhythm.onset_strength(found.percussive_mel)
        columns = [
            mfcc,
            librosa.feature.delta(mfcc, width=3),
            librosa.feature.chroma_cqt(C=notes, n_octaves=octaves, bins_per_octave=_BINS),
            onsets[None],
            rhythm.flags(_beat_frames(onsets, settings), len(onsets))[None],
            rhythm.tempogram(onsets, DIM - 54),
        ]
    return np.ascontiguousarray(np.concatenate(columns).T, dtype=np.float32)


def baseline_features(
    samples: NDArray[np.float32], rate: int, settings: AudioSettings | None = None
) -> NDArray[np.float32]:
    """Mono samples [n] at `rate` Hz -> float32 [T, 35]; published with a `start_bpm` for each music."""
    settings = settings or AudioSettings()
    samples = _prepared(samples, rate, settings)
    octaves = _octaves(settings)
    librosa = load_librosa()
    with _no_remarks():
        level = librosa.power_to_db(mel_power(samples, settings.rate))
        onsets = librosa.onset.onset_strength(S=level)
        notes = _constant_q(samples, settings.rate, octaves)
        picked = librosa.onset.onset_detect(onset_envelope=onsets, sr=settings.rate)
        columns = [
            onsets[None],
            librosa.feature.mfcc(S=level, n_mfcc=_MFCC),
            librosa.feature.chroma_cens(C=notes, n_octaves=octaves, bins_per_octave=_BINS),
            rhythm.flags(picked, len(onsets))[None],
            rhythm.flags(_beat_frames(onsets, settings), len(onsets))[None],
        ]
    return np.ascontiguousarray(np.concatenate(columns).T, dtype=np.float32)


def beats(
    samples: NDArray[np.float32], rate: int, settings: AudioSettings | None = None
) -> NDArray[np.float64]:
    """Times of the beats in seconds, ascending: those that column 53 of `audio_features` marks."""
    settings = settings or AudioSettings()
    samples = _prepared(samples, rate, settings)
    with _no_remarks():
        onsets = rhythm.onset_strength(separate(samples, settings.rate).percussive_mel)
        return np.asarray(_beat_frames(onsets, settings) / settings.fps)


def fitting_octaves(rate: int, most: int = 7) -> int:
    """As many octaves above C1 as fit below half the rate, at most `most`; 0 where not even one does."""
    librosa = load_librosa()
    for octaves in range(most, 0, -1):
        # Tuning moves the filters by less than half a bin.
        frequencies = librosa.cqt_frequencies(
            octaves * _BINS, fmin=librosa.note_to_hz("C1"), bins_per_octave=_BINS, tuning=0.5
        )
        _, highest = librosa.filters.wavelet_lengths(freqs=frequencies, sr=rate)
        if highest <= rate / 2:
            return octaves
    return 0


def _prepared(samples: NDArray[np.float32], rate: int, settings: AudioSettings) -> NDArray[np.float32]:
    """The sound at the settings' rate."""
    if samples.ndim != 1 or not np.isfinite(samples).all():
        raise UserError(f"sound must be finite mono samples [n], not of shape {list(samples.shape)}")
    samples = resample_sound(np.asarray(samples, dtype=np.float32), rate, settings.rate)
    if len(samples) < (_SHORTEST - 1) * HOP:
        raise UserError(
            f"sound of {len(samples) / settings.rate:.3f} s is too short for audio features at "
            f"{settings.fps:g} frames a second: at least {(_SHORTEST - 1) / settings.fps:.3f} s"
        )
    return samples


def _octaves(settings: AudioSettings) -> int:
    fitting = fitting_octaves(settings.rate)
    if settings.octaves is not None and settings.octaves > fitting:
        raise UserError(
            f"octaves: {settings.octaves} do not fit at {settings.fps:g} frames a second; at most {fitting}"
        )
    return settings.octaves or fitting


def _constant_q(samples: NDArray[np.float32], rate: int, octaves: int) -> NDArray[np.float32]:
    """Magnitudes [36 x octaves, T] from C1 up; frames of nothing but rounding are 0."""
    found = load_librosa().cqt(
        samples,
        sr=rate,
        hop_length=HOP,
        n_bins=_BINS * octaves,
        bins_per_octave=_BINS,
        tuning=tuning(samples, rate, _BINS),
    )
    magnitude = np.abs(found)
    loudest = magnitude.max(axis=0)
    magnitude[:, loudest < _SILENCE * loudest.max()] = 0
    return np.asarray(magnitude)


def _beat_frames(onsets: NDArray[np.float32], settings: AudioSettings) -> NDArray[np.int64]:
    return rhythm.track_beats(
        onsets, settings.rate, start_bpm=settings.start_bpm, tightness=settings.tightness
    )


@contextmanager
def _no_remarks() -> Iterator[None]:
    """Without librosa's warnings of short sounds and of mel bands without a bin: both are as published."""
    with warnings.catch_warnings():
        for remark in ("n_fft=", "Empty filters", "Trying to estimate"):
            warnings.filterwarnings("ignore", message=remark, category=UserWarning)
        yield
