"""The processes of one run: who leads, how the others join and wait for it.

The lead (rank 0) runs every stage and is the only one that writes; the others take part in training stages.
They start together, before anything is written, so all of them see the same plan. Processes come from
Lightning's launcher (which repeats the command) or from torchrun or SLURM.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from datetime import timedelta

import torch.distributed as dist
from lightning.fabric import Fabric
from lightning.fabric.strategies.ddp import DDPStrategy

from motionloom.datasets.schema import UserError
from motionloom.pipeline.hardware import Hardware
from motionloom.pipeline.process import TeamError

_PATIENCE = timedelta(days=30)
"""How long the others wait for a stage that only the lead runs; a dead lead ends the wait at once."""


@dataclass(frozen=True)
class Team:
    """All processes of a run."""

    rank: int = 0
    world: int = 1
    waiting: dist.ProcessGroup | None = None
    """A group of its own, because the training group's collectives must fail early and waiting must not."""

    @staticmethod
    def start(hardware: Hardware) -> Team:
        """Launch the other processes, or join them where a launcher has; returns when all are here."""
        world = hardware.world()
        launched = os.environ.get("WORLD_SIZE") if "RANK" in os.environ else None
        if launched is not None and int(launched) != world:
            raise UserError(
                f"the launcher started {launched} processes and the recipe asks for {world}: set "
                f"hardware.devices (processes on a node) and hardware.nodes to match it"
            )
        if world == 1:
            return Team()
        fabric = Fabric(
            accelerator=hardware.lightning_accelerator(),
            devices=hardware.resolved_devices(),
            num_nodes=hardware.nodes,
            strategy=DDPStrategy(process_group_backend=hardware.backend()),
        )
        fabric.launch()
        return Team(fabric.global_rank, fabric.world_size, dist.new_group(backend="gloo", timeout=_PATIENCE))

    @property
    def leads(self) -> bool:
        """True in the one process that writes."""
        return self.rank == 0

    def meet(self) -> None:
        """Wait until every process is here."""
        if self.waiting is None:
            return
        try:
            dist.barrier(self.waiting)
        except RuntimeError as error:
            raise TeamError(str(error)) from None
