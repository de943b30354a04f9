"""When a training saves, and what a resumed one needs to go on in the middle of a chunk.

A chunk is `checkpoint_every` steps. A checkpoint is written at the end of each, and at any step where the
training is interrupted. It is written beside the training (`store/background.py`); the log on disk follows
once the checkpoint is whole, so it never shows a step that a kill would take back.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import lightning as L
import torch
import torch.distributed as dist
from lightning.fabric.plugins.io.torch_io import TorchCheckpointIO
from lightning.pytorch.callbacks import Callback

from motionloom.datasets.schema import UserError
from motionloom.models.training.stage_module import RowMeans, StageModule
from motionloom.pipeline.flight.waits import Waits
from motionloom.pipeline.stages.train_config import TrainConfig
from motionloom.pipeline.store.background import BackgroundWriter, name_of

ROW = "row"
"""Key of a checkpoint: means of the log's next row so far, of each rank. Absent at the end of a chunk."""


class SealedCheckpoints(TorchCheckpointIO):
    """Lightning's way to checkpoints, with our writer. `readable` verifies before Lightning loads."""

    def __init__(self, writer: BackgroundWriter) -> None:
        super().__init__()
        self.writer = writer

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None
    ) -> None:
        """Copy the state and write it sealed meanwhile; only the lead is asked to."""
        self.writer.write(checkpoint, Path(path))


class Checkpoints(Callback):
    """Saves at the end of every chunk, and tells `saved` the step of each checkpoint that is on disk."""

    def __init__(
        self, folder: Path, writer: BackgroundWriter, waits: Waits, saved: Callable[[int], None]
    ) -> None:
        self.folder, self.writer, self.waits, self.saved = folder, writer, waits, saved
        self._last = -1
        self._writing: int | None = None

    def save(self, trainer: L.Trainer, *, again: bool = False) -> None:
        """Save this step, unless it is saved (`again`: in any case); every rank must ask."""
        step = trainer.global_step
        if step == self._last and not again:
            return
        with self.waits.for_checkpoints():
            self.finish()
            trainer.save_checkpoint(self.folder / name_of(step), weights_only=False)
        self._last = step
        self._writing = step if trainer.is_global_zero else None

    def finish(self) -> None:
        """Wait until what is being written is on disk; `UserError` where it could not be written."""
        self.writer.finish()
        if self._writing is not None:
            step, self._writing = self._writing, None
            self.saved(step)

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """The step that the training goes on from is saved."""
        self._last = trainer.global_step

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Notice what has been written meanwhile, or could not be."""
        if self._writing is not None and not self.writer.busy:
            self.finish()

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Save the chunk."""
        self.save(trainer)

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """The training is over when its last checkpoint is on disk."""
        with self.waits.for_checkpoints():
            self.finish()

    def on_exception(
        self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException
    ) -> None:
        """Let what is being written end; the exception says more than one of the writing."""
        with suppress(UserError, OSError):
            self.finish()


class ResumeBetweenChunks(Callback):
    """Makes a resumed run begin at the step behind its checkpoint, in the chunk that step belongs to.

    Lightning's own counters are one behind where a step ends, and it would go back into a finished epoch and,
    where that did not end with a validation, train one more batch in it: the steps of all later validations
    and checkpoints would move. They follow from the step and the length of a chunk, so they are set anew.

    Keeps in the checkpoint how the training was cut into chunks, for `start_of`, and the means of the log's
    next row, which go on in the middle of a chunk and begin anew with one.
    """

    def __init__(self, config: TrainConfig, chunk: int, batches: int) -> None:
        self.steps, self.every, self.chunk = config.steps, config.checkpoint_every, chunk
        self.batches = batches
        """Batches that Lightning sees in a step."""
        self._rows: list[RowMeans] = []

    def state_dict(self) -> dict[str, Any]:
        """Length of the training, the interval that its config names, and the one in use."""
        return {"steps": self.steps, "every": self.every, "chunk": self.chunk}

    def on_save_checkpoint(
        self, trainer: L.Trainer, pl_module: L.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """In the middle of a chunk: gather what every rank has added to the next row."""
        # Also of a step that is saved once more, behind the validation that was made up for.
        checkpoint["epoch"] = max(0, trainer.global_step - 1) // self.chunk
        if trainer.global_step % self.chunk == 0:
            return
        assert isinstance(pl_module, StageModule)
        rows: list[Any] = [pl_module.row_means()]
        if trainer.world_size > 1:
            rows = rows * trainer.world_size
            dist.all_gather_object(rows, pl_module.row_means())
        checkpoint[ROW] = rows

    def on_load_checkpoint(
        self, trainer: L.Trainer, pl_module: L.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Set Lightning's counters to where the checkpoint's step lies."""
        step = int(checkpoint["global_step"])
        chunks, done = divmod(step, self.chunk)
        loop = checkpoint["loops"]["fit_loop"]
        for progress in (loop["epoch_progress"]["total"], loop["epoch_progress"]["current"]):
            progress.update(dict.fromkeys(("ready", "started"), chunks + (done > 0)))
            progress.update(dict.fromkeys(("processed", "completed"), chunks))
        batches = loop["epoch_loop.batch_progress"]
        batches["total"] = dict.fromkeys(batches["total"], step * self.batches)
        batches["current"] = dict.fromkeys(batches["current"], done * self.batches)
        batches["is_last_batch"] = False
        loop["epoch_loop.state_dict"]["_batches_that_stepped"] = step
        self._rows = checkpoint.get(ROW, []) if done else []

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Go on with the row of the log that the checkpoint lies in."""
        assert isinstance(pl_module, StageModule)
        if not self._rows:
            return
        if len(self._rows) == trainer.world_size:
            pl_module.go_on_with_row(self._rows[trainer.global_rank])
        else:  # as many means as there were ranks: their mean stands for each
            pl_module.go_on_with_row(_mean(self._rows))
        self._rows = []


def _mean(rows: list[RowMeans]) -> RowMeans:
    """Of several ranks', which have the same names and counts."""
    first = rows[0]
    return [
        {**means, "sums": torch.stack([row[place]["sums"] for row in rows]).mean(0)}
        for place, means in enumerate(first)
    ]
