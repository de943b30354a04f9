"""Audio features on disk, computed once for each sound and settings, whoever asks and however often.

`FOLDER/ab/ab12...f438.npy`: named by what went in, the bytes of the sound file, the settings and the version
of the features, so nothing ever needs to be thrown away. A process that wants features which another is
computing waits for it; a process that is killed leaves nothing behind that anyone waits for.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.audio.features import DIM, VERSION, AudioSettings, audio_features
from motionloom.datasets.audio.sound import read_sound
from motionloom.datasets.base.files import sha256_of, sha256_of_json, write_with
from motionloom.datasets.base.lock import file_lock
from motionloom.datasets.base.pool import Workers
from motionloom.datasets.schema import UserError


class AudioCache:
    """`audio_features` of sound files, kept in a folder; cheap to pickle into workers."""

    def __init__(self, folder: Path | str, settings: AudioSettings | None = None) -> None:
        self.folder = Path(folder)
        self.settings = settings or AudioSettings()

    def features(self, path: Path) -> NDArray[np.float32]:
        """Features [T, 438] of a sound file; `UserError` as of `read_sound` and `audio_features`."""
        found = self._place(sha256_of(path) if path.is_file() else "")
        if (known := _load(found)) is not None:
            return known
        samples, rate = read_sound(path)  # before anything is made: a broken file leaves no trace
        found.parent.mkdir(parents=True, exist_ok=True)
        with file_lock(found.with_suffix(".lock")):
            if (known := _load(found)) is not None:
                return known
            try:
                features = audio_features(samples, rate, self.settings)
            except UserError as error:
                raise UserError(f"{path}: {error}") from None
            write_with(found, partial(np.save, arr=features, allow_pickle=False))
            return features

    def all_features(self, paths: Sequence[Path], workers: int = 1) -> list[NDArray[np.float32]]:
        """Features [T, 438] of every sound file, in the same order, computed in so many processes."""
        out: dict[int, NDArray[np.float32]] = {}
        with Workers(workers) as pool:
            for position, features in pool.run(self.features, paths):
                out[position] = features
        return [out[position] for position in range(len(paths))]

    def _place(self, content: str) -> Path:
        name = sha256_of_json([content, self.settings.dump(), VERSION])
        return self.folder / name[:2] / f"{name}.f{DIM}.npy"


def _load(path: Path) -> NDArray[np.float32] | None:
    """The array, or None where there is none or it is damaged."""
    try:
        values = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError):
        return None
    good = values.dtype == np.float32 and values.ndim == 2 and values.shape[1] == DIM
    return values if good and len(values) else None
