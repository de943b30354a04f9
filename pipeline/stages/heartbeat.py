"""What a training says of its progress to the watch of its process (`launch/watch.py`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import Callback

from motionloom.pipeline.launch import watch

_READING, _STEPPING = "waiting for a batch", "computing a step"
_VALIDATING, _SAVING = "validating", "saving a checkpoint"


class Heartbeat(Callback):
    """Notes every batch, validation batch and checkpoint; a lone process gets a watch of its own."""

    def __init__(self, name: str, folder: Path, stall_seconds: int) -> None:
        self.name, self.folder, self.stall_seconds = name, folder, stall_seconds
        self._own = False

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """From here on progress is expected."""
        mine = watch.current()
        if mine is None and trainer.world_size == 1 and self.stall_seconds:
            mine, self._own = watch.begin(watch.Watch(0, self.stall_seconds)), True
        if mine is not None:
            mine.enter_stage(self.name, self.folder, _READING)
        self._note(_READING, trainer)

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """What came between two chunks is over."""
        self._note(_READING, trainer)

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """The batch is here."""
        self._note(_STEPPING, trainer)

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """A step, or a part of one, is done."""
        self._note(_READING, trainer)

    def on_validation_batch_start(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """A validation goes on."""
        self._note(_VALIDATING, trainer)

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """A validation is over."""
        self._note(_READING, trainer)

    def on_save_checkpoint(
        self, trainer: L.Trainer, pl_module: L.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """A checkpoint is written."""
        self._note(_SAVING, trainer, alike=False)  # only some processes may write

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """No more steps; what follows takes as long as it takes."""
        self._rest()

    def on_exception(
        self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException
    ) -> None:
        """No more steps."""
        self._rest()

    @staticmethod
    def _note(phase: str, trainer: L.Trainer, *, alike: bool = True) -> None:
        mine = watch.current()
        if mine is not None:
            mine.progress(phase, trainer.global_step, alike=alike)

    def _rest(self) -> None:
        mine = watch.current()
        if mine is not None:
            mine.rest("after its last step")
        if self._own:
            watch.end()
            self._own = False
