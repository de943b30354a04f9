"""Where the figures of a training go besides `metrics.jsonl`: Lightning's loggers.

All of them get the same names, and a row only once the checkpoint that holds it is on disk: none of them can
take a row back, and after a kill they show every step once.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable, Sequence
from pathlib import Path

from lightning.pytorch.loggers.logger import Logger

from motionloom.pipeline.launch.hardware import LoggerName
from motionloom.pipeline.store.files import read_record, write_json

FOLDER = "logs"
"""Folder of the loggers in a stage's folder; no result depends on it."""

_SENT = "sent.json"
"""In that folder: what the loggers have. A kill may come between a checkpoint and the sending of its rows."""


class Loggers:
    """The loggers of one training; made when it begins, so that an import costs nothing before."""

    def __init__(self, names: Sequence[LoggerName], folder: Path, project: str, title: str) -> None:
        self.names, self.folder = tuple(dict.fromkeys(names)), folder / FOLDER
        self.project, self.title = project, title
        self._loggers: list[Logger] = []

    def open(self, rows: Sequence[dict[str, float]]) -> None:
        """Begin, or go on from a checkpoint that holds `rows`."""
        # Rows up to `sent` are on the servers, which cannot take any back.
        path = self.folder / _SENT
        sent = int(str(read_record(path)["step"])) if path.is_file() else -1
        for name in self.names:
            logger = _MAKERS[name](self)
            self._loggers.append(logger)
            # The CSV file is written anew.
            _log(logger, [row for row in rows if name == "csv" or row["step"] > sent])

    def take(self, rows: Sequence[dict[str, float]]) -> None:
        """Rows of a checkpoint that is on disk."""
        for logger in self._loggers:
            _log(logger, rows)
            logger.save()
        if self._loggers and rows:
            write_json(self.folder / _SENT, {"step": int(rows[-1]["step"])})

    def close(self, status: str) -> None:
        for logger in self._loggers:
            logger.finalize(status)
        self._loggers = []

    def identity(self, server: str, make: Callable[[], str] = lambda: uuid.uuid4().hex) -> str:
        """The id of this training on a server; the same when it resumes after a kill."""
        path = self.folder / f"{server}.json"
        if not path.is_file():
            write_json(path, {"id": make()})
        return str(read_record(path)["id"])


def _log(logger: Logger, rows: Sequence[dict[str, float]]) -> None:
    for row in rows:
        logger.log_metrics({k: v for k, v in row.items() if k != "step"}, step=int(row["step"]))


def _csv(loggers: Loggers) -> Logger:
    from lightning.pytorch.loggers import CSVLogger

    path = loggers.folder / "csv" / "metrics.csv"
    path.unlink(missing_ok=True)  # Lightning would do it too, with a warning
    return CSVLogger(loggers.folder, name="", version="csv")


def _tensorboard(loggers: Loggers) -> Logger:
    from lightning.pytorch.loggers import TensorBoardLogger

    return TensorBoardLogger(loggers.folder, name="", version="tensorboard", default_hp_metric=False)


def _wandb(loggers: Loggers) -> Logger:
    from lightning.pytorch.loggers import WandbLogger

    return WandbLogger(
        project=loggers.project,
        name=loggers.title,
        id=loggers.identity("wandb"),
        resume="allow",
        save_dir=loggers.folder,
    )


def _mlflow(loggers: Loggers) -> Logger:
    from lightning.pytorch.loggers import MLFlowLogger

    def logger(known: str | None = None) -> MLFlowLogger:
        return MLFlowLogger(experiment_name=loggers.project, run_name=loggers.title, run_id=known)

    return logger(loggers.identity("mlflow", lambda: str(logger().run_id)))  # the server gives the name


_MAKERS: dict[LoggerName, Callable[[Loggers], Logger]] = {
    "csv": _csv,
    "tensorboard": _tensorboard,
    "wandb": _wandb,
    "mlflow": _mlflow,
}
