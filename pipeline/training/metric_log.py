"""The log of a training: `metrics.jsonl`, and Lightning's loggers, which get the same rows.

A row reaches file and loggers only once the checkpoint that holds it is on disk: none of the loggers can take
a row back, and after a kill all of them show every step once.
"""

from __future__ import annotations

import errno
import json
import os
import uuid
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypedDict

from lightning.pytorch.loggers.logger import Logger

from motionloom.datasets.base.files import write_text
from motionloom.models.training.distributed import rank
from motionloom.pipeline.launch.hardware import LoggerName
from motionloom.pipeline.store.files import open_own, read_record, write_json
from motionloom.pipeline.store.training_log import FILE_NAME

FOLDER = "logs"
"""Folder of the loggers in a stage's folder; no result depends on it."""

_SENT = "sent.json"
"""In that folder: the last step the loggers have. A kill may come between a checkpoint and the sending."""

Row = dict[str, float]
"""Figures by name, and "step"."""


class LogState(TypedDict):
    """Rows of the log in a checkpoint, as JSON."""

    rows: str
    gauges: str


class MetricLog:
    """One row every 10 steps and one per validation.

    Loggers also get learning rates, gradient norms and times; the file is an output of the stage, and equal
    runs have equal ones. Loggers are made when the training begins, so that an import costs nothing before.
    """

    def __init__(self, folder: Path, names: Sequence[LoggerName], project: str, title: str) -> None:
        self.path, self.folder = folder / FILE_NAME, folder / FOLDER
        self.names = tuple(dict.fromkeys(names))
        self.project, self.title = project, title
        self.rows: list[Row] = []
        self._loggers: list[Logger] = []
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
        if rank() != 0:
            return
        # Rows up to `sent` are on the servers, which cannot take any back.
        path = self.folder / _SENT
        sent = int(str(read_record(path)["step"])) if path.is_file() else -1
        rows = self._logged(0, len(self.rows))
        for name in self.names:
            logger = _MAKERS[name](self)
            self._loggers.append(logger)
            # The CSV file is written anew.
            _log(logger, [row for row in rows if name == "csv" or row["step"] > sent])
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
        rows = self._logged(self._written, count)
        for logger in self._loggers:
            _log(logger, rows)
            logger.save()
        if self._loggers and rows:
            write_json(self.folder / _SENT, {"step": int(rows[-1]["step"])})
        self._written = count

    def finish(self) -> None:
        """The training is over: write the file as a whole, as an output is complete or absent."""
        if rank() == 0:
            self._write()
            self._close("success")

    def fail(self) -> None:
        """Close the loggers; rows that no checkpoint holds come again when the run is resumed."""
        if rank() == 0:
            self._close("failed")

    def identity(self, server: str, make: Callable[[], str] = lambda: uuid.uuid4().hex) -> str:
        """The id of this training on a server; the same when it resumes after a kill."""
        path = self.folder / f"{server}.json"
        if not path.is_file():
            write_json(path, {"id": make()})
        return str(read_record(path)["id"])

    def _close(self, status: str) -> None:
        for logger in self._loggers:
            logger.finalize(status)
        self._loggers = []

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


def _log(logger: Logger, rows: Sequence[Row]) -> None:
    for row in rows:
        logger.log_metrics({k: v for k, v in row.items() if k != "step"}, step=int(row["step"]))


def _csv(log: MetricLog) -> Logger:
    from lightning.pytorch.loggers import CSVLogger

    path = log.folder / "csv" / "metrics.csv"
    path.unlink(missing_ok=True)  # Lightning would do it too, with a warning
    return CSVLogger(log.folder, name="", version="csv")


def _tensorboard(log: MetricLog) -> Logger:
    from lightning.pytorch.loggers import TensorBoardLogger

    return TensorBoardLogger(log.folder, name="", version="tensorboard", default_hp_metric=False)


def _wandb(log: MetricLog) -> Logger:
    from lightning.pytorch.loggers import WandbLogger

    name, id_ = log.title, log.identity("wandb")
    return WandbLogger(project=log.project, name=name, id=id_, resume="allow", save_dir=log.folder)


def _mlflow(log: MetricLog) -> Logger:
    from lightning.pytorch.loggers import MLFlowLogger

    def logger(run_id: str | None = None) -> MLFlowLogger:
        return MLFlowLogger(experiment_name=log.project, run_name=log.title, run_id=run_id)

    return logger(log.identity("mlflow", lambda: str(logger().run_id)))  # the server gives the name


_MAKERS: dict[LoggerName, Callable[[MetricLog], Logger]] = {
    "csv": _csv,
    "tensorboard": _tensorboard,
    "wandb": _wandb,
    "mlflow": _mlflow,
}
