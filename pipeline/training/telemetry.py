"""Telemetry of a training: progress bar, speed, utilisation and waits per rank, and sampled motions.

A row every ten steps goes into `flight/rank_N.jsonl` of the stage's folder, which the report draws. Motions
(`train.sample_every`) are drawn by a process of its own.
"""

from __future__ import annotations

import json
import resource
import statistics
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import torch
import torch.distributed as dist
from rich.console import Console
from rich.progress import Progress
from torch import Tensor

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import write_text
from motionloom.datasets.base.progress import Pace, bar
from motionloom.models.training.distributed import rank, world_size
from motionloom.models.training.stage_module import LOG_EVERY, Batch, StageModule
from motionloom.pipeline.contract.stage import StageContext
from motionloom.pipeline.store.files import open_own
from motionloom.pipeline.store.run_folder import owner_of
from motionloom.pipeline.store.training_log import FLIGHT, SAMPLES, note_start, optional, read_rows
from motionloom.pipeline.training.utilization import Utilization


class WaitTimes(dict[str, float]):
    """Seconds that this process has waited, by cause; on a GPU counted from when its queue was empty.

    `data`: for the next batch, where it was not ready when the step before it ended;
    `checkpoints`: for copying the state, and for the checkpoint before it if that was still being written;
    `validation`: for the losses on held-out data;
    `ranks`: for ranks that came later to a step.
    """

    def __init__(self, device: torch.device) -> None:
        super().__init__(data=0.0, checkpoints=0.0, validation=0.0, ranks=0.0)
        self.process = 0.0
        """Seconds that the process itself has waited, whatever its GPU did meanwhile."""
        self._on_gpu = device.type == "cuda"
        self._unread: list[tuple[str, torch.cuda.Event, torch.cuda.Event]] = []

    @property
    def aside(self) -> float:
        """Seconds spent on checkpoints and validations."""
        return self["checkpoints"] + self["validation"]

    @contextmanager
    def waiting_for(self, cause: str) -> Iterator[None]:
        """Count the time inside as a wait for `cause`."""
        begin = time.perf_counter()
        # A GPU comes to the first mark when all that was queued is done, to the second when it may go on.
        mark = _mark() if self._on_gpu else None
        try:
            yield
        finally:
            seconds = time.perf_counter() - begin
            self.process += seconds
            if mark is None:
                self[cause] += seconds
            else:
                self._unread.append((cause, mark, _mark()))

    def read(self) -> None:
        """Add the waits of a GPU since the last call, synchronising with it."""
        for cause, begin, end in self._unread:
            end.synchronize()
            self[cause] += begin.elapsed_time(end) / 1000
        self._unread.clear()

    def shares(self, before: Mapping[str, float], seconds: float) -> dict[str, float]:
        """Return the shares of `seconds` spent waiting since the copy `before` was made: 0 to 1, by cause."""
        return {cause: min(1.0, (now - before[cause]) / max(seconds, 1e-9)) for cause, now in self.items()}


def _mark() -> torch.cuda.Event:
    mark = torch.cuda.Event(enable_timing=True)  # type: ignore[no-untyped-call]
    mark.record()
    return mark


