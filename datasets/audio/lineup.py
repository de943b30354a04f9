"""Audio features lined up with a motion, frame by frame: the form in which a model is conditioned on music.

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
    sound: Sound | NDArray[np.float32],
    rate: int | None,
    fps: float,
    frames: int,
    settings: AudioSettings | None = None,
) -> NDArray[np.float32]:
    """Music -> float32 [frames, 438], a row for every frame of a motion at `fps`.

    `sound` is a `Sound` (its own rate counts) or mono samples [S] at `rate`. Without settings features are
    made at the motion's own frame rate, as converters do, or at the published 60 where they cannot be.
    `UserError` as of `audio_features`.
    """
    if isinstance(sound, Sound):
        samples, rate = sound.samples, sound.rate
    elif rate is None:
        raise UserError("samples need their rate")
    else:
        samples = sound
    settings = settings or settings_at(fps)
    return rows_at(audio_features(samples, rate, settings), settings.fps, fps, frames)


def features_of(sound: Sound, fps: float, width: int = DIM, rate: float | None = None) -> NDArray[np.float32]:
    """Features [T, width] of a sound, a row for each motion frame, by all of the piece that it is a slice of.

    The width says which: the 438 published ones, at `rate` rows a second where that is given, or those of
    `rhythm_features`.

    Tempo and beats are read from many seconds around a frame, in training too: a slice heard alone would
    look different. A piece is analysed once; the sound keeps what was found.
    """
    piece = sound.piece or sound
    # The piece is heard from within a frame's length on, so that its rows lie on the motion's frames.
    first = int(sound.begin * fps + 1e-6)
    lead = max(0.0, sound.begin - first / fps)
    known = piece.analysed.get((lead, fps, width, rate))
    if known is None:
        whole = piece.slice(lead) if round(lead * piece.rate) else piece
        known = _analysed(whole, fps, width, rate)
        piece.analysed[lead, fps, width, rate] = known
    frames = max(1, round(sound.seconds * fps))
    return known[np.minimum(np.arange(first, first + frames), len(known) - 1)]


def _analysed(whole: Sound, fps: float, width: int, rate: float | None) -> NDArray[np.float32]:
    frames = max(1, round(whole.seconds * fps))
    if width == DIM:
        settings = None if rate is None else AudioSettings.parse({"fps": rate}, "audio features")
        return motion_frame_features(whole, None, fps, frames, settings)
    from motionloom.datasets.audio.rhythm_features import RHYTHM_DIM, rhythm_features

    if width != RHYTHM_DIM:
        raise UserError(
            f"this model was trained on {width} features of music; known are {DIM} (published) and "
            f"{RHYTHM_DIM} (rhythm)"
        )
    return rhythm_features(whole, fps, frames)


def settings_at(fps: float) -> AudioSettings:
    """Features with a row for each frame at `fps`; at 60 rows a second where `fps` is none of theirs."""
    if 5 <= fps <= 240 and fps * HOP == int(fps * HOP):
        return AudioSettings(fps=fps)
    return AudioSettings()


def rows_at(
    features: NDArray[np.float32], features_fps: float, fps: float, frames: int
) -> NDArray[np.float32]:
    """Features [T, 438] at `features_fps` -> [frames, 438] at `fps`: the rows nearest in time.

    Each beat is marked at the one frame nearest to it, so none is skipped or doubled.
    """
    if frames < 1 or fps <= 0:
        raise UserError(f"features cannot be lined up with {frames} frames at {fps:g} a second")
    nearest = np.floor(np.arange(frames) * (features_fps / fps) + 0.5).astype(np.int64)
    out: NDArray[np.float32] = features[np.minimum(nearest, len(features) - 1)]
    beats = np.floor(np.flatnonzero(features[:, BEAT]) * (fps / features_fps) + 0.5).astype(np.int64)
    out[:, BEAT] = 0
    out[beats[beats < frames], BEAT] = 1
    return out
