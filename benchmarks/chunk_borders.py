"""What the end of a chunk costs: the same training with checkpoints every 20 steps and every 1,000.

A small tokenizer on windows of noise, with and without loader workers. Runs take turns, and each figure is
the smallest of several: other work on the machine only ever adds. Validation is off. A border is what lies
between the last step of a chunk and the first one of the next. Run: `python benchmarks/chunk_borders.py`.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from torch import Tensor
from torch.utils.data import Dataset

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.tokenizer.build import build_tokenizer
from motionloom.models.tokenizer.config import VqConfig
from motionloom.models.tokenizer.module import TokenizerModule
from motionloom.models.training.optim import OptimConfig
from motionloom.pipeline.contract.stage import Shelf, StageContext
from motionloom.pipeline.launch.console import quiet_libraries
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.stages.train_config import TrainConfig
from motionloom.pipeline.stages.training import fit


class Windows(Dataset[dict[str, Tensor]]):
    """Item k is batch k; it notes when the first one was read."""

    def __init__(self, width: int, batch: int) -> None:
        self.width, self.batch = width, batch

    def __getitem__(self, k: int) -> dict[str, Tensor]:
        generator = torch.Generator().manual_seed(k)
        motion = torch.randn(self.batch, 64, self.width, generator=generator)
        return {"motion": motion, "length": torch.full((self.batch,), 64)}


class Timed(TokenizerModule):
    """Notes the clocks at the first steps' end and at the last one's: what is started once does not count."""

    begin: tuple[int, float, float] = (0, 0.0, 0.0)
    end: tuple[int, float, float] = (0, 0.0, 0.0)

    def on_train_start(self) -> None:
        """No border yet."""
        self.borders: list[tuple[float, float]] = []
        self.last: tuple[float, float] | None = None

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        """The first batch of a chunk is here."""
        if batch_idx == 0 and self.last is not None:
            now = time.perf_counter(), time.thread_time()
            self.borders.append((now[0] - self.last[0], now[1] - self.last[1]))

    def on_train_batch_end(self, *_: Any) -> None:
        """Read the clocks."""
        if self.global_step == 20:
            self.begin = (20, *clocks())
        self.last = time.perf_counter(), time.thread_time()

    def on_train_end(self) -> None:
        """Read the clocks; all is on disk."""
        self.end = (self.global_step, *clocks())


def clocks() -> tuple[float, float]:
    """Wall, and processor seconds of this process and its children that have ended."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return time.perf_counter(), sum(one.ru_utime + one.ru_stime for one in used)


def run(every: int, workers: int, args: argparse.Namespace) -> tuple[float, ...]:
    """Milliseconds of a step: wall, processor; and of a border: wall, the training's thread."""
    torch.manual_seed(0)
    kind = VqConfig(width=args.width, depth=2, code_dim=args.width)
    net = build_tokenizer(kind, MotionLayout.named("h3d263"))
    module = Timed(net, OptimConfig(), seed=0, max_steps=args.steps, **kind.loss_terms())
    config = TrainConfig(steps=args.steps, batch_size=args.batch, checkpoint_every=every, validate_every=0)
    with tempfile.TemporaryDirectory(dir=args.folder) as folder:
        context = StageContext(
            name="tokenizer", recipe="benchmark", config=None, folder=Path(folder), inputs={}, seed=0,
            hardware=Hardware(accelerator="cpu", devices=1, threads=1, workers=workers),
            console=Console(quiet=True), shelf=Shelf(),
        )  # fmt: skip
        fit(context, module, config, lambda *_: Windows(net.dim, args.batch), None, 1.0)
    steps = module.end[0] - module.begin[0]
    step = [1000 * (b - a) / steps for a, b in zip(module.begin[1:], module.end[1:], strict=True)]
    borders = module.borders[1:]  # the first one starts what is started once
    return *step, *(1000 * statistics.median(one[k] for one in borders) if borders else 0.0 for k in range(2))


def main() -> None:
    """Print milliseconds a step and their ratio."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=220)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--width", type=int, default=64)
    parser.add_argument("--workers", type=int, nargs="*", default=[0, 2])
    parser.add_argument("--folder", type=Path, help="where checkpoints are written")
    args = parser.parse_args()
    quiet_libraries()
    for workers in args.workers:
        rounds = [[run(every, workers, args) for every in (20, 1000)] for _ in range(args.rounds)]
        for place, clock in enumerate(("wall", "processor")):
            often, seldom = (min(one[which][place] for one in rounds) for which in range(2))
            print(
                f"workers {workers}, {clock}: {often:.2f} ms a step with checkpoints every 20, "
                f"{seldom:.2f} every 1000, ratio {often / seldom:.3f}",
                flush=True,
            )
        wall, thread = (min(one[0][place] for one in rounds) for place in (2, 3))
        print(
            f"workers {workers}, a border: {wall:.2f} ms, of the training's thread {thread:.2f}", flush=True
        )


if __name__ == "__main__":
    main()
