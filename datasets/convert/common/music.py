"""The music or speech of a clip: which options it has, and the part of a piece that belongs to a motion.

Features are made once for a whole piece and cut to the motion; row 0 belongs to frame 0. Beats and loudness
are then the piece's, not the cut's.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from motionloom.datasets.convert.common.config import ConvertConfig
from motionloom.datasets.convert.common.files import inside

if TYPE_CHECKING:
    from motionloom.datasets.audio.features import AudioSettings

SOUND_SUFFIXES = (".wav", ".flac", ".mp3", ".ogg")
_KEPT_PIECES = 64
"""AIST++ has 60 pieces of music: with their features and sound about 0.3 GB in each worker."""

Wav = tuple[NDArray[np.float32], int]
"""Samples and their rate."""


class SoundConfig(ConvertConfig):
    """Options of converters whose clips have sound."""

    max_music_gap: float = Field(default=1.0, ge=0)
    """Seconds of motion that may be cut where the sound ends first; beyond that the clip is left out."""
    audio_features: bool = True
    """Store the 438 audio features."""
    audio_fps: float | None = Field(default=None, gt=0)
    """Rows of audio features a second that the music is analysed at, each stored for all motion frames
    nearest to it; default: one for every motion frame. Bailando's release hears 7.5."""
    sound_rate: int = Field(default=16_000, ge=0, le=192_000)
    """Sample rate at which the sound itself is stored; 0 leaves it out."""

    def audio_settings(self) -> AudioSettings | None:
        """Settings of the features; None where none are wanted."""
        from motionloom.datasets.audio.features import AudioSettings

        if not self.audio_features:
            return None
        return AudioSettings.parse({"fps": self.audio_fps or self.fps}, "audio features")


def cut_of(
    config: SoundConfig, folder: Path, sound: str, start: float, seconds: float
) -> tuple[NDArray[np.float32] | None, Wav | None]:
    """The part of a piece from second `start` on that is `seconds` long.

    Audio features [T, 438], a row for each frame of the motion, and the sound itself.
    """
    settings = config.audio_settings()
    features, samples = piece_of_music(folder, sound, settings, config.fps, config.sound_rate)
    rows: NDArray[np.float32] | None = None
    if features is not None:
        first, count = round(start * config.fps), max(1, round(seconds * config.fps))
        # The last frame may lie at the very end of the music, past the last row by a rounding.
        rows = features[np.minimum(np.arange(first, first + count), len(features) - 1)]
    if samples is None:
        return rows, None
    begin = round(start * config.sound_rate)
    return rows, (samples[begin : begin + round(seconds * config.sound_rate)], config.sound_rate)


@lru_cache(maxsize=_KEPT_PIECES)
def piece_of_music(
    folder: Path, sound: str, settings: AudioSettings | None, fps: float, rate: int
) -> tuple[NDArray[np.float32] | None, NDArray[np.float32] | None]:
    """Features of a whole music file at `fps` (where settings are given), samples at `rate` (unless 0)."""
    from motionloom.datasets.audio.align_features import rows_at
    from motionloom.datasets.audio.features import audio_features
    from motionloom.datasets.audio.sound import read_sound, resample_sound

    if settings is None and not rate:
        return None, None
    label = f"{folder.name}/{sound}"
    samples, found = read_sound(inside(folder, sound, label), label)
    features = None
    if settings is not None:
        analysed = audio_features(samples, found, settings)
        features = rows_at(analysed, settings.fps, fps, round(len(analysed) * fps / settings.fps))
    kept = resample_sound(samples, found, rate) if rate else None
    for shared in (features, kept):
        if shared is not None:
            shared.setflags(write=False)  # every clip of the piece gets the same array
    return features, kept
