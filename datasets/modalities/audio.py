"""Music: the 438 published features a frame (UDE section 4.1; `datasets/audio/features.py`), or rhythm's few.

Which of them a data set holds is told by their number. `rhythm` columns (`datasets/audio/rhythm_features.py`)
say where beats and bars are, and how loud and full the music is: what real songs share with rendered ones
[ours].
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.modalities.modality import FrameModality, FrameStats


class AudioModality(FrameModality):
    """The music that plays."""

    name = "audio"
    members = ("audio.npy", "audio.flac")
    width = 438

    def features(self, value: object, fps: float, prepared: object = None) -> NDArray[np.float32]:
        """Analyse a `Sound`, by all of the piece that it is a slice of; arrays are taken as they are.

        The columns are those that the model was trained on: as many as the statistics `prepared` have.
        """
        from motionloom.datasets.audio.features import features_of
        from motionloom.datasets.audio.sound import Sound

        if not isinstance(value, Sound):
            return super().features(value, fps)
        if not isinstance(prepared, FrameStats):
            return features_of(value, fps, self.width)
        return features_of(value, fps, prepared.dim, prepared.rate)

    def seconds(self, value: object) -> float | None:
        from motionloom.datasets.audio.sound import Sound

        return value.seconds if isinstance(value, Sound) else None

    def ticks(self, value: object, features: NDArray[np.float32], fps: float) -> list[float]:
        from motionloom.datasets.audio.features import BEAT

        if features.shape[1] == self.width:
            # 0 or 1, to rounding where they were normalised in between.
            return [float(frame / fps) for frame in np.flatnonzero(features[:, BEAT] > 0.5)]
        from motionloom.datasets.audio.rhythm_features import beats_of_rows

        return [float(beat) for beat in beats_of_rows(features, fps)]


RECORD = AudioModality()
