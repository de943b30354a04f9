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
- librosa computes everything, each spectrum once (`spectra`).
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

from motionloom.datasets.audio.sound import Sound, resample_sound
from motionloom.datasets.audio.spectra import HOP, load_librosa, separate, tuning
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

_BINS = 36
"""Constant-Q bins an octave."""

_SILENCE = 1e-7
"""-140 dB."""

_BLOCK = 2048
"""Frames of tempograms made at a time: librosa's take some 20 kB a frame, and its beat tracker makes one only
to know its mean. Blocks give the same numbers."""
_TEMPO_SECONDS = 8.0
"""Length of the windows that the tempo is measured in, as in `librosa.feature.tempo`."""


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
    settings = settings or AudioSettings()
    samples, octaves = _prepared(samples, rate, settings), fitting_octaves(settings.rate)
    librosa = load_librosa()
    with _no_remarks():
        spectra = separate(samples, settings.rate)
        mfcc = librosa.feature.mfcc(S=librosa.power_to_db(spectra.mel, ref=np.max), n_mfcc=_MFCC)
        notes = _constant_q(spectra.harmonic, settings.rate, octaves)
        onsets = onset_strength(spectra.percussive_mel)
        columns = [
            mfcc,
            librosa.feature.delta(mfcc, width=3),
            librosa.feature.chroma_cqt(C=notes, n_octaves=octaves, bins_per_octave=_BINS),
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
        return rows_at(audio_features(whole.samples, whole.rate, settings), settings.fps, fps, frames)
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


def fitting_octaves(rate: int) -> int:
    """Return how many octaves above C1 fit below half the rate, at most 7; 0 where not even one does."""
    librosa = load_librosa()
    for octaves in range(7, 0, -1):
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


def _constant_q(samples: NDArray[np.float32], rate: int, octaves: int) -> NDArray[np.float32]:
    """Magnitudes [36 x octaves, T] from C1 up; frames of nothing but rounding are 0."""
    spectrum = load_librosa().cqt(
        samples,
        sr=rate,
        hop_length=HOP,
        n_bins=_BINS * octaves,
        bins_per_octave=_BINS,
        tuning=tuning(samples, rate, _BINS),
    )
    # Filters leak rounding into silence, and chroma would scale it up to full notes.
    magnitude = np.abs(spectrum)
    loudest = magnitude.max(axis=0)
    magnitude[:, loudest < _SILENCE * loudest.max()] = 0
    return np.asarray(magnitude)


def onset_strength(mel: NDArray[np.float32]) -> NDArray[np.float32]:
    """Mel power [128, T] -> [T]: the median rise over the bands."""
    librosa = load_librosa()
    strength = librosa.onset.onset_strength(S=librosa.power_to_db(mel), aggregate=np.median)
    return np.asarray(strength)


def tempogram(onsets: NDArray[np.float32], width: int) -> NDArray[np.float32]:
    """Onset strengths [T] -> [width, T]: autocorrelation around each frame, the largest value 1."""
    return np.concatenate([block.astype(np.float32) for block in _tempograms(onsets, width)], axis=1)


def track_beats(onsets: NDArray[np.float32], rate: int) -> NDArray[np.int64]:
    """`librosa.beat.beat_track`: frames of the beats of onset strengths [T], ascending."""
    librosa = load_librosa()
    if not onsets.any():
        return np.empty(0, dtype=np.int64)
    width = int(librosa.time_to_frames(_TEMPO_SECONDS, sr=rate, hop_length=HOP))
    mean = sum(block.sum(axis=1, keepdims=True) for block in _tempograms(onsets, width)) / len(onsets)
    tempo = librosa.feature.tempo(tg=mean, sr=rate, hop_length=HOP)
    with np.errstate(divide="ignore"):  # at 5 frames a second a beat can be a frame, and 0 a step it refuses
        _, frames = librosa.beat.beat_track(onset_envelope=onsets, sr=rate, hop_length=HOP, bpm=tempo)
    return np.asarray(frames)


def _tempograms(onsets: NDArray[np.float32], width: int) -> Iterator[NDArray[np.float64]]:
    """[width, frames] of block after block."""
    # librosa's own padding of a centred tempogram, made once for all blocks.
    padded = np.pad(onsets, width // 2, mode="linear_ramp", end_values=0)
    for start in range(0, len(onsets), _BLOCK):
        stop = min(start + _BLOCK, len(onsets))
        around = padded[start : stop + width - 1]
        yield load_librosa().feature.tempogram(onset_envelope=around, win_length=width, center=False)


@contextmanager
def _no_remarks() -> Iterator[None]:
    """Silence librosa's warnings of short sounds and of mel bands without a bin: both are as published."""
    with warnings.catch_warnings():
        for remark in ("n_fft=", "Empty filters", "Trying to estimate"):
            warnings.filterwarnings("ignore", message=remark, category=UserWarning)
        yield
