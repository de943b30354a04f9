"""The kernel's file locks: who may write in a folder, who downloads a file, who works on a run.

A lock file rather than the thing itself, because over NFS an exclusive lock needs a file open for writing.
The kernel frees the lock when the process dies, however it dies. Limits: `flock` reaches other machines on
NFS only from Linux 2.6.12 on and with a lock service, on Lustre only with `-o flock`.

Not the `filelock` package: several machines that write shards of one conversion need shared locks, which it
has only through an SQLite file; where the file system has no locks it falls back to marker files, which a
killed process leaves behind; and it waits by asking again and again.
"""

from __future__ import annotations

import errno
import fcntl
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from motionloom.datasets.base.errors import UserError

LOCK_FILE = ".lock"
_READ_ONLY = {errno.EROFS, errno.EACCES, errno.EPERM}
_CANNOT_LOCK = {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP}


@contextmanager
def file_lock(path: Path, *, wait: bool = True, shared: bool = False) -> Iterator[bool]:
    """Hold the lock file `path`, alone or `shared`; yields False if it is taken and `wait` is off."""
    kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    try:
        handle = _locked(path, kind | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        yield False
        return
    try:
        yield True
    finally:
        os.close(handle)


@contextmanager
def folder_lock(out: Path, *, shared: bool = False) -> Iterator[None]:
    """Hold `out` for one whole run, or (`shared`) together with other parts; `UserError` when it is taken.

    The lock file is removed at the end of a whole run, so a finished folder holds none. A file system without
    locks is written without, with a warning. Even then nothing is torn: every file is renamed into place
    whole and every writer of one conversion writes the same bytes, so the loss is work done twice. A place
    that may only be read needs no lock: a finished set is found finished, and a write says what is wrong.
    """
    path = out / LOCK_FILE
    handle: int | None = None
    try:
        handle = _locked(path, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        raise UserError(
            f"{out}: another conversion is writing here; wait for it or choose another folder"
        ) from None
    except OSError as error:
        if error.errno not in _CANNOT_LOCK | _READ_ONLY:
            raise
        if error.errno in _CANNOT_LOCK:
            warnings.warn(
                f"{out}: this file system has no locks ({error.strerror}); "
                f"do not start a second conversion into this folder",
                stacklevel=3,
            )
    try:
        yield
    finally:
        # Removed while it is still held: who opened it before sees another file at its name, and opens again.
        if not shared and handle is not None:
            path.unlink(missing_ok=True)
        if handle is not None:
            os.close(handle)


def _locked(path: Path, operation: int) -> int:
    """An open, locked handle of `path`; `BlockingIOError` when it is taken."""
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        try:
            fcntl.flock(handle, operation)
        except OSError:
            os.close(handle)
            raise
        # The holder before us may have removed the file between our open and our lock.
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(handle), path.stat()):
                return handle
        os.close(handle)
