"""What becomes of a training whose loss or gradient is not finite any more: all processes act as one."""

from __future__ import annotations

import math
from collections.abc import Sequence

import lightning as L
import torch.distributed as dist
from rich.console import Console
from rich.markup import escape

from motionloom.datasets.schema import UserError
from motionloom.models.training.stage_module import StageModule
from motionloom.pipeline.flight.bundles import Bundles
from motionloom.pipeline.flight.watch import Failure
from motionloom.pipeline.launch.process import TeamError


class NotFiniteError(UserError):
    """A loss or a gradient was not finite; the sentence names rank, step, terms and the replay."""


class NotFinite:
    """Stops a training that is lost, or says so once and lets it go on."""

    def __init__(self, name: str, console: Console, *, stop: bool) -> None:
        self.name, self.console, self.stop = name, console, stop
        self._over = False

    def decide(
        self,
        trainer: L.Trainer,
        module: StageModule,
        failure: Failure | None,
        codes: Sequence[float],
        bundles: Bundles,
    ) -> None:
        """What each process has found (`Failure.code`, infinite for nothing) -> an error in all, or none.

        The process that failed first leaves a bundle; every process calls this at the same step.
        """
        code = min(codes)
        if not math.isfinite(code) or self._over:
            return
        self._over = True
        rank = list(codes).index(code)
        bundles.wait(trainer.world_size)
        said: list[str | None] = [None]
        if rank == trainer.global_rank:
            assert failure is not None
            said = [self._sentence(trainer, module, failure, rank, bundles)]
        if trainer.world_size > 1:
            dist.broadcast_object_list(said, src=rank)
        sentence = str(said[0])
        if not self.stop:
            self.console.print(f"[yellow]    {escape(sentence)}[/]", soft_wrap=True)
        elif trainer.is_global_zero:
            raise NotFiniteError(sentence)
        else:
            raise TeamError(sentence)

    def _sentence(
        self, trainer: L.Trainer, module: StageModule, failure: Failure, rank: int, bundles: Bundles
    ) -> str:
        where = f"stage {self.name}: in step {failure.step} on rank {rank} {failure.say()}"
        folder, problem = bundles.of_failure(trainer, module, failure, where)
        if problem:
            return f"{where}; no crash bundle could be written ({problem})"
        return f"{where}; repeat that step with: {bundles.command(folder)}"
