"""Who may write in a folder: one whole run, or any number of parts of one conversion.

A lock file rather than the folder itself, because over NFS an exclusive lock needs a file open for writing.
The kernel frees the lock when the process dies. Limits: `flock` reaches other machines on NFS only from Linux
2.6.12 on and with a lock service, on Lustre only with `-o flock`; a file system without locks is written
without, with a warning. Even then nothing is torn: every file is renamed into place whole and every writer of
one conversion writes the same bytes, so the loss is work done twice.
"""

from __future__ import annotations

import errno
import fcntl
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from motionloom.datasets.schema import UserError

LOCK_FILE = ".lock"
_CANNOT_LOCK = {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP}


@contextmanager
def folder_lock(out: Path, *, shared: bool = False) -> Iterator[None]:
    """Hold `out` for one whole run, or (`shared`) together with other parts; `UserError` when it is taken.

    The lock file is removed at the end of a whole run, so a finished folder holds none.
    """
    path = out / LOCK_FILE
    handle = _lock(path, shared)
    try:
        yield
    finally:
        if not shared:
            path.unlink(missing_ok=True)
        os.close(handle)


def _lock(path: Path, shared: bool) -> int:
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(handle, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(handle)
            raise UserError(
                f"{path.parent}: another conversion is writing here; wait for it or choose another folder"
            ) from None
        except OSError as error:
            if error.errno not in _CANNOT_LOCK:
                os.close(handle)
                raise
            warnings.warn(
                f"{path.parent}: this file system has no locks ({error.strerror}); "
                f"do not start a second conversion into this folder",
                stacklevel=2,
            )
            return handle
        # The holder before us may have removed the file between our open and our lock.
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(handle), path.stat()):
                return handle
        os.close(handle)
