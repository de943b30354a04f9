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
- librosa defines the numbers but does not compute them: its way takes 25 times as long, most of it in median
  filters, and compiles itself with numba before. Tests hold the two together.
- A frame's number is time x frames a second; a sound of n samples has 1 + n // 512 frames.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator
from scipy import fft

from motionloom.datasets.audio import rhythm
from motionloom.datasets.audio.chroma import Tuning, chroma, fitting_octaves, normalized
from motionloom.datasets.audio.median import REACH
from motionloom.datasets.audio.sound import resample_sound
from motionloom.datasets.audio.spectrum import (
    HOP,
    MELS,
    Separation,
    decibels,
    frame_count,
    mel_power,
    spectra,
)
from motionloom.datasets.schema import Config, UserError

DIM = 438
BASELINE_DIM = 35
VERSION = 1
"""Raised whenever the same sound and settings give other numbers: cached features are then made again."""

_MFCC = 20
_AIST_KINDS = ("mBR", "mPO", "mLO", "mMH", "mLH", "mWA", "mKR", "mJS", "mJB")
_SHORTEST = 3
"""Frames; fewer have no change of MFCC."""


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
    mel, harmonic, percussive = _separated(samples, settings.rate)
    mfcc = _mfcc(decibels(mel, loudest=True))
    notes = chroma(harmonic, settings.rate, octaves, _tuning(harmonic, settings.rate))
    onsets = rhythm.onset_strength(decibels(_mel(percussive, settings.rate), loudest=False), "median")
    out = np.empty((len(mfcc), DIM), dtype=np.float32)
    out[:, :20] = mfcc
    out[1:-1, 20:40] = (mfcc[2:] - mfcc[:-2]) / 2
    out[0, 20:40], out[-1, 20:40] = out[1, 20:40], out[-2, 20:40]
    out[:, 40:52] = normalized(notes, np.inf)
    out[:, 52] = onsets
    out[:, 53] = _flags(_beat_frames(onsets, settings), len(out))
    out[:, 54:] = rhythm.tempogram(onsets, DIM - 54)
    return out


def baseline_features(
    samples: NDArray[np.float32], rate: int, settings: AudioSettings | None = None
) -> NDArray[np.float32]:
    """Mono samples [n] at `rate` Hz -> float32 [T, 35]; give `start_bpm` as published (`aist_bpm`)."""
    settings = settings or AudioSettings()
    samples = _prepared(samples, rate, settings)
    level = decibels(_mel(samples, settings.rate), loudest=False)
    onsets = rhythm.onset_strength(level, "mean")
    notes = chroma(samples, settings.rate, _octaves(settings), _tuning(samples, settings.rate))
    out = np.empty((len(level), BASELINE_DIM), dtype=np.float32)
    out[:, 0] = onsets
    out[:, 1:21] = _mfcc(level)
    out[:, 21:33] = _smoothed(notes)
    out[:, 33] = _flags(rhythm.pick_onsets(onsets, settings.fps), len(out))
    out[:, 34] = _flags(_beat_frames(onsets, settings), len(out))
    return out


def beats(
    samples: NDArray[np.float32], rate: int, settings: AudioSettings | None = None
) -> NDArray[np.float64]:
    """Times of the beats in seconds, ascending: those that column 53 of `audio_features` marks."""
    settings = settings or AudioSettings()
    samples = _prepared(samples, rate, settings)
    _, _, percussive = _separated(samples, settings.rate)
    onsets = rhythm.onset_strength(decibels(_mel(percussive, settings.rate), loudest=False), "median")
    return np.asarray(_beat_frames(onsets, settings) / settings.fps)


def aist_bpm(music: str) -> float:
    """Beats a minute that the name of an AIST music states (`mBR0` -> 80, `mHO5` -> 135)."""
    kind, digit = music[:3], music[3:]
    if len(digit) == 1 and digit.isascii() and digit.isdigit():
        if kind == "mHO":
            return 110.0 + 5 * int(digit)
        if kind in _AIST_KINDS:
            return 80.0 + 10 * int(digit)
    raise UserError(f"'{music}' is no AIST music: expected such as mBR0, of {', '.join(_AIST_KINDS)} or mHO")


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


def _separated(
    samples: NDArray[np.float32], rate: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """(mel power [T, 128], harmonic samples [n], percussive samples [n]) from one transform."""
    separation = Separation(len(samples))
    mel = np.empty((frame_count(len(samples)), MELS), dtype=np.float32)
    for start, stop, block in spectra(samples, reach=REACH):
        magnitude = np.abs(block)
        separation.add(start, stop, block, magnitude)
        first = start - max(0, start - REACH)
        mel[start:stop] = mel_power(magnitude[first : first + stop - start], rate)
    return mel, *separation.sounds()


def _mel(samples: NDArray[np.float32], rate: int) -> NDArray[np.float32]:
    """Mel power [T, 128]."""
    return np.concatenate([mel_power(np.abs(block), rate) for _, _, block in spectra(samples)])


def _tuning(samples: NDArray[np.float32], rate: int) -> float:
    tuning = Tuning(rate)
    for _, _, block in spectra(samples, exact=False):
        tuning.add(np.abs(block))
    return tuning.estimate()


def _mfcc(level: NDArray[np.float32]) -> NDArray[np.float32]:
    """Mel levels [T, 128] in dB -> [T, 20]."""
    return np.asarray(fft.dct(level, axis=1, norm="ortho")[:, :_MFCC])


def _smoothed(notes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Chroma [T, 12] -> CENS: shares in four steps, smoothed over 41 frames, each frame of length 1."""
    shares = normalized(notes, 1)
    steps = np.zeros_like(shares)
    for threshold in (0.4, 0.2, 0.1, 0.05):
        steps += (shares > threshold) * np.float32(0.25)
    bell = np.hanning(43)
    reach = len(bell) // 2
    smooth = [np.convolve(column, bell / bell.sum())[reach : reach + len(steps)] for column in steps.T]
    return normalized(np.stack(smooth, axis=1).astype(np.float32), 2)


def _beat_frames(onsets: NDArray[np.float32], settings: AudioSettings) -> NDArray[np.int64]:
    return rhythm.track_beats(
        onsets, settings.fps, start_bpm=settings.start_bpm, tightness=settings.tightness
    )


def _flags(frames: NDArray[np.int64], count: int) -> NDArray[np.float32]:
    out = np.zeros(count, dtype=np.float32)
    out[frames] = 1
    return out
