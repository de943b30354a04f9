"""The flight recorder: what each process of a training notes of its steps, and the end of a lost one.

Every ten steps, where the log waits for the device anyway, a row goes into `flight/rank_N.jsonl`: speed, what
the process waited for, gradient and weight norms by layer group, memory, and which batches it has read. There
all processes also compare whether a loss or a gradient has stopped being finite, and act as one.
"""

from __future__ import annotations

import resource
import statistics
import sys
import time
from collections import deque
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback
from rich.console import Console
from torch import Tensor

from motionloom.models.training.stage_module import LOG_EVERY, StageModule
from motionloom.pipeline.flight.bundles import Bundles
from motionloom.pipeline.flight.groups import read_norms
from motionloom.pipeline.flight.not_finite import NotFinite
from motionloom.pipeline.flight.ranks import GradientWaits, gathered, waited_in_steps
from motionloom.pipeline.flight.waits import Waited, Waits
from motionloom.pipeline.flight.watch import Watch
from motionloom.pipeline.store.flight_log import FOLDER, FlightLog


@dataclass(frozen=True)
class FlightSettings:
    """What a training's recorder needs to know of it."""

    name: str
    folder: Path
    batch_size: int
    """Global."""
    accumulate: int
    rows: int
    """0: no log is written; what is not finite is found all the same."""
    steps: int
    """How many of the last steps are remembered for a crash bundle."""


