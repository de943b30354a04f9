"""Where a run executes: accelerator, processes, precision. Not part of any fingerprint.

The global batch belongs to the stage's config, so one process, eight GPUs or two nodes take the same steps.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Annotated, Literal

import torch
from pydantic import Field, field_validator

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.pool import usable_cores
from motionloom.pipeline.launch.cluster import ClusterOptions
from motionloom.pipeline.launch.process import local_rank

_MOST_WORKERS = 4
_FEW_BATCHES = 100
"""Batches that are loaded sooner than processes are started."""
_WORKER_ROOM = 2**28
"""Bytes of shared memory for the batches of one worker: two that are ready and one on its way, of some 80 MB
(256 whole-body clips of 196 frames and their captions)."""

LoggerName = Literal["tensorboard", "csv", "wandb", "mlflow"]


class Hardware(Config):
    """Machine settings of a recipe (`hardware:`)."""

    accelerator: Literal["auto", "cpu", "gpu"] = "auto"
    devices: int = Field(0, ge=0)
    """Processes on this node; 0 means every visible GPU, or one process on a CPU."""
    cpu_devices: int = Field(1, ge=1)
    """Processes on this node where `devices` is 0 and it trains on a CPU, at most one for each core that this
    process may use. Threads of one process wait for each other at every operation, processes once a
    step, so small networks often train faster in several processes of one thread."""
    nodes: int = Field(1, ge=1)
    workers: Annotated[int, Field(ge=0)] | Literal["auto"] = "auto"
    """Processes that load batches, for each one that trains; 0 loads in that one. `auto`: on a GPU one for
    each core that is left, up to four; on a CPU none."""
    convert_workers: int = Field(2, ge=1)
    """Processes that convert or synthesise shards."""
    part: str | None = Field(None, pattern=r"^[1-9]\d*/[1-9]\d*$", exclude=True)
    """Part of every conversion that is made, such as 3/8, and nothing else; a run without it joins all."""
    threads: int = Field(0, ge=0)
    """CPU threads per process; 0 takes one for networks below ten million parameters, else torch's choice."""
    stall_seconds: int = Field(600, ge=0)
    """Seconds without a step, a validation batch or a checkpoint after which a training ends itself and
    leaves the stacks of its threads; 0 = never. Compiling counts, so it must be longer than that takes."""
    deterministic: bool = True
    """Whether a training on a GPU takes only kernels that give the same bytes every time. Gradients of
    convolutions and attention may be quicker without, and two equal trainings then differ."""
    verify_shards: Literal["once", "always", "never"] = "once"
    """Whether shards in folders are compared with their sha256 before a stage reads them: files that have not
    been compared in this run as they are now, all each time a stage starts, or none."""
    cluster: ClusterOptions = Field(ClusterOptions(), exclude=True)
    """What `motionloom launch` asks the cluster for; no matter of a run."""
    loggers: tuple[LoggerName, ...] = ("csv",)
    """Where the figures of trainings go, besides `metrics.jsonl`; all but csv are extras of these names."""

    @field_validator("loggers", mode="before")
    @classmethod
    def _one(cls, value: object) -> object:
        return (value,) if isinstance(value, str) else value

    def resolved_accelerator(self) -> Literal["cpu", "gpu"]:
        if self.accelerator == "auto":
            return "gpu" if torch.cuda.is_available() else "cpu"
        return self.accelerator

    def device(self) -> torch.device:
        """Where this process computes what is not training: its own GPU, else the CPU."""
        if self.resolved_accelerator() == "cpu":
            return torch.device("cpu")
        count = torch.cuda.device_count()
        if count == 0:
            raise UserError(
                "hardware.accelerator is gpu and no GPU is here; set it to auto, or give --device cpu"
            )
        if self.deterministic:  # read when matrices are multiplied for the first time
            os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
        return torch.device("cuda", local_rank() % count)

    def resolved_devices(self) -> int:
        if self.devices:
            return self.devices
        if "RANK" in os.environ and "LOCAL_WORLD_SIZE" in os.environ:  # torchrun has decided
            return int(os.environ["LOCAL_WORLD_SIZE"])
        if self.resolved_accelerator() == "cpu":
            return min(self.cpu_devices, usable_cores())
        if torch.cuda.device_count() == 0:
            raise UserError(
                "hardware.accelerator is gpu and no GPU is here; set hardware.devices to plan for another "
                "machine, or hardware.accelerator to auto"
            )
        return torch.cuda.device_count()

    def require_devices(self) -> None:
        """Refuse GPUs that are asked for and not here, before anything waits for them."""
        gpus = torch.cuda.device_count()
        if self.resolved_accelerator() == "gpu" and self.resolved_devices() > gpus:
            raise UserError(
                f"hardware.devices is {self.resolved_devices()} and {gpus or 'no'} GPU{'s are' * (gpus > 1)}"
                f"{' is' * (gpus < 2)} here; set it to what this machine has"
            )
        if self.accelerator == "auto" and self.devices > 1 and not gpus:
            raise UserError(
                f"hardware.devices is {self.devices} and no GPU is here; to train in so many processes on "
                f"the CPU set hardware.accelerator to cpu"
            )

    def workers_for(self, batches: int) -> int:
        """Loader processes of one process, for so many batches."""
        if self.workers != "auto":
            return self.workers
        if self.resolved_accelerator() == "cpu" or batches < _FEW_BATCHES:
            return 0
        processes = self.resolved_devices()
        try:  # containers have 64 MiB by default, where a batch that does not fit ends the training
            room = shutil.disk_usage("/dev/shm").free // _WORKER_ROOM
        except OSError:
            return 0
        return max(0, min(_MOST_WORKERS, usable_cores() // processes - 1, room // processes))

    def world(self) -> int:
        return self.resolved_devices() * self.nodes

    def lightning_accelerator(self) -> str:
        return "cuda" if self.resolved_accelerator() == "gpu" else "cpu"

    def backend(self) -> str:
        return "nccl" if self.resolved_accelerator() == "gpu" else "gloo"

    def describe(self) -> str:
        count = self.resolved_devices()
        nodes = self.nodes
        if self.resolved_accelerator() == "gpu":
            here = torch.cuda.is_available()
            where = f"{count} x {torch.cuda.get_device_name(0) if here else 'GPU (none is here)'}"
        else:
            why = "" if self.accelerator == "cpu" else " (no GPU found)"
            threads = f" x {self.threads} thread{'s' if self.threads > 1 else ''}" if self.threads else ""
            where = f"CPU{why}, {count} process{'es' if count > 1 else ''}{threads}"
        return where + (f", {nodes} nodes" if nodes > 1 else "")


def require_loggers(names: Sequence[LoggerName]) -> None:
    """Refuse, before anything runs, loggers whose package is not installed."""
    for name in names:
        if name != "csv" and importlib.util.find_spec(name) is None:
            raise UserError(
                f"hardware.loggers names {name}, which is not installed: pip install 'motionloom[{name}]'"
            )


FEW = 8
"""Motions that are made at once by one thread: a step of a small batch is over before a second one is awake,
and where other programs use the machine the threads wait for each other many times as long."""
SMALL = 100 * 2**20
"""Bytes of weights up to which that is so."""


@contextmanager
def threads_for(motions: int, weights: int = 0) -> Iterator[None]:
    """As many threads as so many motions at once can use, by networks of so many bytes."""
    before = torch.get_num_threads()
    torch.set_num_threads(1 if motions < FEW and weights < SMALL else before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def choose_device(choice: str | torch.device) -> torch.device:
    """`auto` (a GPU if there is one, else the CPU), `cpu`, `cuda` or `cuda:N`."""
    name = str(choice)
    if name == "auto":
        return Hardware().device()
    match = re.fullmatch(r"cpu|cuda(?::(\d+))?", name)
    if match is None:
        raise UserError(f"device '{name}': there is no such choice; take auto, cpu, cuda or cuda:N")
    count = torch.cuda.device_count()
    if name != "cpu" and int(match[1] or 0) >= count:
        here = f"GPUs 0 to {count - 1} are" if count else "no GPU is"
        raise UserError(f"device '{name}': {here} here; take another, or auto")
    return torch.device(name)
