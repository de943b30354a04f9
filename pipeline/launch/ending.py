"""Ending processes that cannot end themselves: stopped ones, hung loader workers, orphans."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
import time
from pathlib import Path

_PROC = Path("/proc")
_LOOKS = 2.0
"""Seconds between two looks of a loader worker at whether its parent is still there."""


def birth_of(pid: int) -> str:
    """When a process began, in the system's own count; "" where it is gone or the system does not say."""
    fields = _stat(pid)
    return fields[19] if len(fields) > 19 else ""


def kill_stopped(pid: int, birth: str) -> None:
    """End a process of this machine that does not answer, unless its number is another process's by now."""
    if birth and birth_of(pid) == birth:
        with contextlib.suppress(OSError):
            os.kill(pid, signal.SIGKILL)


def kill_children() -> None:
    """End all processes that this one has started, and those that they have."""
    for pid in _descendants(os.getpid()):
        with contextlib.suppress(OSError):
            os.kill(pid, signal.SIGKILL)
    for child in multiprocessing.active_children():  # where there is no /proc
        child.kill()


def end_with_parent(parent: int, _worker: int = 0) -> None:
    """Have a loader worker end when its process, `parent`, has gone: also where it hangs in a read, or was
    still starting.

    torch's own look at the parent is between two batches only, and takes whoever is the parent by then.
    """
    threading.Thread(target=_watch_parent, args=(parent,), daemon=True).start()


def _watch_parent(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_LOOKS)
    os._exit(1)


def _stat(pid: int) -> list[str]:
    """The fields of /proc/PID/stat behind the name, of which the second is the parent."""
    try:
        return (_PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()
    except OSError:
        return []


def _descendants(pid: int) -> list[int]:
    parents: dict[int, list[int]] = {}
    if not _PROC.is_dir():
        return []
    for entry in _PROC.iterdir():
        if entry.name.isdigit() and len(fields := _stat(int(entry.name))) > 1:
            parents.setdefault(int(fields[1]), []).append(int(entry.name))
    found, todo = [], [pid]
    while todo:
        children = parents.get(todo.pop(), [])
        found += children
        todo += children
    return found