class FlightRecorder(Callback):
    """Writes the log of its process and watches for what is not finite."""

    def __init__(
        self,
        settings: FlightSettings,
        failures: NotFinite,
        bundles: Bundles,
        console: Console,
        waits: Waits,
    ) -> None:
        self.settings, self.failures, self.bundles, self.console = settings, failures, bundles, console
        self.waits = waits
        self.total = Waited()
        """Since this process began to train."""
        self._log: FlightLog | None = None
        self._watch: Watch | None = None
        self._gradients = GradientWaits()
        self._lengths: list[Tensor] = []
        self._unit: str | None = None
        self._whole: list[float] = []
        self._latest: deque[float] = deque(maxlen=100)
        self._own: list[float] = []
        self._began: float | None = None
        self._ended = self._row = 0.0
        self._step = self._first = 0
        self._seen = replace(waits)
        self._units = 0.0

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Look on, and go on with the log behind the checkpoint."""
        assert isinstance(pl_module, StageModule)
        scaled = getattr(trainer.precision_plugin, "scaler", None) is not None
        keep = self.settings.steps + LOG_EVERY
        self._watch = pl_module.watcher = Watch(pl_module, keep=keep, scaled=scaled)
        self.bundles.watch = self._watch
        self._step = self._first = trainer.global_step
        if self.settings.rows:
            path = self.settings.folder / FOLDER / f"rank_{trainer.global_rank}.jsonl"
            self._log = FlightLog(path, self.settings.rows)
            self._log.begin(self._step)
        self._row = self._ended = time.perf_counter()
        self._seen = replace(self.waits)

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """The validation and the checkpoint since the last chunk are time of no step."""
        self._ended = time.perf_counter()

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """The batch is here."""
        now = time.perf_counter()
        self._began = self._began or now
        length = batch.get("length") if isinstance(batch, dict) else None
        if isinstance(length, Tensor):
            self._unit = self._unit or ("tokens" if "tokens" in batch else "frames")
            self._lengths.append(length)

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Time the step; a row every ten."""
        assert isinstance(pl_module, StageModule)
        now = time.perf_counter()
        if trainer.global_step > self._step:
            self._step = trainer.global_step
            self._whole.append(now - self._ended)
            self._latest.append(now - self._ended)
            self._own.append(now - (self._began or now))
            self._began, self._ended = None, now
            if self._step % LOG_EVERY == 0:
                self._end_row(trainer, pl_module)

    def on_validation_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """A network that is lost is not validated."""
        self._check(trainer, pl_module)

    def on_save_checkpoint(
        self, trainer: L.Trainer, pl_module: L.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """None is made of a network that is lost."""
        self._check(trainer, pl_module)

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Say how fast it was and what it waited for."""
        assert isinstance(pl_module, StageModule)
        self._read_lengths()
        self._count(trainer, pl_module)
        steps = self._step - self._first
        if steps and self.total.wall:
            self.console.print(f"    {self.settings.name}: {self._speed(trainer, steps)}")
        pl_module.watcher = None

    def on_exception(
        self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException
    ) -> None:
        """Leave a bundle of what went wrong."""
        if isinstance(pl_module, StageModule):
            self.bundles.of_exception(trainer, pl_module, exception)
            pl_module.watcher = None

    def _speed(self, trainer: L.Trainer, steps: int) -> str:
        said = [f"{steps * self.settings.batch_size / self.total.wall:,.1f} samples/s"]
        if self._unit:
            said.append(f"{self._units * trainer.world_size / self.total.wall:,.0f} {self._unit}/s")
        return f"{', '.join(said)}; {self.total.say(team=trainer.world_size > 1)}"

    def _check(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """All processes compare; a collective, so that all go on or all stop."""
        if self._watch is not None:
            assert isinstance(module, StageModule)
            failure = self._watch.collect()
            codes = gathered(trainer, [float("inf") if failure is None else failure.code])[:, 0]
            self.failures.decide(trainer, module, failure, codes.tolist(), self.bundles)

    def _end_row(self, trainer: L.Trainer, module: StageModule) -> None:
        assert self._watch is not None
        failure = self._watch.collect()
        own = ([0.0] * LOG_EVERY + self._own)[-LOG_EVERY:]
        told = gathered(trainer, [*own, float("inf") if failure is None else failure.code])
        late = waited_in_steps(told[:, :-1], trainer.global_rank)
        row = self._make_row(trainer, module, self._count(trainer, module, late))
        if self._log is not None and row:
            self._log.take(row)
        module.gauges = {**module.gauges, **_gauges(row)}
        self.failures.decide(trainer, module, failure, told[:, -1].tolist(), self.bundles)

    def _count(self, trainer: L.Trainer, module: StageModule, late: float = 0.0) -> Waited:
        """The waits since the last row, which are added to the whole."""
        now, waits = time.perf_counter(), self.waits
        steps = len(self._whole)
        ranks = max(late, self._gradients.since(trainer, module, steps)) if trainer.world_size > 1 else 0.0
        found = Waited(
            now - self._row, waits.data - self._seen.data, waits.checkpoints - self._seen.checkpoints, ranks
        )
        self._row, self._seen = now, replace(waits)
        self.total.add(replace(found))
        return found

    def _read_lengths(self) -> float:
        found = float(torch.cat([own.reshape(-1) for own in self._lengths]).sum()) if self._lengths else 0.0
        self._units += found
        self._lengths = []
        return found

    def _make_row(self, trainer: L.Trainer, module: StageModule, waited: Waited) -> dict[str, Any]:
        assert self._watch is not None
        whole, self._whole, self._own = self._whole, [], []
        units, wall, settings = self._read_lengths(), max(waited.wall, 1e-9), self.settings
        if not settings.rows:
            return {}
        parts, first = settings.accumulate, self._step - len(whole)
        trained = [param for param in module.parameters() if param.requires_grad]
        row: dict[str, Any] = {
            "step": self._step,
            "samples_per_second": len(whole) * settings.batch_size / wall,
            **({f"{self._unit}_per_second": units * trainer.world_size / wall} if self._unit else {}),
            "step_seconds": statistics.median(whole),
            "step_seconds_p95": sorted(self._latest)[-(-95 * len(self._latest) // 100) - 1],
            "waited": waited.shares(),
            "grad_norm": read_norms(self._watch.norms),
            "weight_norm": read_norms(self._watch.groups.weight_norms(trained)),
            "rss_mib": _rss_mib(),
            "batches": [first * parts, self._step * parts - 1],
        }
        if module.device.type == "cuda":
            row["cuda_peak_mib"] = torch.cuda.max_memory_allocated(module.device) / 2**20
        return row


def _gauges(row: dict[str, Any]) -> dict[str, float]:
    """What loggers get of a row."""
    out: dict[str, float] = {}
    for name, value in row.items():
        if isinstance(value, dict):
            out |= {f"flight/{name}/{inner}": figure for inner, figure in value.items()}
        elif name not in ("step", "batches"):
            out[f"flight/{name}"] = value
    return out


def _rss_mib() -> float:
    """The most memory this process has had so far."""
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most / 2**20 if sys.platform == "darwin" else most / 2**10
