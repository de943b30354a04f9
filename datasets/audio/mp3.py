"""What is peculiar to MP3: its length is a guess, libsndfile reads damaged ones without complaint, and
libmpg123, which decodes them for it, writes of each fault to standard error.

For that libsndfile has no switch: hundreds of lines for a folder of damaged files. So the process's standard
error goes through a pipe while a sound is open, and a thread passes on what is not libmpg123's.
"""

from __future__ import annotations

import os
import re
import shutil
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

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
    own = os.dup(_STDERR)
    onward = os.dup(_STDERR)
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


@contextmanager
def sending_pipe(path: Path) -> Iterator[int]:
    """The reading end of a pipe through which a thread sends an MP3, without its tag: of a pipe libsndfile
    skips 50 kB of it at most.
    """
    out, into = os.pipe()

    def send() -> None:
        with suppress(BrokenPipeError), path.open("rb") as source, os.fdopen(into, "wb") as target:
            source.seek(tag_bytes(source))
            shutil.copyfileobj(source, target)

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield out
    finally:
        os.close(out)
        thread.join()


def bytes_left(end: int) -> int:
    """Bytes in a pipe behind which a decoder has stopped at damage: frames, whose heads stand 1,441 bytes
    apart at most. 0 where nothing is left, or a picture behind the sound, which has hardly any.
    """
    with open(end, "rb", closefd=False) as left:
        rest = left.read()
    heads = max(rest.count(bytes([0xFF, kind])) for kind in (0xFA, 0xFB, 0xF2, 0xF3, 0xE2, 0xE3))
    return len(rest) if heads * 2000 > len(rest) > 4000 else 0


def tag_bytes(file: BinaryIO) -> int:
    """Length of the ID3 tag, which may hold a picture, before the first frame of an MP3; 0 without one."""
    file.seek(0)
    head = file.read(10)
    # The length is four bytes of seven bits; the fourth flag says that the header is repeated at the end.
    length = sum((byte & 127) << 7 * (3 - i) for i, byte in enumerate(head[6:]))
    return 0 if head[:3] != b"ID3" or len(head) < 10 else 10 + length + (10 if head[5] & 16 else 0)


def missing_bytes(file: BinaryIO, size: int) -> int:
    """Return the bytes an MP3 lacks of its stated length, or 0; libsndfile fills them with silence."""
    start = tag_bytes(file)
    file.seek(start)
    frame = file.read(256)
    at = max(frame.find(b"Xing"), frame.find(b"Info"))
    if at < 0 or frame[:1] != b"\xff" or len(frame) < at + 16:
        return 0
    flags, _, stated = struct.unpack(">III", frame[at + 4 : at + 16])
    return int(stated) - (size - start) if flags & 3 == 3 else 0
