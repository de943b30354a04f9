"""Checkpoints: what they hold, and files in which every flipped bit is found before use.

Weights and optimizers are stored whole, in the format of one process, also by FSDP: a training may be resumed
with another strategy or number of processes.

A file is what `torch.save` writes, followed by a *seal* of 84 bytes, so that no kill, copy or deletion can
part a checkpoint from its checksum:

    \\nmotionloom sha256 <64 hex digits of everything before it>\\n

The seal finds damage; it is no signature. Whoever can write the file can seal it, so content is only ever
unpickled with `weights_only=True`.
"""

from __future__ import annotations

import hashlib
import re
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import IO, Any, BinaryIO, TypedDict, cast

import torch
import torch.distributed as dist
from lightning.pytorch.plugins.io import CheckpointIO
from rich.console import Console
from torch import Tensor

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import HashingFile, atomic_file, remove_temporaries, sync_folder
from motionloom.datasets.base.json_doors import require_plain
from motionloom.datasets.base.os_errors import naming, of_the_machine
from motionloom.models.training.distributed import rank, world_size
from motionloom.models.training.stage_module import Means, StageModule
from motionloom.pipeline.training.metric_log import LogState

_Lightning = TypedDict("_Lightning", {"pytorch-lightning_version": str, "epoch": int})
"""Keys of Lightning's that are no names."""


class Checkpoint(_Lightning):
    """Everything that continues a training after a step: what a Trainer saves, and our callbacks add."""

    global_step: int
    state_dict: dict[str, Tensor]
    steps: int
    """Steps of the training that wrote it."""
    average: dict[str, Tensor] | None
    log: LogState
    row: list[list[Means]]
    """Means of the log's next row so far, of each rank."""
    hyper_parameters: dict[str, Any]
    """Plain values that rebuild the module: `trained_stage.hyper_parameters`."""
    validate: bool
    """Whether a signal cut the validation of this step short: the resumed training begins with it."""


def rows_of_ranks(module: StageModule) -> list[list[Means]]:
    """Return the sums of each rank for the next row of the log; a collective."""
    rows = [module.row_state()] * world_size()
    if world_size() > 1:
        dist.all_gather_object(rows, module.row_state())
    return rows


def load_row(module: StageModule, rows: Sequence[list[Means]]) -> None:
    """Restore the sums of the log's row; with another number of ranks each gets the mean over all."""
    if len(rows) == world_size():
        module.load_row(rows[rank()])
        return
    module.load_row(
        [
            {**means, "sums": torch.stack([row[place]["sums"] for row in rows]).mean(0)}
            for place, means in enumerate(rows[0])
        ]
    )


# Files.

_NAME = re.compile(r"step=(\d+)\.ckpt")
_SEAL = re.compile(rb"\nmotionloom sha256 ([0-9a-f]{64})\n")
_SEAL_BYTES = 84
_BLOCK = 1 << 20


class DamagedError(Exception):
    """A checkpoint that must not be used; the message is the reason."""


def name_of(step: int) -> str:
    """File name of a checkpoint."""
    return f"step={step:08d}.ckpt"


def step_of(path: Path) -> int | None:
    """Step of a checkpoint's file name; None of any other file."""
    match = _NAME.fullmatch(path.name)
    return int(match[1]) if match else None


