"""Where the figures of a training go besides `metrics.jsonl`: Lightning's loggers, and trackio's.

All of them get the same names. Those that write files get a row when it is taken, and after a kill the files
show every step once: the CSV file is written anew from the rows in the checkpoint, and TensorBoard is told to
drop what lies behind it. Those with a server cannot take rows back, so they get them once the checkpoint is
on disk.
"""

from __future__ import annotations

import json
import uuid
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from lightning.fabric.loggers.logger import rank_zero_experiment
from lightning.fabric.utilities.rank_zero import rank_zero_only
from lightning.pytorch.loggers.logger import Logger

from motionloom.pipeline.launch.hardware import SERVERS, LoggerName
from motionloom.pipeline.store.files import write_json

FOLDER = "logs"
"""Of a stage's folder; no result depends on it."""

_SENT = "sent.json"
"""In that folder: what the servers have. A kill may come between a checkpoint and the sending of its rows."""


class Loggers:
    """The loggers of one training; made when its first row comes, so that an import costs nothing before."""

    def __init__(self, names: Sequence[LoggerName], folder: Path, project: str, title: str) -> None:
        self.names, self.folder = tuple(dict.fromkeys(names)), folder / FOLDER
        self.project, self.title = project, title
        self._files: list[Logger] = []
        self._servers: list[Logger] = []
        self._waiting: list[tuple[int, dict[str, float]]] = []

    def open(self, step: int, rows: Sequence[dict[str, float]]) -> None:
        for name in self.names:
            logger = _MAKERS[name](self, step)
            (self._servers if name in SERVERS else self._files).append(logger)
            if name == "csv":
                for row in rows:
                    _log(logger, row)
        if self._servers:
            sent = self._sent(step)
            self._waiting = [(int(row["step"]), row) for row in rows if row["step"] > sent]

    def take(self, row: dict[str, float]) -> None:
        for logger in self._files:
            _log(logger, row)
        if self._servers:
            self._waiting.append((int(row["step"]), row))

    def save(self, step: int) -> None:
        """Bring all up to the checkpoint of a step."""
        for at, row in self._waiting:
            for logger in self._servers if at <= step else ():
                _log(logger, row)
        self._waiting = [(at, row) for at, row in self._waiting if at > step]
        if self._servers:
            write_json(self.folder / _SENT, {"step": step})
        for logger in self._files:
            logger.save()

    def close(self, status: str) -> None:
        for logger in (*self._files, *self._servers):
            logger.finalize(status)
        self._files, self._servers = [], []

    def _sent(self, step: int) -> int:
        """Step that the servers have the rows up to; `step` where that is not written down."""
        path = self.folder / _SENT
        return int(json.loads(path.read_text())["step"]) if path.is_file() else step

    def identity(self, server: str) -> dict[str, str]:
        """What a server knows this training by; the same when it goes on after a kill."""
        path = self.folder / f"{server}.json"
        if not path.is_file():
            self.folder.mkdir(parents=True, exist_ok=True)
            write_json(path, {"id": uuid.uuid4().hex})
        found: dict[str, str] = json.loads(path.read_text())
        return found


def _log(logger: Logger, row: dict[str, float]) -> None:
    logger.log_metrics({k: v for k, v in row.items() if k != "step"}, step=int(row["step"]))


def _csv(loggers: Loggers, step: int) -> Logger:
    from lightning.pytorch.loggers import CSVLogger

    path = loggers.folder / "csv" / "metrics.csv"
    path.unlink(missing_ok=True)  # Lightning would do it too, with a warning
    return CSVLogger(loggers.folder, name="", version="csv")


def _tensorboard(loggers: Loggers, step: int) -> Logger:
    from lightning.pytorch.loggers import TensorBoardLogger

    return TensorBoardLogger(
        loggers.folder,
        name="",
        version="tensorboard",
        default_hp_metric=False,
        purge_step=step + 1 if step else None,
    )


def _wandb(loggers: Loggers, step: int) -> Logger:
    from lightning.pytorch.loggers import WandbLogger

    return WandbLogger(
        project=loggers.project,
        name=loggers.title,
        id=loggers.identity("wandb")["id"],
        resume="allow",
        save_dir=loggers.folder,
    )


def _mlflow(loggers: Loggers, step: int) -> Logger:
    from lightning.pytorch.loggers import MLFlowLogger

    path = loggers.folder / "mlflow.json"
    known = json.loads(path.read_text())["id"] if path.is_file() else None
    logger = MLFlowLogger(experiment_name=loggers.project, run_name=loggers.title, run_id=known)
    if known is None:  # the server gives the name
        loggers.folder.mkdir(parents=True, exist_ok=True)
        write_json(path, {"id": str(logger.run_id)})
    return logger


def _trackio(loggers: Loggers, step: int) -> Logger:
    return TrackioLogger(loggers.project, f"{loggers.title}-{loggers.identity('trackio')['id'][:8]}")


_MAKERS: dict[str, Callable[[Loggers, int], Logger]] = {
    "csv": _csv,
    "tensorboard": _tensorboard,
    "wandb": _wandb,
    "mlflow": _mlflow,
    "trackio": _trackio,
}


class TrackioLogger(Logger):
    """Logs to trackio, which Lightning has no logger for; a run of the same name is gone on with."""

    def __init__(self, project: str, title: str) -> None:
        super().__init__()
        self._project, self._title = project, title
        self._run: Any = None

    @property
    def name(self) -> str:
        return self._project

    @property
    def version(self) -> str:
        return self._title

    @property
    @rank_zero_experiment
    def experiment(self) -> Any:
        """The module `trackio` with a run in progress."""
        import trackio

        if self._run is None:
            self._run = trackio.init(project=self._project, name=self._title, resume="allow")
        return trackio

    @rank_zero_only
    def log_hyperparams(self, params: object, *args: object, **kwargs: object) -> None:
        """Nothing: the run folder holds the recipe."""

    @rank_zero_only
    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None:
        self.experiment.log(metrics, step=step)

    @rank_zero_only
    def finalize(self, status: str) -> None:
        if self._run is not None:
            self.experiment.finish()
            self._run = None