class Telemetry:
    """Measures the steps of one process; `folder` is the stage's, `at_peak` as `Utilization` has it.

    An error in writing does not end the training: later rows are only shown.
    """

    def __init__(
        self, folder: Path, module: StageModule, batch_size: int, console: Console, at_peak: float
    ) -> None:
        self.module = module
        self.batch_size = batch_size
        self.console = console
        self.waits = WaitTimes(module.device)
        self.note = ""
        """Speed, MFU and goodput of the last row, in words."""
        self._shown: list[str] = []
        self._log: Path | None = None
        self._first = module.step
        self._start = self._step_start = self._row_start = time.perf_counter()
        self._before = dict(self.waits)
        """Waits up to the last row."""
        self._seconds: list[float] = []
        """Seconds of the steps since the last row."""
        self._own: list[float] = []
        """Without the wait for the batch."""
        self._latest: deque[float] = deque(maxlen=100)
        self._lengths: list[Tensor] = []
        self._units = 0.0
        self._unit = ""
        if module.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(module.device)  # of the trainings before in this process
        rows: list[dict[str, float]] = []
        with self._optional():
            path = folder / FLIGHT / f"rank_{rank()}.jsonl"
            rows = read_rows(path)
            if rank() == 0:
                note_start(folder, module.step, int(rows[-1]["step"]) if rows else 0)
            # Rows of later steps, which come again, are dropped.
            write_text(path, "".join(json.dumps(row) + "\n" for row in rows if row["step"] <= module.step))
            self._log = path
        self._use = Utilization(rows, module.step, at_peak)
        self._start_seconds = 0.0
        """Seconds until the end of the first step, which compiles; without checkpoints and validations."""

    def batch(self, batch: Batch) -> None:
        """A batch has been read: count its frames or tokens."""
        length = batch.get("length")
        if isinstance(length, Tensor):
            self._unit = "tokens" if "tokens" in batch else "frames"
            self._lengths.append(length)

    def begin_step(self) -> None:
        """Start the clock of a step, after validations and checkpoints."""
        self._step_start = time.perf_counter()
        self._waited_before = self.waits.process

    def end_step(self) -> None:
        seconds = time.perf_counter() - self._step_start
        self._seconds.append(seconds)
        self._latest.append(seconds)
        self._own.append(seconds - (self.waits.process - self._waited_before))
        if self.module.step == self._first + 1:
            self.waits.read()
            self._start_seconds = time.perf_counter() - self._start - self.waits.aside

    def end_row(self) -> dict[str, float]:
        """Write a row and return the figures for loggers; all ranks call this after the same step."""
        # The step times of all ranks, so that each knows how long it has waited for the slowest.
        late = all_ranks(([0.0] * LOG_EVERY + self._own)[-LOG_EVERY:], self.module.device)
        self.waits["ranks"] += waited_in_steps(late, rank())
        self.waits.read()
        now = time.perf_counter()
        wall = max(now - self._row_start, 1e-9)
        self._row_start = now
        waited = self.waits.shares(self._before, wall)
        self._before = dict(self.waits)
        seconds = self._seconds
        self._seconds = []
        self._own = []
        units = self._read_lengths()
        latest = sorted(self._latest)
        first = self.module.step - self._first == len(seconds)
        mean, use = self._use.row(len(seconds) - first, self.waits.aside + self._start_seconds)
        row: dict[str, float] = {
            "samples_per_second": len(seconds) * self.batch_size / wall,
            "step_seconds": statistics.median(seconds),
            "step_seconds_p95": latest[-(-95 * len(latest) // 100) - 1],
            **{f"waited/{cause}": share for cause, share in waited.items()},
            "rss_mib": _rss_mib(),
            **use,
        }
        if self._unit:
            row[f"{self._unit}_per_second"] = units * world_size() / wall
        if self.module.device.type == "cuda":
            row["cuda_peak_mib"] = torch.cuda.max_memory_allocated(self.module.device) / 2**20
            # Between two rows, where it is waited for: a single step only starts its kernels.
            if len(seconds) > first:
                row["step_seconds"] = mean
        self._shown = [f"goodput {100 * row['goodput']:.1f} %"]
        if "mfu" in row:
            self._shown.insert(0, f"MFU {100 * row['mfu']:.1f} %")
        speed = [f"{row[f'{self._unit}_per_second']:,.0f} {self._unit}/s"] if self._unit else []
        self.note = "  ".join(speed + self._shown)
        path = self._log
        self._log = None
        if path is not None:
            with self._optional(), open_own(path, "a") as file:
                gauges = {name: float(value) for name, value in self.module.gauges.items()}
                file.write(json.dumps({"step": self.module.step, **gauges, **row}) + "\n")
                self._log = path
        return {f"flight/{name}": value for name, value in row.items()}

    def summary(self) -> str:
        """Return a sentence on speed and waits since this process began to train; "" if it took no step."""
        steps = self.module.step - self._first
        wall = time.perf_counter() - self._start
        self._read_lengths()
        self.waits.read()
        if not steps:
            return ""
        speeds = [f"{steps * self.batch_size / wall:,.1f} samples/s"]
        if self._unit:
            speeds.append(f"{self._units * world_size() / wall:,.0f} {self._unit}/s")
        shares = self.waits.shares(dict.fromkeys(self.waits, 0.0), wall)
        if world_size() == 1:
            del shares["ranks"]
        named = {"ranks": "other ranks"}
        waits = [f"{100 * share:.1f} % for {named.get(cause, cause)}" for cause, share in shares.items()]
        return f"{', '.join(speeds + self._shown)}; waited {', '.join(waits)}"

    def _optional(self) -> AbstractContextManager[None]:
        return optional(f"telemetry of rank {rank()}", self.console)

    def _read_lengths(self) -> float:
        units = float(torch.cat([own.reshape(-1) for own in self._lengths]).sum()) if self._lengths else 0.0
        self._lengths = []
        self._units += units
        return units


def all_ranks(values: Sequence[float], device: torch.device) -> Tensor:
    """The values of all ranks, float64 [W, len(values)] on the CPU; a collective."""
    own = torch.tensor(values, dtype=torch.float64)
    if world_size() == 1:
        return own[None]
    own = own.to(device)
    gathered = [torch.empty_like(own) for _ in range(world_size())]
    dist.all_gather(gathered, own)
    return torch.stack(gathered).cpu()


def waited_in_steps(seconds: Tensor, rank: int) -> float:
    """Seconds that a rank has waited in its steps [W, K] for the rank that came last to each.

    A rank with a late batch keeps the others waiting in the step's first collective: their steps take longer
    than its own by that time.
    """
    return float((seconds[rank] - seconds.min(dim=0).values).sum())


def _rss_mib() -> float:
    """Return the peak resident memory of this process."""
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most / 2**20 if sys.platform == "darwin" else most / 2**10


_REDRAW = 0.1
"""Least seconds between two redraws of the bar."""
_WIDE = 130
"""Least terminal width for the bar with speed and utilisation."""


class StepProgress:
    """Progress on rank 0: a bar on a terminal, a line every 15 s elsewhere."""

    def __init__(self, name: str, first: int, steps: int, console: Console) -> None:
        self.name = name
        self.steps = steps
        self.console = console
        self.pace = Pace(steps, first)
        self._next = 0.0
        self._bar: Progress | None = None
        if rank() == 0:
            self._bar = bar(console)
            self._bar.start()
            self._task = self._bar.add_task(name, total=steps, completed=first, note="")

    def show(self, step: int, loss: Tensor, more: str = "") -> None:
        """Move the bar, or print a line now and then, with `more` behind loss and speed."""
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
        if terminal and self.console.width < _WIDE:
            more = ""
        note = f"loss {float(loss):.4f}  {self.pace.speed(step):.1f} steps/s{more and f'  {more}'}"
        if terminal:
            self._bar.update(self._task, completed=step, note=note)
        else:
            left = self.pace.left(step)
            self.console.print(f"    {self.name}: step {step}/{self.steps}  {note}{left and f'  {left}'}")

    def close(self) -> None:
        if self._bar is not None:
            self._bar.stop()


class SampleProcess:
    """Starts processes that draw samples, one at a time; the training does not wait for them."""

    def __init__(self, context: StageContext, every: int) -> None:
        """`every` is in steps; 0, or a stage that makes no motion, draws nothing."""
        self.context = context
        self.every = every if context.draws else 0
        self._process: subprocess.Popen[bytes] | None = None
        self._failed = False

    def saved(self, step: int) -> None:
        """Start drawing with the checkpoint of `step` if samples are due and no process is drawing."""
        code = 0 if self._process is None else self._process.poll()
        if code is None or not self.every or step % self.every:
            return
        log = self.context.folder / SAMPLES / "log.txt"
        failed = self._failed
        self._failed = code != 0
        with optional(f"{self.context.name}: what train.sample_every draws", self.context.console):
            if code and not failed:
                raise UserError(f"the last process failed, {log} says why")
            run = owner_of(self.context.folder)
            with open_own(log, "wb") as file:
                # A session of its own: what signals the training's group does not reach it.
                self._process = subprocess.Popen(
                    [*self.context.draws, str(run), self.context.name],
                    stdin=subprocess.DEVNULL,
                    stdout=file,
                    stderr=file,
                    start_new_session=True,
                )
