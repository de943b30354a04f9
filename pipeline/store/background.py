"""Checkpoints are written beside the training: serialised, hashed, synced and renamed in a thread."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from motionloom.datasets.base.files import sync_folder
from motionloom.pipeline.store.checkpoints import require_written, write_checkpoint
from motionloom.pipeline.store.snapshot import Snapshot

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

    def write(self, state: dict[str, Any], path: Path) -> None:
        """Copy the state now and write it meanwhile; waits for the one before."""
        self.finish()
        snapshot = Snapshot(state)
        # No daemon: a process that ends by itself finishes the file.
        self._thread = threading.Thread(target=self._run, args=(snapshot, path), name="checkpoint")
        self._thread.start()

    @property
    def busy(self) -> bool:
        """Whether a checkpoint is being written."""
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
