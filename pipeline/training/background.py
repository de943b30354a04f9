"""Checkpoints are written beside the training: serialised, hashed, synced and renamed in a thread."""

from __future__ import annotations

import copy
import re
import threading
from collections.abc import Callable, Iterable
from pathlib import Path

import torch
from torch import Tensor, UntypedStorage

from motionloom.datasets.base.files import sync_folder
from motionloom.pipeline.training.checkpointing import require_written, write_checkpoint

_NAME = re.compile(r"step=(\d+)\.ckpt")


class BackgroundWriter:
    """Writes the checkpoints of one training, one at a time, and deletes those that are no longer kept.

    The state is copied when `write` is called. An older file is deleted only once the newer one is under its
    name with its whole length and its seal. An error of the thread is raised by the next call of any method.
    """

    def __init__(self, *, keep: int, keep_every: int = 0, since: int | None = None) -> None:
        self.keep, self.keep_every = keep, keep_every
        self.since = -1 if since is None else since
        """Step that the training goes on from; -1 for none."""
        self.written: set[int] = set()
        """Steps whose checkpoints this training has written."""
        self._thread: threading.Thread | None = None
        self._error: BaseException | None = None

    def write(self, state: object, path: Path) -> None:
        """Copy the state now and write it meanwhile; waits for the one before."""
        self.finish()
        snapshot = Snapshot(state)
        # No daemon: a process that ends by itself finishes the file.
        self._thread = threading.Thread(target=self._run, args=(snapshot, path), name="checkpoint")
        self._thread.start()

    @property
    def busy(self) -> bool:
        return self._thread is not None and self._thread.is_alive()

    def finish(self) -> None:
        """Wait until what is being written is on disk.

        Raises:
            UserError: It could not be written.
        """
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._error is not None:
            error, self._error = self._error, None
            raise error

    def _run(self, snapshot: Snapshot, path: Path) -> None:
        try:
            size = write_checkpoint(snapshot.content, path)
            require_written(path, size)
            self.written.add(step_of(path) or 0)
            for old in superseded(path.parent.iterdir(), path, self):
                old.unlink(missing_ok=True)
            sync_folder(path.parent)
        except BaseException as error:  # raised again where the training sees it
            self._error = error


def name_of(step: int) -> str:
    """File name of a checkpoint."""
    return f"step={step:08d}.ckpt"


def step_of(path: Path) -> int | None:
    """Step of a checkpoint's file name; None of any other file."""
    found = _NAME.fullmatch(path.name)
    return int(found[1]) if found else None


def superseded(paths: Iterable[Path], newest: Path, writer: BackgroundWriter) -> list[Path]:
    """Checkpoints that need not be kept any more, now that `newest` is written.

    What lies between the checkpoint that the training goes on from and the newest one and was not written by
    it is damaged: it was passed over. What lies behind the newest is written again when training gets there.
    """
    steps = {step: path for path in paths if (step := step_of(path)) is not None}
    last = step_of(newest)
    assert last is not None
    sound = sorted(
        step for step in steps if step <= last and (step <= writer.since or step in writer.written)
    )
    kept = set(sound[-writer.keep :])
    if writer.keep_every:
        kept |= {step for step in sound if step % writer.keep_every == 0}
    return [steps[step] for step in sorted(steps) if step <= last and step not in kept]


_UNCHANGING = frozenset({bool, int, float, str, bytes})


class Snapshot:
    """Plain containers and tensors, copied to the memory of the host.

    Tensors that share memory share it in the copy too, so that a file written from it has the bytes of one
    written from the state itself. Copies from a GPU run in the order of its other work, so what is trained
    next does not change them, and this process need not wait for them: whoever reads `content` does.
    """

    def __init__(self, state: object) -> None:
        self._storages: dict[int, UntypedStorage] = {}
        self._copied: list[Callable[[], None]] = []
        self._devices: set[torch.device] = set()
        self._content = self._copy(state)
        for device in self._devices:
            event = torch.cuda.Event()  # type: ignore[no-untyped-call]
            event.record(torch.cuda.current_stream(device))
            self._copied.append(event.synchronize)
        self._storages = {}

    @property
    def content(self) -> object:
        for wait in self._copied:
            wait()
        return self._content

    def _copy(self, value: object) -> object:
        if value is None or type(value) in _UNCHANGING:
            return value
        if isinstance(value, Tensor):
            return self._tensor(value.detach())
        if isinstance(value, dict):
            out = copy.copy(value)  # an OrderedDict stays one, and keeps what torch notes on it
            for key, inner in value.items():
                out[key] = self._copy(inner)
            return out
        if isinstance(value, list):
            return [self._copy(inner) for inner in value]
        if type(value) is tuple:
            return tuple(self._copy(inner) for inner in value)
        return copy.deepcopy(value)

    def _tensor(self, value: Tensor) -> Tensor:
        storage = value.untyped_storage()
        there = storage._cdata
        if there not in self._storages:
            self._storages[there] = self._storage(storage)
        out = torch.empty(0, dtype=value.dtype)
        out.set_(self._storages[there], value.storage_offset(), value.size(), value.stride())
        return out

    def _storage(self, storage: UntypedStorage) -> UntypedStorage:
        gpu = storage.device.type == "cuda"
        if gpu:
            self._devices.add(storage.device)
        out = torch.empty(storage.nbytes(), dtype=torch.uint8, pin_memory=gpu).untyped_storage()
        out.copy_(storage, non_blocking=gpu)
        return out