class BackgroundWriter(CheckpointIO):
    """Writes the checkpoints of one training in a thread, one at a time, and deletes those not kept any more.

    A Trainer that has it as a plugin saves and reads by it.

    The state is copied when `write` is called. An older file is deleted only once the newer one is on disk.
    An error of the thread is raised by the next call of any method.
    """

    def __init__(self, *, keep: int, keep_every: int = 0) -> None:
        self.keep = keep
        self.keep_every = keep_every
        self._thread: threading.Thread | None = None
        self._error: BaseException | None = None

    def write(self, state: object, path: Path) -> None:
        """Copy the state and write it in the background; waits until the file before it is written."""
        self.finish()
        # No daemon: a process that ends by itself finishes the file.
        self._thread = threading.Thread(target=self._run, args=(snapshot(state), path), name="checkpoint")
        self._thread.start()

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: object = None
    ) -> None:
        self.write(checkpoint, Path(path))

    def load_checkpoint(
        self, path: str | Path, map_location: object = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        return cast(dict[str, Any], read_checkpoint(Path(path)))

    def remove_checkpoint(self, path: str | Path) -> None:
        Path(path).unlink(missing_ok=True)

    @property
    def busy(self) -> bool:
        return self._thread is not None and self._thread.is_alive()

    def finish(self) -> None:
        """Wait until the file is on disk; `UserError` if it could not be written."""
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._error is not None:
            error = self._error
            self._error = None
            raise error

    def _run(self, state: object, path: Path) -> None:
        try:
            write_checkpoint(state, path)
            # What lies behind the newest is written again when training gets there.
            older = sorted(old for old in path.parent.iterdir() if _NAME.fullmatch(old.name) and old <= path)
            for old in older[: -self.keep]:
                if not self.keep_every or (step_of(old) or 0) % self.keep_every:
                    old.unlink(missing_ok=True)
            sync_folder(path.parent)
        except BaseException as error:  # raised again where the training sees it
            self._error = error


def snapshot(value: object) -> object:
    """Return a copy of plain containers and tensors in host memory."""
    if isinstance(value, Tensor):
        return value.detach().to("cpu", copy=True)
    if isinstance(value, dict):
        return {key: snapshot(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(snapshot(inner) for inner in value)
    return value


def write_checkpoint(checkpoint: object, path: Path) -> None:
    """Write `checkpoint` and its seal: hashed as it is written, synced, then renamed into place.

    Raises:
        UserError: The file could not be written (a full disk, most often); nothing half-written stays.
    """
    failure: OSError | None = None
    try:
        with atomic_file(path) as file:
            sink = _Sink(file)
            try:
                torch.save(checkpoint, cast(IO[bytes], sink))
            finally:
                failure = sink.failure
            file.write(b"\nmotionloom sha256 %s\n" % sink.hexdigest.encode())
    except (OSError, RuntimeError) as error:
        # torch answers a failed write with an error about its own position in the file.
        cause = error if isinstance(error, OSError) else failure
        if cause is None:
            raise
        raise UserError(
            f"{path}: the checkpoint cannot be written ({cause.strerror or cause}); those before it are "
            f"intact: mend that, and start the same command again to go on from the newest"
        ) from error


def read_checkpoint(path: Path) -> Checkpoint:
    """Return the content of a checkpoint, its tensors mapped from disk; `DamagedError` if it is damaged.

    A disk or a memory that fails, or a forbidden file, says nothing of it: those errors pass.
    """
    try:
        _check_seal(path)
        content = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except DamagedError:
        raise
    except Exception as error:  # a torn file fails in many ways, all of which mean the same
        if isinstance(error, PermissionError) or of_the_machine(error):
            raise
        raise DamagedError(f"cannot be read ({type(error).__name__})") from None
    if not isinstance(content, dict):
        raise DamagedError(f"holds a {type(content).__name__} and no checkpoint")
    return cast(Checkpoint, content)


def readable(folder: Path, say: Callable[[str], None] = warnings.warn) -> Iterator[tuple[Path, Checkpoint]]:
    """Yield undamaged checkpoints and their content, newest first; `say` gets the faults of the others."""
    for path in sorted(folder.glob("*.ckpt"), reverse=True):
        try:
            content = read_checkpoint(path)
        except DamagedError as error:
            say(f"{path}: {error}; passed over for the checkpoint before it")
            continue
        yield path, content


def find_resume_point(folder: Path, console: Console) -> Path | None:
    """Return the newest checkpoint that can be read; temporary and damaged files are deleted."""
    if folder.is_dir():
        remove_temporaries(folder)
    say = partial(console.print, style="yellow", markup=False, soft_wrap=True)
    newest = next((path for path, _ in readable(folder, say)), None)
    for path in folder.glob("*.ckpt"):
        if newest is not None and (step_of(path) or 0) > (step_of(newest) or 0):
            path.unlink()  # damaged: the training writes this step again
    return newest


class _Sink(HashingFile):
    """A file for `torch.save` that hashes what is written and remembers why it could not be."""

    def __init__(self, file: BinaryIO) -> None:
        super().__init__(file)
        self.failure: OSError | None = None

    def write(self, data: bytes) -> int:
        try:
            return super().write(data)
        except OSError as error:
            self.failure = self.failure or error
            raise

    def flush(self) -> None:
        """Nothing: the file is synced before it gets its name."""


def _check_seal(path: Path) -> None:
    require_plain(path)
    with naming(path), path.open("rb") as file:
        # The seal comes last, so a file that was cut short has none, wherever it was cut.
        size = file.seek(0, 2) - _SEAL_BYTES
        file.seek(max(0, size))
        seal = _SEAL.fullmatch(file.read())
        if seal is None:
            raise DamagedError("its end with the checksum is cut off or damaged")
        file.seek(0)
        digest = hashlib.sha256()
        block = memoryview(bytearray(_BLOCK))
        while size > 0:
            count = file.readinto(block[: min(size, _BLOCK)])
            if not count:
                raise DamagedError("became shorter while it was read")
            digest.update(block[:count])
            size -= count
    if digest.hexdigest().encode() != seal[1]:
        raise DamagedError("the bytes are not those that were written: their sha256 is another")
