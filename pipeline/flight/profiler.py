"""A profile of a few steps of a training by torch's profiler (`--profile`, `hardware.profile`).

Each process leaves two files in the stage's `flight/` folder: a trace that Perfetto and Chrome open, and a
table of the operations that took most.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback
from rich.console import Console
from torch.profiler import ProfilerActivity, profile

from motionloom.datasets.base.files import atomic_path, write_text
from motionloom.pipeline.store.flight_log import FOLDER

WARM_UP = 10
"""Steps of a training before those that are profiled: kernels are chosen and caches filled in them."""
_ROWS = 30


class StepProfiler(Callback):
    """Profiles `steps` steps behind the first `WARM_UP`, or the last ones of a shorter training."""

    def __init__(self, name: str, folder: Path, steps: int, last: int, console: Console) -> None:
        self.name, self.folder, self.steps, self.last, self.console = name, folder, steps, last, console
        self._begin = self._end = 0
        self._profile: profile | None = None

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Choose the steps."""
        first = trainer.global_step
        self._begin = max(first, min(first + WARM_UP, self.last - self.steps))
        self._end = min(self.last, self._begin + self.steps)

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Begin with the first of them."""
        if self._profile is None and self._begin <= trainer.global_step < self._end:
            kinds = [ProfilerActivity.CPU]
            if pl_module.device.type == "cuda":
                kinds.append(ProfilerActivity.CUDA)
            self._profile = profile(activities=kinds, record_shapes=True)
            self._profile.start()

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Write behind the last of them."""
        if self._profile is not None and trainer.global_step >= self._end > self._begin:
            if pl_module.device.type == "cuda":
                torch.cuda.synchronize(pl_module.device)
            self._profile.stop()
            self._write(self._profile, trainer.global_rank, pl_module.device.type)
            self._profile, self._end = None, self._begin

    def on_exception(
        self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException
    ) -> None:
        """What was begun is not written: the steps are not whole."""
        if self._profile is not None:
            self._profile.stop()
            self._profile = None

    def _write(self, done: profile, rank: int, device: str) -> None:
        place = self.folder / FOLDER
        trace, table = place / f"profile_rank_{rank}.json.gz", place / f"profile_rank_{rank}.txt"
        with atomic_path(trace) as temporary:
            whole = temporary.with_name(f"{temporary.name}.json.gz")  # torch packs what is called so
            done.export_chrome_trace(str(whole))
            whole.replace(temporary)
        order = "self_cuda_time_total" if device == "cuda" else "self_cpu_time_total"
        write_text(table, done.key_averages().table(sort_by=order, row_limit=_ROWS) + "\n")
        steps = f"{self._begin + 1} to {self._end}"
        self.console.print(
            f"    {self.name}: profile of steps {steps} in {trace} (open it at ui.perfetto.dev), "
            f"what took longest in {table.name}",
            soft_wrap=True,
        )
