"""librosa, imported when it is first used and compiled by one process at a time.

librosa compiles parts of itself with numba: half a minute or more when it is first used in an environment,
then seconds in each process. Processes that fill one cache of numba's at once can mix their files and crash
(numba issue 10128), which the workers of a first conversion would do. So the first process compiles all
that audio features use behind a lock and leaves a mark beside the cache; whoever finds the mark just imports.
A cache holds for one installation and one type of processor, and so does a mark: a new environment, a cleared
cache and another node of a cluster start over.
"""

from __future__ import annotations

import fcntl
import importlib.util
import os
import platform
import tempfile
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np


@lru_cache(maxsize=1)
def load_librosa() -> Any:
    """The module, with what audio features use of it compiled."""
    mark = _mark()
    if mark.exists():
        return _imported()
    with mark.with_suffix(".lock").open("ab") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        module = _imported()
        mark.touch()
    return module


def _mark() -> Path:
    """The file whose existence means that the cache is filled, in the folder that numba would choose."""
    spec = importlib.util.find_spec("librosa")
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError("No module named 'librosa'", name="librosa")
    source = Path(spec.origin)
    about = source.stat()
    which = crc32(f"{source.resolve()} {about.st_mtime_ns} {about.st_size} {_processor()}".encode())
    name = f"motionloom-librosa-{version('librosa')}-numba-{version('numba')}-{which:08x}.compiled"
    wanted = os.environ.get("NUMBA_CACHE_DIR")
    for folder in (Path(wanted) if wanted else source.parent / "__pycache__", _own_temporary()):
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder / name
    raise PermissionError(f"no folder to write to; set TMPDIR to one that user {os.getuid()} may write")


def _processor() -> str:
    """The model of this machine's processor, as far as the system knows it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line for line in lines if line.startswith("model name")), platform.machine())


def _own_temporary() -> Path:
    return Path(tempfile.gettempdir()) / f"motionloom-{os.getuid()}"


def _imported() -> Any:
    import librosa
    import librosa.beat  # compiles on import, like most of librosa; the calls below do the rest

    noise = np.random.default_rng(0).standard_normal(4096).astype(np.float32)
    librosa.istft(librosa.stft(noise))
    librosa.cqt(noise, sr=4096, n_bins=12, fmin=440.0)
    return librosa
