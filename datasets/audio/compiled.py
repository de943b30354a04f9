"""librosa, imported when it is first used and compiled by one process at a time.

librosa compiles parts of itself with numba: half a minute or more when it is first used on a machine, then
seconds in each process. Processes that fill one cache of numba's at once can mix their files and crash (numba
issue 10128), which the workers of a first conversion would do. So the first process compiles everything that
audio features use behind a lock and leaves a mark; whoever finds the mark just imports.
"""

from __future__ import annotations

import fcntl
import os
import tempfile
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np


@lru_cache(maxsize=1)
def load_librosa() -> Any:
    """The module, with what audio features use of it compiled."""
    folder = Path(os.environ.get("NUMBA_CACHE_DIR") or tempfile.gettempdir())
    folder.mkdir(parents=True, exist_ok=True)
    name = f"motionloom-{os.getuid()}-librosa-{version('librosa')}-numba-{version('numba')}"
    mark = folder / f"{name}.compiled"
    if mark.exists():
        return _imported()
    with (folder / f"{name}.lock").open("ab") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        module = _imported()
        mark.touch()
    return module


def _imported() -> Any:
    import librosa
    import librosa.beat  # compiles on import, like most of librosa; the calls below do the rest

    noise = np.random.default_rng(0).standard_normal(4096).astype(np.float32)
    librosa.istft(librosa.stft(noise))
    librosa.cqt(noise, sr=4096, n_bins=12, fmin=440.0)
    return librosa
