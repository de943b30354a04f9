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

Notable choices:
- The frame rate is what is chosen; the sound is resampled to 512 samples a frame, as published: 60 frames a
  second are 30720 Hz, 7.5 are 3840 Hz.
- The numbers are those of librosa, whose parts that numba compiles are not used (`spectra`, `onsets`).
- Frames of chroma 140 dB below the loudest one have no notes: what is there is rounding, which librosa scales
  up to 1.
- A frame's number is time x frames a second; a sound of n samples has 1 + n // 512 frames.

Models are conditioned on them aligned with a motion (`features_of`): frame k of a motion and row k are at
k / fps seconds of the music that goes with it. Music that goes on is cut; where it ends first, its last row
is repeated.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from motionloom.datasets.audio.constant_q import chroma, constant_q, fitting_octaves
from motionloom.datasets.audio.onsets import decibels, onset_strength, tempogram, track_beats
from motionloom.datasets.audio.sound import Sound, resample_sound
from motionloom.datasets.audio.spectra import HOP, separate
from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError

DIM = 438
BEAT = 53
"""The column of beats."""

VERSION = 2
"""Raised whenever the same sound and settings give other numbers: cached features are then made again."""

_MFCC = 20
_SHORTEST = 3
"""Frames; fewer have no change of MFCC."""

_SILENCE = 1e-7
"""-140 dB."""


class AudioSettings(Config):
    """Settings of audio features."""

    fps: float = Field(default=60.0, ge=5, le=240)
    """Frames a second: 60 (Bailando, UDE), 7.5 (Bailando's GPT), or a motion's own 20 or 30."""

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
    """Return features of mono samples [n] at `rate` Hz, [1 + n' // 512, 438], n' at the settings' rate.

    `UserError` for sound of fewer than three frames. Chroma has 7 octaves from C1 on, or as many as fit below
    half the sample rate (5 at 7.5 frames a second).
    """
    from scipy.fft import dct
    from scipy.signal import savgol_filter

    settings = settings or AudioSettings()
    samples = _prepared(samples, rate, settings)
    octaves = fitting_octaves(settings.rate)
    with _no_remarks():
        spectra = separate(samples, settings.rate)
    mfcc = dct(decibels(spectra.mel, float(spectra.mel.max())), axis=0, norm="ortho")[:_MFCC]
    onsets = onset_strength(spectra.percussive_mel)
    columns = [
        mfcc,
        savgol_filter(mfcc, 3, polyorder=1, deriv=1, axis=1),
        chroma(_audible(constant_q(spectra.harmonic, settings.rate, octaves))),
        onsets[None],
        np.bincount(track_beats(onsets, settings.rate), minlength=len(onsets))[None],
        tempogram(onsets, DIM - 54),
    ]
    return np.ascontiguousarray(np.concatenate(columns).T, dtype=np.float32)


def beats(samples: NDArray[np.float32], rate: int) -> NDArray[np.float64]:
    """Return the times of the beats in seconds, ascending: those that column 53 of `audio_features` marks."""
    settings = AudioSettings()
    samples = _prepared(samples, rate, settings)
    with _no_remarks():
        onsets = onset_strength(separate(samples, settings.rate).percussive_mel)
    return np.asarray(track_beats(onsets, settings.rate) / settings.fps)


def features_of(sound: Sound, fps: float, width: int = DIM, rate: float | None = None) -> NDArray[np.float32]:
    """Return features [T, width] of a sound, a row for each motion frame, by all of the piece it is cut from.

    The width says which: the 438 published ones, at `rate` rows a second where that is given, or those of
    `rhythm_features`.

    Tempo and beats are read from many seconds around a frame, in training too: a slice analysed alone would
    look different. A piece is analysed once; the sound keeps the result.
    """
    piece = sound.piece or sound
    # The piece is analysed from less than a frame after its start, so that rows fall on the motion's frames.
    first = int(sound.begin * fps + 1e-6)
    lead = max(0.0, sound.begin - first / fps)
    rows = piece.analysed.get((lead, fps, width, rate))
    if rows is None:
        whole = piece.slice(lead) if round(lead * piece.rate) else piece
        rows = piece.analysed[lead, fps, width, rate] = _analyse(whole, fps, width, rate)
    frames = max(1, round(sound.seconds * fps))
    return rows[np.minimum(np.arange(first, first + frames), len(rows) - 1)]


def _analyse(whole: Sound, fps: float, width: int, rate: float | None) -> NDArray[np.float32]:
    frames = max(1, round(whole.seconds * fps))
    if width == DIM:
        settings = settings_at(fps) if rate is None else AudioSettings.parse({"fps": rate}, "audio features")
        rows = rows_at(audio_features(whole.samples, whole.rate, settings), settings.fps, fps, frames)
        given = (whole.piece or whole).beats
        if given is not None:
            marked = np.floor((given - whole.begin) * fps + 0.5).astype(np.int64)
            rows[:, BEAT] = 0
            rows[marked[(marked >= 0) & (marked < frames)], BEAT] = 1
        return rows
    from motionloom.datasets.audio.rhythm_features import RHYTHM_DIM, rhythm_features

    if width != RHYTHM_DIM:
        raise UserError(
            f"this model was trained on {width} features of music; known are {DIM} (published) and "
            f"{RHYTHM_DIM} (rhythm)"
        )
    return rhythm_features(whole, fps, frames)


def settings_at(fps: float) -> AudioSettings:
    """Return settings with a row for each frame at `fps`, or with the published 60 where that is no rate."""
    if 5 <= fps <= 240 and fps * HOP == int(fps * HOP):
        return AudioSettings(fps=fps)
    return AudioSettings()


def rows_at(
    features: NDArray[np.float32], features_fps: float, fps: float, frames: int
) -> NDArray[np.float32]:
    """Return of features [T, 438] at `features_fps` the rows nearest to frames at `fps`, [frames, 438].

    Each beat is marked at the one frame nearest to it, so none is skipped or doubled.
    """
    nearest = np.floor(np.arange(frames) * (features_fps / fps) + 0.5).astype(np.int64)
    out: NDArray[np.float32] = features[np.minimum(nearest, len(features) - 1)]
    # A beat is one row in either rate: taking the nearest row would lose some and double others.
    beats = np.floor(np.flatnonzero(features[:, BEAT]) * (fps / features_fps) + 0.5).astype(np.int64)
    out[:, BEAT] = 0
    out[beats[beats < frames], BEAT] = 1
    return out


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


def _audible(notes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Magnitudes [N, T] of notes; frames of nothing but rounding are 0."""
    # Filters leak rounding into silence, and chroma would scale it up to full notes.
    loudest = notes.max(axis=0)
    return np.asarray(np.where(loudest < _SILENCE * loudest.max(), np.float32(0), notes))


@contextmanager
def _no_remarks() -> Iterator[None]:
    """Silence librosa's warning of mel bands without a bin: as published."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Empty filters", category=UserWarning)
        yield
