"""The progress bar of a training, and its log, which a killed run continues without a gap."""

from __future__ import annotations

import errno
import json
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TypedDict

from rich.console import Console
from rich.progress import Progress
from torch import Tensor

from motionloom.datasets.base.files import write_text
from motionloom.datasets.base.progress import Pace, bar
from motionloom.models.training.distributed import rank
from motionloom.pipeline.store.files import open_own
from motionloom.pipeline.store.training_log import FILE_NAME
from motionloom.pipeline.training.loggers import Loggers

_REDRAW = 0.1
"""Seconds between two states of the bar, which is drawn no more often."""

Row = dict[str, float]
"""Figures by name, and "step"."""


class StepProgress:
    """Steps done, loss, speed and time left: a bar on a terminal, a line every 15 s elsewhere; the lead's."""

    def __init__(self, name: str, first: int, steps: int, console: Console) -> None:
        self.name, self.steps, self.console = name, steps, console
        self.pace = Pace(steps, first)
        self._next = 0.0
        self._bar: Progress | None = None
        if rank() == 0:
            self._bar = bar(console)
            self._bar.start()
            self._task = self._bar.add_task(name, total=steps, completed=first, note="")

    def show(self, step: int, loss: Tensor) -> None:
        """Move the bar, or print a line now and then."""
        if self._bar is None:
            return
        terminal = self.console.is_terminal
        if not terminal and not self.pace.due(step) and step < self.steps:
            return
        if terminal and step < self.steps:
            now = time.monotonic()
            if now < self._next:  # reading a loss waits for the GPU
                return
            self._next = now + _REDRAW
        note = f"loss {float(loss):.4f}  {self.pace.speed(step):.1f} steps/s"
        if terminal:
            self._bar.update(self._task, completed=step, note=note)
        else:
            left = self.pace.left(step)
            self.console.print(f"    {self.name}: step {step}/{self.steps}  {note}{left and f'  {left}'}")

    def close(self) -> None:
        if self._bar is not None:
            self._bar.stop()


class LogState(TypedDict):
    """Rows of the log in a checkpoint, as JSON."""

    rows: str
    gauges: str


class MetricLog:
    """`metrics.jsonl`: one row every 10 steps and one per validation; the loggers get the same rows.

    Rows are in the checkpoint; file and loggers get those of a checkpoint that is on disk, so after a kill
    each step is there once. Loggers also get learning rates, gradient norms and times; the file is an output
    of the stage, and equal runs have equal ones.
    """

    def __init__(self, folder: Path, loggers: Loggers) -> None:
        self.path = folder / FILE_NAME
        self.loggers = loggers
        self.rows: list[Row] = []
        self._texts: list[tuple[str, str]] = []
        """Each row and what only the loggers get, as JSON: a checkpoint takes the text as it is."""
        self._written = 0
        """Rows in the file and in the loggers."""

    def state_dict(self) -> LogState:
        """Rows so far, as text (plain types only in checkpoints)."""
        rows, gauges = (", ".join(text[place] for text in self._texts) for place in range(2))
        return {"rows": f"[{rows}]", "gauges": f"[{gauges}]"}

    def load_state_dict(self, state: LogState) -> None:
        self.rows, gauges = json.loads(state["rows"]), json.loads(state["gauges"])
        pairs = zip(self.rows, gauges, strict=True)
        self._texts = [(json.dumps(row), json.dumps(more)) for row, more in pairs]

    def open(self) -> None:
        """Open the loggers and the file with the rows up to the checkpoint."""
        if rank() == 0:
            self.loggers.open(self._logged(0, len(self.rows)))
            if self.rows or self.path.is_file():
                self._write()

    def append(self, step: int, figures: Mapping[str, float], gauges: Mapping[str, float]) -> None:
        """Take a row; `gauges` are for the loggers alone."""
        if not figures:
            return
        self.rows.append({"step": step, **figures})
        self._texts.append((json.dumps(self.rows[-1]), json.dumps(gauges)))

    def saved(self, step: int) -> None:
        """Bring file and loggers up to a checkpoint that is on disk; only the lead has one."""
        count = len(self.rows)
        while count > self._written and self.rows[count - 1]["step"] > step:
            count -= 1
        _append(self.path, self._lines(self._written, count).encode())
        self.loggers.take(self._logged(self._written, count))
        self._written = count

    def finish(self) -> None:
        """The training is over: write the file as a whole, as an output is complete or absent."""
        if rank() == 0:
            self._write()
            self.loggers.close("success")

    def fail(self) -> None:
        """Close the loggers; rows that no checkpoint holds come again when the run is resumed."""
        if rank() == 0:
            self.loggers.close("failed")

    def _logged(self, first: int, last: int) -> list[Row]:
        return [json.loads(row) | json.loads(gauges) for row, gauges in self._texts[first:last]]

    def _lines(self, first: int, last: int) -> str:
        return "".join(json.dumps(row, sort_keys=True) + "\n" for row in self.rows[first:last])

    def _write(self) -> None:
        write_text(self.path, self._lines(0, len(self.rows)))
        self._written = len(self.rows)


def _append(path: Path, lines: bytes) -> None:
    """All of them or none, for whoever reads meanwhile."""
    with open_own(path, "ab") as file:
        size = file.seek(0, 2)
        if file.write(lines) != len(lines):
            file.truncate(size)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
