"""Music: 438 features a frame (UDE section 4.1; `datasets/audio/features.py`)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.modalities.modality import FrameModality


class AudioModality(FrameModality):
    """The music that plays."""

    name = "audio"
    members = ("audio.npy", "audio.flac")
    width = 438

    def features(self, given: object, fps: float) -> NDArray[np.float32]:
        """Analyse a `Sound`, by all of the piece that it is a slice of; arrays are taken as they are."""
        from motionloom.datasets.audio.lineup import features_of
        from motionloom.datasets.audio.sound import Sound

        return features_of(given, fps) if isinstance(given, Sound) else super().features(given, fps)

    def seconds(self, given: object) -> float | None:
        from motionloom.datasets.audio.sound import Sound

        return given.seconds if isinstance(given, Sound) else None

    def ticks(self, given: object, features: NDArray[np.float32], fps: float) -> list[float]:
        from motionloom.datasets.audio.features import BEAT

        return [float(frame / fps) for frame in np.flatnonzero(features[:, BEAT])]


RECORD = AudioModality()
