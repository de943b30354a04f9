"""A profile of a few steps of a training by torch's profiler (`--profile`, `hardware.profile`).

Each process leaves two files in the stage's `flight/` folder: a trace that Perfetto and Chrome open, and a
table of the operations that took most.
"""

from __future__ import annotations

from pathlib import Path

import torch
from rich.console import Console
from torch.profiler import ProfilerActivity, profile

from motionloom.datasets.base.files import atomic_path, write_text
from motionloom.models.training.distributed import rank
from motionloom.pipeline.store.training_log import FLIGHT

WARM_UP = 10
"""Steps of a training before those that are profiled: kernels are chosen and caches filled in them."""
_ROWS = 30


class StepProfiler:
    """Profiles `steps` steps after the first `WARM_UP` from step `first`, or the last of a shorter training.

    Nothing is written if the training ends before the last of them.
    """

    def __init__(
        self,
        name: str,
        folder: Path,
        steps: int,
        first: int,
        last: int,
        device: torch.device,
        console: Console,
    ) -> None:
        self.name, self.folder, self.device, self.console = name, folder, device, console
        self._begin = max(first, min(first + WARM_UP, last - steps))
        self._end = min(last, self._begin + steps)
        self._profile: profile | None = None

    def begin_step(self, step: int) -> None:
        if self._profile is None and self._begin <= step < self._end:
            kinds = [ProfilerActivity.CPU]
            if self.device.type == "cuda":
                kinds.append(ProfilerActivity.CUDA)
            self._profile = profile(activities=kinds, record_shapes=True)
            self._profile.start()

    def end_step(self, step: int) -> None:
        if self._profile is not None and step >= self._end:
            if self.device.type == "cuda":
                torch.cuda.synchronize(self.device)
            self._profile.stop()
            self._write(self._profile)
            self._profile = None

    def close(self) -> None:
        if self._profile is not None:
            self._profile.stop()
            self._profile = None

    def _write(self, done: profile) -> None:
        place = self.folder / FLIGHT
        trace, table = place / f"profile_rank_{rank()}.json.gz", place / f"profile_rank_{rank()}.txt"
        with atomic_path(trace) as temporary:
            whole = temporary.with_name(f"{temporary.name}.json.gz")  # torch packs what is called so
            done.export_chrome_trace(str(whole))
            whole.replace(temporary)
        order = "self_cuda_time_total" if self.device.type == "cuda" else "self_cpu_time_total"
        write_text(table, done.key_averages().table(sort_by=order, row_limit=_ROWS) + "\n")
        steps = f"{self._begin + 1} to {self._end}"
        self.console.print(
            f"    {self.name}: profile of steps {steps} in {trace} (open it at ui.perfetto.dev), "
            f"what took longest in {table.name}",
            soft_wrap=True,
        )
