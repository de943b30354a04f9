"""Audio features aligned with a motion, frame by frame: the form in which a model is conditioned on music.

The convention, everywhere: frame k of a motion and row k of its features are at k / fps seconds of the music
that goes with it, so row 0 belongs to frame 0. Music that goes on is cut; where it ends first, its last row
is repeated.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.audio.features import BEAT, DIM, AudioSettings, audio_features
from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.audio.spectra import HOP
from motionloom.datasets.schema import UserError


def motion_frame_features(
    sound: Sound, fps: float, frames: int, settings: AudioSettings | None = None
) -> NDArray[np.float32]:
    """Return the published features, float32 [frames, 438], a row for every frame of a motion at `fps`.

    Without settings they are made at the motion's own frame rate, as converters do, or at the published 60
    where they cannot be. `UserError` as of `audio_features`.
    """
    settings = settings or settings_at(fps)
    return rows_at(audio_features(sound.samples, sound.rate, settings), settings.fps, fps, frames)


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
        settings = None if rate is None else AudioSettings.parse({"fps": rate}, "audio features")
        return motion_frame_features(whole, fps, frames, settings)
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
    if frames < 1 or fps <= 0:
        raise UserError(f"features cannot be aligned with {frames} frames at {fps:g} a second")
    nearest = np.floor(np.arange(frames) * (features_fps / fps) + 0.5).astype(np.int64)
    out: NDArray[np.float32] = features[np.minimum(nearest, len(features) - 1)]
    # A beat is one row in either rate: taking the nearest row would lose some and double others.
    beats = np.floor(np.flatnonzero(features[:, BEAT]) * (fps / features_fps) + 0.5).astype(np.int64)
    out[:, BEAT] = 0
    out[beats[beats < frames], BEAT] = 1
    return out
