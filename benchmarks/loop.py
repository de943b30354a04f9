"""What a training loop itself costs: CPU time of a step of a module that computes next to nothing.

    python benchmarks/loop.py --steps 2000

The same steps by hand, by `motionloom run`'s own trainer with everything that it watches, and by a plain
`lightning.Trainer`, which logs figures at every step. The ratio is that to the steps by hand.
"""

from __future__ import annotations

import logging
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning as L
import torch
from bench import Column, arguments, command_line, report
from rich.console import Console
from torch import Tensor, nn
from torch.utils.data import DataLoader

from motionloom.models.training.optim import OptimConfig
from motionloom.models.training.stage_module import LOG_EVERY, Batch, StageModule
from motionloom.pipeline.contract.stage import StageCache, StageContext
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.training.config import TrainConfig
from motionloom.pipeline.training.trainer import fit


class Empty(StageModule):
    """One weight, three figures."""

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        made = self.net(batch["motion"]).sum()
        return {"loss": made, "sum": batch["motion"].sum(), "mean": batch["motion"].mean()}


class Ones:
    """A batch of one row, for ever."""

    def __len__(self) -> int:
        return 10**9

    def __getitem__(self, k: int) -> Batch:
        if k >= len(self):
            raise IndexError(k)
        return {"motion": torch.ones(1, 1), "length": torch.ones(1, dtype=torch.long)}


def empty(steps: int) -> Empty:
    return Empty(nn.Linear(1, 1), OptimConfig(), seed=0, max_steps=steps)


def by_hand(steps: int) -> None:
    """The same calls as a loop of a dozen lines."""
    module = empty(steps)
    batches = Ones()
    optimizer: Any = module.configure_optimizers()[0]["optimizer"]
    for step in range(steps):
        module.schedule.set_step(step)
        optimizer.zero_grad()
        loss = module.training_step(batches[step], step)
        assert loss is not None
        loss.backward()  # type: ignore[no-untyped-call]
        module.configure_gradient_clipping(optimizer)
        optimizer.step()
        module.step += 1
        if module.step % LOG_EVERY == 0:
            module.take_row()


def by_motionloom(steps: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        context = StageContext(
            name="empty",
            recipe="loop",
            config=None,
            folder=Path(folder),
            inputs={},
            seed=0,
            hardware=Hardware(accelerator="cpu", devices=1, threads=1),
            console=Console(quiet=True),
            stage_cache=StageCache(),
        )
        train = TrainConfig(steps=steps, batch_size=1, checkpoint_every=steps, validate_every=0)
        fit(context, empty(steps), train, lambda *_: Ones(), None)


def by_lightning(steps: int) -> None:
    quiet: dict[str, Any] = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    trainer = L.Trainer(max_steps=steps, accelerator="cpu", enable_model_summary=False, **quiet)
    trainer.fit(empty(steps), DataLoader([Ones()[0]] * steps, batch_size=None))


COLUMNS = (Column("CPU ms a step", "ms"), Column("times by hand", "ratio"))
LOOPS: dict[str, Callable[[int], None]] = {
    "by hand": by_hand,
    "motionloom run": by_motionloom,
    "lightning.Trainer, all figures at every step": by_lightning,
}


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--steps", type=int, default=2000)
    args = arguments(parser)
    warnings.simplefilter("ignore")
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    rows: list[dict[str, Any]] = []
    for name, loop in LOOPS.items():
        loop(50)  # what is made once
        begin = time.process_time()
        loop(args.steps)
        each = 1000 * (time.process_time() - begin) / args.steps
        first = float(rows[0]["cells"]["ms"]) if rows else each
        rows.append({"title": name, "cells": {"ms": f"{each:.3f}", "ratio": f"{each / first:.1f}"}})
    report("A training loop alone", COLUMNS, rows, args.record)


if __name__ == "__main__":
    main()
