"""Sentences for errors of the system: a full disk, no permission, a file in the way.

Libraries pass such an error on in their own ways; `sentence_of` knows those of torch, safetensors and numpy.
"""

from __future__ import annotations

import errno
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_AGAIN = "what was finished is kept, and nothing half-written is left under a final name"

_WORDS: dict[int, str] = {
    errno.ENOSPC: f"the disk is full; free space and give the same command again: {_AGAIN}",
    errno.EDQUOT: f"the disk quota is used up; free space and give the same command again: {_AGAIN}",
    errno.EROFS: "lies on a read-only file system; choose another place",
    errno.EACCES: "no permission; change the rights of the file or its folder, or choose another place",
    errno.EPERM: "not permitted; change the rights of the file or its folder, or choose another place",
    errno.ENOTDIR: "a file stands where a folder is needed; choose another name",
    errno.EISDIR: "is a folder, and a file is needed; choose another name",
    errno.EEXIST: "exists already; choose another name, or move it away",
    errno.ENAMETOOLONG: "the name is too long for the file system; choose a shorter one",
    errno.ENOENT: "no such file or folder",
    errno.ELOOP: "its symbolic links go in a circle; name the file itself",
    errno.EMFILE: f"too many open files; raise the limit (ulimit -n) or take fewer workers: {_AGAIN}",
    errno.ENFILE: f"too many open files on this machine; close programs and try again: {_AGAIN}",
    errno.EIO: f"the disk could not be read or written (input/output error); check it: {_AGAIN}",
    errno.EFBIG: f"the file is larger than its file system or a limit (ulimit -f) allows: {_AGAIN}",
    errno.ENOMEM: f"the machine is out of memory: {_AGAIN}",
    errno.ESTALE: f"its network file system has gone away; mount that again: {_AGAIN}",
}

NO_MORE = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_OF_THE_MACHINE = {*NO_MORE, errno.EMFILE, errno.ENFILE, errno.EIO}

_RUST = re.compile(r"\(os error (\d+)\)")
_NUMPY_SHORT = re.compile(r"\d+ requested and \d+ written")
SHARED_MEMORY = "/dev/shm"
_SHARED_FULL = (
    f"shared memory ({SHARED_MEMORY}), where loader workers put batches and all workers their locks, is "
    f"full; give the container more of it, or set hardware.workers: 0 and convert_workers: 1; {_AGAIN}"
)
_OF_SHARED_MEMORY = ("shared memory", "unable to write to file </torch", "unable to resize file </torch")
"""In torch's messages, those about loader workers that died of it included."""
_SPARE = 2**26
"""Bytes with less than which a file system counts as full."""
_A_LOCK = 2**16
_TORCH = ("PytorchStreamWriter", "PytorchStreamReader", "inline_container")


def of_the_machine(error: BaseException) -> bool:
    """Whether an error, or one that it was raised from, says that the machine is at its limits, whatever file
    was read or written."""
    found = (error, *_causes(error))
    return any(lacks_memory(one) or getattr(one, "errno", None) in _OF_THE_MACHINE for one in found)


def lacks_memory(error: BaseException) -> bool:
    """Whether there was no memory left, a GPU's included, in Python's, the system's or torch's words."""
    if isinstance(error, RuntimeError):
        return "out of memory" in str(error) or "allocate memory" in str(error)
    return isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM


@contextmanager
def naming(path: Path | str, *instead: object) -> Iterator[None]:
    """Have an error of the system that names no file, or one of `instead`, name `path`."""
    try:
        yield
    except OSError as error:
        named = error.filename if error.filename2 is None else error.filename2  # of a copy, what it makes
        if error.errno is not None and named in (None, *instead):
            error.filename = str(path)
            if error.filename2 is not None:
                error.filename2 = None
        raise


def full_place(folder: Path) -> str:
    """Return the place of an error without a file: shared memory if that is full and the disk is not."""
    if not Path(SHARED_MEMORY).is_dir():
        return str(folder)
    shared_is_full = shutil.disk_usage(SHARED_MEMORY).free < _SPARE <= shutil.disk_usage(folder).free
    return SHARED_MEMORY if shared_is_full else str(folder)


def sentence_of(error: BaseException) -> str | None:
    """One sentence for an error of the system: the file, what happened and what to do.

    None for all others, which are mistakes in a program. An error that a library has wrapped is found through
    what it was raised from.
    """
    if isinstance(error, OSError):
        if error.errno in NO_MORE and str(error.filename).startswith(SHARED_MEMORY):
            return _SHARED_FULL
        # Locks of processes lie there too: what cannot make one names no file, and calls it missing at times.
        nameless = error.errno in (errno.ENOSPC, errno.ENOENT) and error.filename is None
        if nameless and Path(SHARED_MEMORY).is_dir() and shutil.disk_usage(SHARED_MEMORY).free < _A_LOCK:
            return _SHARED_FULL
        if error.errno in _WORDS:
            return _named(error, _WORDS[error.errno])
        if error.errno is not None and error.filename is not None:
            return _named(error, (error.strerror or os.strerror(error.errno)).lower())
    text = str(error)
    if lacks_memory(error):
        return _WORDS[errno.ENOMEM]
    if isinstance(error, RuntimeError) and any(words in text for words in _OF_SHARED_MEMORY):
        return _SHARED_FULL
    rust = _RUST.search(text)
    if rust is not None and int(rust[1]) in _WORDS:  # safetensors
        return _WORDS[int(rust[1])]
    if isinstance(error, OSError) and _NUMPY_SHORT.search(text):
        return _named(error, f"could not be written to its end, most likely {_WORDS[errno.ENOSPC]}")
    if isinstance(error, RuntimeError) and any(name in text for name in _TORCH):
        cause_words = next((words for cause in _causes(error) if (words := sentence_of(cause))), None)
        what = text.strip().splitlines()[0]
        return cause_words or f"torch could not read or write a file ({what}); is the disk full? {_AGAIN}"
    return None


def _causes(error: BaseException) -> Iterator[BaseException]:
    seen = {id(error)}
    cause = error.__cause__ or error.__context__
    while cause is not None and id(cause) not in seen:
        seen.add(id(cause))
        yield cause
        cause = cause.__cause__ or cause.__context__


def _named(error: OSError, words: str) -> str:
    """`words` behind the name of the file, where the error has one; of a copy where no more fits."""
    name = error.filename2 if error.errno in NO_MORE and error.filename2 is not None else error.filename
    if name is None or isinstance(name, int):
        return words
    return f"{os.fsdecode(name) if isinstance(name, bytes) else name}: {words}"
