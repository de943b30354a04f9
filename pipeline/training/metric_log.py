"""The log of a training: `metrics.jsonl`, and Lightning's loggers, which get the same rows.

A row reaches file and loggers only once the checkpoint that holds it is on disk: no logger can take a row
back, so every step is logged once, after a kill too. A logger that fails is dropped with a warning; a resumed
training sends it the rows that it lacks.
"""

from __future__ import annotations

import errno
import json
import os
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypedDict, cast

from lightning.pytorch.loggers.logger import Logger
from rich.console import Console

from motionloom.datasets.base.files import write_text
from motionloom.datasets.base.os_errors import naming
from motionloom.models.training.distributed import rank
from motionloom.pipeline.launch.hardware import LoggerName
from motionloom.pipeline.store.files import open_own, read_record, write_json
from motionloom.pipeline.store.training_log import FILE_NAME, optional

FOLDER = "logs"
"""Folder of the loggers in a stage's folder, and of a process that stalled; no result depends on it."""

_SENT = "sent.json"
"""File in that folder with the number of rows each logger has got: a kill may come before they are sent."""

_MLFLOW_SERVER = os.environ.get("MLFLOW_TRACKING_URI")
"""Read at import: mlflow overwrites the variable with the server it uses."""

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

    def __init__(
        self, folder: Path, names: Sequence[LoggerName], project: str, title: str, console: Console
    ) -> None:
        self.path = folder / FILE_NAME
        self.folder = folder / FOLDER
        self.names = tuple(dict.fromkeys(names))
        self.project = project
        self.title = title
        self.console = console
        self.rows: list[Row] = []
        self._loggers: dict[LoggerName, Logger] = {}
        self._sent: dict[str, int] = {}
        """Rows that each logger has."""
        self._texts: list[tuple[str, str]] = []
        """Each row and what only the loggers get, as JSON: a checkpoint takes the text as it is."""
        self._written = 0
        """Rows in the file."""

    def state_dict(self) -> LogState:
        """Rows so far, as text (plain types only in checkpoints)."""
        rows, gauges = (", ".join(text[place] for text in self._texts) for place in range(2))
        return {"rows": f"[{rows}]", "gauges": f"[{gauges}]"}

    def load_state_dict(self, state: LogState) -> None:
        self.rows = json.loads(state["rows"])
        gauges = json.loads(state["gauges"])
        pairs = zip(self.rows, gauges, strict=True)
        self._texts = [(json.dumps(row), json.dumps(more)) for row, more in pairs]

    def open(self) -> None:
        """Open the loggers and the file with the rows up to the checkpoint."""
        if rank() != 0:
            return
        with optional(f"logs of {self.title}", self.console):
            path = self.folder / _SENT
            found = read_record(path) if path.is_file() else {}
            self._sent = {name: int(str(count)) for name, count in found.items()}
        for name in self.names:
            with optional(f"logger {name} of {self.title}", self.console):
                self._loggers[name] = _MAKERS[name](self)
        self._sent["csv"] = 0  # its file is written anew
        self._send(len(self.rows))
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
        self._send(count)
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

    @contextmanager
    def _kept(self, name: LoggerName) -> Iterator[Logger]:
        """Context around the use of a logger, which is dropped if that fails."""
        with optional(f"logger {name} of {self.title}", self.console):
            yield self._loggers[name]
            return
        del self._loggers[name]

    def _send(self, count: int) -> None:
        """Bring the loggers up to the first `count` rows."""
        for name in tuple(self._loggers):
            texts = self._texts[self._sent.get(name, 0) : count]
            if not texts:
                continue
            with self._kept(name) as logger:
                for row, gauges in texts:
                    figures = json.loads(row) | json.loads(gauges)
                    step = int(figures.pop("step"))
                    logger.log_metrics(figures, step=step)
                logger.save()
                self._sent[name] = count
                write_json(self.folder / _SENT, self._sent)

    def _close(self, status: str) -> None:
        for name in tuple(self._loggers):
            with self._kept(name) as logger:
                logger.finalize(status)
                if name == "wandb":  # Lightning leaves the run open until the process ends
                    cast(Any, logger).experiment.finish(exit_code=int(status != "success"))
        self._loggers = {}

    def _lines(self, first: int, last: int) -> str:
        return "".join(json.dumps(row, sort_keys=True) + "\n" for row in self.rows[first:last])

    def _write(self) -> None:
        write_text(self.path, self._lines(0, len(self.rows)))
        self._written = len(self.rows)


def _append(path: Path, lines: bytes) -> None:
    """Append lines in one write, so that a reader sees all of them or none."""
    with naming(path), open_own(path, "ab") as file:
        size = file.seek(0, 2)
        if file.write(lines) != len(lines):
            file.truncate(size)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


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

    # A run of its own: the trainings of one process follow each other.
    return WandbLogger(
        project=log.project,
        name=log.title,
        id=log.identity("wandb"),
        resume="allow",
        save_dir=log.folder,
        reinit="create_new",
    )


def _mlflow(log: MetricLog) -> Logger:
    from lightning.pytorch.loggers import MLFlowLogger

    # MLflow refuses folders of files since 3.17, and asks for a database where there is no server.
    log.folder.mkdir(parents=True, exist_ok=True)
    server = _MLFLOW_SERVER or f"sqlite:///{log.folder.resolve()}/mlflow.db"

    def logger(run_id: str | None = None) -> MLFlowLogger:
        return MLFlowLogger(
            experiment_name=log.project, run_name=log.title, tracking_uri=server, run_id=run_id
        )

    return logger(log.identity("mlflow", lambda: str(logger().run_id)))  # the server gives the name


_MAKERS: dict[LoggerName, Callable[[MetricLog], Logger]] = {
    "csv": _csv,
    "tensorboard": _tensorboard,
    "wandb": _wandb,
    "mlflow": _mlflow,
}
