"""Where a run executes: accelerator, processes, precision. Not part of any fingerprint.

The global batch belongs to the stage's config, so one process, eight GPUs or two nodes take the same steps.
"""

from __future__ import annotations

import os
from typing import Literal

import torch
from pydantic import Field

from motionloom.datasets.schema import Config


class Hardware(Config):
    """Machine settings of a recipe (`hardware:`)."""

    accelerator: Literal["auto", "cpu", "gpu"] = "auto"
    devices: int = Field(0, ge=0)
    """Processes on this node; 0 means every visible GPU, or one process on a CPU."""
    nodes: int = Field(1, ge=1)
    strategy: Literal["auto", "ddp", "fsdp"] = "auto"
    workers: int = Field(0, ge=0)
    """Loader worker processes per rank."""
    convert_workers: int = Field(2, ge=1)
    """Processes that convert or synthesise shards."""
    threads: int = Field(0, ge=0)
    """CPU threads per process; 0 leaves torch's choice."""

    def resolved_accelerator(self) -> Literal["cpu", "gpu"]:
        """`auto` made concrete."""
        if self.accelerator == "auto":
            return "gpu" if torch.cuda.is_available() else "cpu"
        return self.accelerator

    def resolved_devices(self) -> int:
        """Processes on this node."""
        if self.devices:
            return self.devices
        return torch.cuda.device_count() if self.resolved_accelerator() == "gpu" else 1

    def describe(self) -> str:
        """One readable line about what runs where."""
        count, nodes = self.resolved_devices(), self.nodes
        if self.resolved_accelerator() == "gpu":
            where = f"{count} x {torch.cuda.get_device_name(0)}"
        else:
            why = "" if self.accelerator == "cpu" else " (no GPU found)"
            where = f"CPU{why}, {count} process{'es' if count > 1 else ''} x {torch.get_num_threads()} threads"
        return where + (f", {nodes} nodes" if nodes > 1 else "")


def process_rank() -> int:
    """Global rank as the launcher states it (torchrun, SLURM, Lightning), 0 when there is none."""
    for name in ("RANK", "SLURM_PROCID", "LOCAL_RANK"):
        value = os.environ.get(name)
        if value and (name != "SLURM_PROCID" or "SLURM_NTASKS" in os.environ):
            return int(value)
    return 0
