"""What libmpg123 says of damaged MP3 on standard error, kept from the terminal: hundreds of lines a folder.

libsndfile gives no way to its option of silence. So the process's standard error goes through a pipe while a
sound is open, and a thread passes on what is not libmpg123's.
"""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

_STDERR = 2
_NOTE = re.compile(rb"\s*(Note|Warning|Error): |.{0,20}\[src/libmpg123/|\n")
"""How its lines begin; those of Python's own warnings name a file first."""

_lock = threading.Lock()
_open = 0
"""Sounds that are open in any thread; the first turns standard error aside, the last turns it back."""
_aside: tuple[int, threading.Thread] | None = None


@contextmanager
def unheard() -> Iterator[None]:
    """Keep libmpg123's lines from standard error, and no other ones."""
    global _open, _aside
    with _lock:
        if _open == 0:
            with suppress(OSError):  # without a standard error there is nothing to keep clean
                _aside = _turn_aside()
        _open += 1
    try:
        yield
    finally:
        with _lock:
            _open -= 1
            if _open == 0 and _aside is not None:
                own, thread = _aside
                os.dup2(own, _STDERR)
                os.close(own)
                _aside = None
                thread.join(1)  # a process that was started meanwhile has the pipe for longer


def _turn_aside() -> tuple[int, threading.Thread]:
    """A copy of standard error, which is a pipe from now on, and the thread that empties that."""
    own, onward = os.dup(_STDERR), os.dup(_STDERR)
    out, into = os.pipe()
    os.dup2(into, _STDERR)
    os.close(into)
    thread = threading.Thread(target=_pass_on, args=(out, onward), daemon=True)
    thread.start()
    return own, thread


def _pass_on(out: int, onward: int) -> None:
    """Write the lines of a pipe that are not libmpg123's, until all have closed it."""
    with os.fdopen(out, "rb") as lines, os.fdopen(onward, "wb", buffering=0) as target:
        for line in lines:
            if not _NOTE.match(line):
                with suppress(OSError):
                    target.write(line)
