"""What ranks tell each other at a row's end, and how long each has waited for the others.

Two waits can be seen **[ours]**. A rank that came late to a step (its batch was not there) keeps those that
were there waiting in the step's first collective: their step lasts longer than its own by what it was late.
And behind its own backward pass a rank waits for the gradients of the others: DDP times that by itself in
some of its steps, and players time their own averaging. The larger of both is noted; the first may contain
the second. What a rank waits within FSDP's gathering is not seen.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import lightning as L
import torch
import torch.distributed as dist
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel

from motionloom.models.training.stage_module import StageModule


def gathered(trainer: L.Trainer, values: Sequence[float]) -> Tensor:
    """The values of all ranks, float64 [W, len(values)] on the CPU; a collective."""
    own = torch.tensor(values, dtype=torch.float64)
    if trainer.world_size == 1:
        return own[None]
    own = own.to(trainer.strategy.root_device)
    found = [torch.empty_like(own) for _ in range(trainer.world_size)]
    dist.all_gather(found, own)
    return torch.stack(found).cpu()


def waited_in_steps(seconds: Tensor, rank: int) -> float:
    """Seconds that a rank's steps lasted longer than those of the rank that came last; `seconds` [W, K]."""
    return float((seconds[rank] - seconds.min(dim=0).values).sum())


class GradientWaits:
    """Seconds spent waiting for other ranks' gradients, from row to row."""

    def __init__(self) -> None:
        self._own = 0.0

    def since(self, trainer: L.Trainer, module: StageModule, steps: int) -> float:
        """In the `steps` steps since the last call."""
        before, self._own = self._own, module.waited
        model = trainer.strategy.model
        if not isinstance(model, DistributedDataParallel) or not module.automatic_optimization:
            return module.waited - before
        read: Callable[[], dict[str, Any]] = model._get_ddp_logging_data
        figures = read()  # torch keeps these; it measures one step in a hundred
        whole = float(figures.get("avg_backward_comm_time", 0))
        hidden = float(figures.get("avg_backward_compute_comm_overlap_time", 0))
        return max(0.0, whole - hidden) * 1e-9 * steps
