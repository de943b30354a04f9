"""Checkpoints of a training on disk: whole or absent, and every flipped bit is found before one is used.

A checkpoint is what `torch.save` writes, followed by a *seal* of 84 bytes:

    \\nmotionloom sha256 <64 hex digits of everything before it>\\n

One file says both, so that no kill, copy or deletion can part a checkpoint from its checksum. torch ignores
bytes behind its archive, so older versions read newer checkpoints. The content names its seal too (key
`sealed`): a file whose seal was cut off or damaged is never taken for one of an older version, which had
none. Those are accepted after a complete load, as they were when they were written: a training of many days
should outlive an upgrade.

The seal finds damage; it is no signature. Whoever can write the file can seal it, so content is only ever
unpickled with `weights_only=True`.
"""

from __future__ import annotations

import hashlib
import re
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any, BinaryIO, cast

import torch

from motionloom.datasets.base.files import HashingFile, atomic_file
from motionloom.datasets.schema import UserError

_SEAL = re.compile(rb"\nmotionloom sha256 ([0-9a-f]{64})\n")
_SEAL_BYTES = 84
_SEALED = "sealed"
_BLOCK = 1 << 20


class DamagedError(Exception):
    """A checkpoint that must not be used; the message is the reason."""


def write_checkpoint(checkpoint: dict[str, Any], path: Path) -> int:
    """Write `checkpoint` and its seal: hashed on the way, synced, then renamed into place; the file's size.

    Raises:
        UserError: The file could not be written (a full disk, most often); nothing half-written stays.
    """
    failure: OSError | None = None
    try:
        with atomic_file(path) as file:
            sink = _Sink(file)
            try:
                torch.save({**checkpoint, _SEALED: True}, cast(IO[bytes], sink))
            finally:
                failure = sink.failure
            file.write(b"\nmotionloom sha256 %s\n" % sink.hexdigest.encode())
            return file.tell()
    except (OSError, RuntimeError) as error:
        # torch answers a failed write with an error about its own position in the file.
        cause = error if isinstance(error, OSError) else failure
        if cause is None:
            raise
        raise UserError(_unwritten(path, cause.strerror or str(cause))) from error


def require_written(path: Path, size: int) -> None:
    """Refuse a file that was written without an error and yet is not there with its length and its seal.

    A network file system may lose what it has taken. The bytes between are compared before they are used.

    Raises:
        UserError: It is not there, or shorter, or ends in something else.
    """
    try:
        with path.open("rb") as file:
            sound = file.seek(0, 2) == size
            file.seek(max(0, size - _SEAL_BYTES))
            sound = sound and _SEAL.fullmatch(file.read()) is not None
    except OSError as error:
        raise UserError(_unwritten(path, error.strerror or str(error))) from error
    if not sound:
        raise UserError(_unwritten(path, "what was written is not there when it is read"))


def _unwritten(path: Path, why: str) -> str:
    return (
        f"{path}: the checkpoint cannot be written ({why}); those before it are intact: make room, and start "
        f"the same command again to go on from the newest"
    )


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Content of a checkpoint that is as it was written; the tensors of a sealed one stay on disk until used.

    Raises:
        DamagedError: It is cut short, changed, or no checkpoint.
    """
    try:
        sealed = _check_seal(path)
        content = torch.load(path, map_location="cpu", weights_only=True, mmap=sealed)
    except DamagedError:
        raise
    except Exception as error:  # a torn file fails in many ways, all of which mean the same
        raise DamagedError(f"cannot be read ({type(error).__name__})") from None
    if not isinstance(content, dict):
        raise DamagedError(f"holds a {type(content).__name__} and no checkpoint")
    if _SEALED in content and not sealed:
        raise DamagedError("its end with the checksum is cut off or damaged")
    return content


def readable(
    folder: Path, say: Callable[[str], None] = warnings.warn
) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Sound checkpoints of a folder and their content, newest first; `say` is given why others are not."""
    for path in sorted(folder.glob("*.ckpt"), reverse=True):
        try:
            content = read_checkpoint(path)
        except DamagedError as error:
            say(f"{path}: {error}; passed over for the checkpoint before it")
            continue
        yield path, content


def newest_checkpoint(folder: Path) -> Path | None:
    """The newest checkpoint that is as it was written; a torn one is passed over."""
    return next((path for path, _ in readable(folder)), None)


class _Sink(HashingFile):
    """A file for `torch.save` that hashes what is written and remembers why it could not be."""

    def __init__(self, file: BinaryIO) -> None:
        super().__init__(file)
        self.failure: OSError | None = None

    def write(self, data: bytes) -> int:
        """Write and hash."""
        try:
            return super().write(data)
        except OSError as error:
            self.failure = self.failure or error
            raise

    def flush(self) -> None:
        """Nothing: the file is synced before it gets its name."""


def _check_seal(path: Path) -> bool:
    """False where there is no seal; with one that is not the content's, `DamagedError`."""
    with path.open("rb") as file:
        size = file.seek(0, 2) - _SEAL_BYTES
        if size < 0:
            return False
        file.seek(size)
        seal = _SEAL.fullmatch(file.read())
        if seal is None:
            return False
        file.seek(0)
        found, block = hashlib.sha256(), memoryview(bytearray(_BLOCK))
        while size > 0:
            count = file.readinto(block[: min(size, _BLOCK)])
            if not count:
                raise DamagedError("became shorter while it was read")
            found.update(block[:count])
            size -= count
    if found.hexdigest().encode() != seal[1]:
        raise DamagedError("the bytes are not those that were written: their sha256 is another")
    return True
