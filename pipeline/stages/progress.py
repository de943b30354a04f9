"""What a person sees while a stage trains, and the log that a killed run continues without a gap."""

from __future__ import annotations

import errno
import json
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import Callback
from rich.console import Console
from rich.progress import Progress

from motionloom.datasets.base.progress import Pace, bar
from motionloom.models.training.stage_module import LOG_EVERY, StageModule
from motionloom.pipeline.stages.loggers import Loggers

_REDRAW = 0.1
"""Seconds between two states of the bar, which is drawn no more often."""


class StepProgress(Callback):
    """Steps done, loss, speed and time left: a bar on a terminal, a line every 15 s elsewhere."""

    def __init__(self, name: str, steps: int, console: Console, *, longer: bool = False) -> None:
        self.name, self.steps, self.console, self.longer = name, steps, console, longer
        self.progress: Progress | None = None
        self.pace = Pace(steps)
        self.first = 0
        self._next = 0.0

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Open the bar at the resumed step."""
        self.first = trainer.global_step
        self.pace = Pace(self.steps, self.first)
        if not trainer.is_global_zero:
            return
        if self.first and self.longer:
            self.console.print(f"    {self.name} goes on from step {self.first} to {self.steps}")
        elif self.first:
            self.console.print(f"    resuming {self.name} at step {self.first} of {self.steps}")
        self.progress = bar(self.console)
        self.progress.start()
        self.task = self.progress.add_task(self.name, total=self.steps, completed=self.first, note="")

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Move the bar, or print a line now and then."""
        if self.progress is None:
            return
        step, shown = trainer.global_step, self.console.is_terminal
        if not shown and not self.pace.due(step) and step < self.steps:
            return
        if shown and step < self.steps:
            now = time.monotonic()
            if now < self._next:  # a loss that is read is one that the GPU is waited for
                return
            self._next = now + _REDRAW
        loss = float(trainer.callback_metrics.get("loss", 0.0))
        note = f"loss {loss:.4f}  {self.pace.speed(step):.1f} steps/s"
        if shown:
            self.progress.update(self.task, completed=step, note=note)
        else:
            left = self.pace.left(step)
            self.console.print(f"    {self.name}: step {step}/{self.steps}  {note}{left and f'  {left}'}")

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Close the bar."""
        if self.progress is not None:
            self.progress.stop()

    def on_exception(
        self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException
    ) -> None:
        """Close the bar so that the error is readable."""
        if self.progress is not None:
            self.progress.stop()


class MetricLog(Callback):
    """`metrics.jsonl`: one row every 10 steps and one per validation; the loggers get the same rows.

    Rows are in the checkpoint, and the file gets those of a checkpoint that is on disk, so after a kill the
    log holds each step once. Loggers also get learning rates, gradient norms and the time of a step; the
    file is an output of the stage, and equal runs have equal ones.
    """

    def __init__(self, folder: Path, loggers: Loggers) -> None:
        self.path = folder / "metrics.jsonl"
        self.loggers = loggers
        self.rows: list[dict[str, float]] = []
        self.validates = True
        """Whether a validation that ends has a row: one that was cut short has none."""
        self._texts: list[tuple[str, str]] = []
        """Each row and what only the loggers get, as JSON: a checkpoint takes the text as it is."""
        self._written = 0
        """Rows in the file."""
        self._since = (0, 0.0)

    def state_dict(self) -> dict[str, Any]:
        """Rows so far, as text (plain types only in checkpoints)."""
        rows, gauges = (", ".join(text[place] for text in self._texts) for place in range(2))
        return {"rows": f"[{rows}]", "gauges": f"[{gauges}]"}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Rows up to the checkpoint."""
        self.rows = json.loads(state_dict["rows"])
        gauges = json.loads(state_dict.get("gauges", "[]")) or [{} for _ in self.rows]
        self._texts = [
            (json.dumps(row), json.dumps(more)) for row, more in zip(self.rows, gauges, strict=True)
        ]

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Open the loggers and the file with the rows up to the checkpoint."""
        self._since = (trainer.global_step, time.monotonic())
        if trainer.is_global_zero:
            gauges = (json.loads(more) for _, more in self._texts)
            rows = [row | more for row, more in zip(self.rows, gauges, strict=True)]
            self.loggers.open(trainer.global_step, rows)
            if self.rows or self.path.is_file():
                self._write()

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Validations and checkpoints do not count in the time of a step."""
        self._since = (trainer.global_step, time.monotonic())

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Take a row every 10 steps."""
        assert isinstance(pl_module, StageModule)
        step = trainer.global_step
        first, begin = self._since
        if step % LOG_EVERY == 0 and step > first and (not self.rows or self.rows[-1]["step"] < step):
            now = time.monotonic()
            gauges = {name: float(value) for name, value in pl_module.gauges.items()}
            self._since = (step, now)
            self._take(trainer, pl_module.row, gauges | {"step_seconds": (now - begin) / (step - first)})

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Take a row of validation figures."""
        if self.validates and not trainer.sanity_checking:
            self._take(trainer, [name for name in trainer.callback_metrics if name.startswith("val/")], {})

    def saved(self, step: int) -> None:
        """Bring the file up to a checkpoint that is on disk; only the lead has one."""
        count = len(self.rows)
        while count > self._written and self.rows[count - 1]["step"] > step:
            count -= 1
        self.path.parent.mkdir(parents=True, exist_ok=True)
        _append(self.path, self._lines(self._written, count).encode())
        self._written = count
        self.loggers.save(step)

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Write the file as a whole: an output is complete or absent."""
        if trainer.is_global_zero:
            self._write()
            self.loggers.save(trainer.global_step)
            self.loggers.close("success")

    def on_exception(
        self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException
    ) -> None:
        """Close the loggers; rows that no checkpoint holds come again when the run goes on."""
        if trainer.is_global_zero:
            self.loggers.close("failed")

    def _take(self, trainer: L.Trainer, names: Sequence[str], gauges: dict[str, float]) -> None:
        values = {name: float(trainer.callback_metrics[name]) for name in names}
        if values:
            self.rows.append({"step": trainer.global_step, **values})
            self._texts.append((json.dumps(self.rows[-1]), json.dumps(gauges)))
            if trainer.is_global_zero:
                self.loggers.take(self.rows[-1] | gauges)

    def _lines(self, first: int, last: int) -> str:
        return "".join(json.dumps(row, sort_keys=True) + "\n" for row in self.rows[first:last])

    def _write(self) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        temporary = self.path.with_name(".metrics.jsonl.tmp")
        temporary.write_text(self._lines(0, len(self.rows)), encoding="utf-8")
        temporary.replace(self.path)
        self._written = len(self.rows)


def _append(path: Path, lines: bytes) -> None:
    """All of them or none, for whoever reads meanwhile."""
    with path.open("ab", buffering=0) as file:
        size = file.seek(0, 2)
        if file.write(lines) != len(lines):
            file.truncate(size)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
