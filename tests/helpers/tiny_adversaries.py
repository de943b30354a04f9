"""A generator and a critic on random vectors: small enough to be trained many times in a test."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from torch import Tensor, nn
from torch.utils.data import Dataset

from motionloom.datasets.loading.plan import ALONE, Share
from motionloom.models.training.alternating import AlternatingModule, OptimizerGroup
from motionloom.models.training.optim import OptimConfig
from motionloom.pipeline.contract.stage import StageCache, StageContext
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.training.config import TrainConfig
from motionloom.pipeline.training.trainer import fit

DIM = 6
GENERATOR = OptimConfig(optimizer="adam", lr=1e-2, grad_clip=0.3, warmup_steps=3)
CRITIC = OptimConfig(lr=2e-2, grad_clip=0.2, schedule="cosine", weight_decay=0.1)


class Steps(Dataset[dict[str, Any]]):
    """Item k is this rank's rows of part k % parts of batch k // parts; `made` gives the whole part.

    `dies_at` a step all ends with an error, at `hangs_at` nothing goes on, and with a step of `signalled`
    that signal comes.
    """

    def __init__(
        self,
        batch: int,
        share: Share = ALONE,
        *,
        size: int = 10**6,
        dtype: Any = torch.float32,
        dies_at: int | None = None,
        signalled: dict[int, signal.Signals] | None = None,
        hangs_at: int | None = None,
    ) -> None:
        rank, world, parts = share
        batch //= parts
        self.batch, self.parts, self.size, self.dtype = batch, parts, size, dtype
        self.dies_at, self.hangs_at, self.signalled = dies_at, hangs_at, signalled or {}
        self.rows = slice(rank * batch // world, (rank + 1) * batch // world)

    def __len__(self) -> int:
        return self.size

    def __getitem__(self, index: int) -> dict[str, Any]:
        if index >= self.size:
            raise IndexError(index)
        step, part = divmod(index, self.parts)
        if step == self.dies_at:
            raise ConnectionResetError("killed")
        if part == 0 and step in self.signalled:
            os.kill(os.getpid(), self.signalled[step])
        if step == self.hangs_at:
            time.sleep(3600)
        return self.made(step, part)

    def made(self, step: int, part: int) -> dict[str, Any]:
        raise NotImplementedError


class Vectors(Steps):
    """Random vectors; the same whether they come at once or in parts."""

    def made(self, step: int, part: int) -> dict[str, Any]:
        generator = torch.Generator().manual_seed(step)
        rows = torch.randn(self.parts * self.batch, DIM, generator=generator, dtype=torch.float64)
        rows = rows[part * self.batch :][: self.batch][self.rows].to(self.dtype)
        return {"x": rows, "length": torch.ones(len(rows)), "reader": os.getpid()}


class Duel(AlternatingModule):
    """The generator reconstructs and deceives; the critic begins at step 4 and plays every second step."""

    def __init__(
        self, *, seed: int, max_steps: int, dropout: float = 0.2, critic: OptimConfig = CRITIC, start: int = 4
    ) -> None:
        torch.manual_seed(seed)
        net = nn.Sequential(nn.Linear(DIM, 16), nn.Tanh(), nn.Dropout(dropout), nn.Linear(16, DIM))
        super().__init__(net, GENERATOR, seed=seed, max_steps=max_steps)
        self.critic = nn.Sequential(nn.Linear(DIM, 8), nn.Tanh(), nn.Linear(8, 1))
        self.unused = nn.Parameter(torch.ones(2))
        self.critic.append(nn.Identity())
        self.critic.register_parameter("idle", self.unused)
        self.critic_optim, self.start = critic, start
        self.readers: set[int] = set()
        """Processes that have read a batch."""

    def optimizer_groups(self) -> Sequence[OptimizerGroup]:
        """Generator, then critic."""
        return (
            OptimizerGroup("generator", (self.net,), self.optim_config),
            OptimizerGroup("critic", (self.critic,), self.critic_optim, every=2, start_step=self.start),
        )

    def losses_of(self, group: str, batch: dict[str, Any], shared: dict[str, Tensor]) -> dict[str, Tensor]:
        """Least-squares GAN with a reconstruction term."""
        self.readers.add(batch["reader"])
        x = batch["x"]
        if group == "generator":
            made = self.net(x)
            shared["made"] = made
            recon = (made - x).square().mean()
            return {"loss": recon + 0.3 * (self.critic(made) - 1).square().mean(), "recon": recon}
        real, fake = self.critic(x), self.critic(shared["made"])
        return {"loss": (real - 1).square().mean() + fake.square().mean(), "margin": (real - fake).mean()}


def context(folder: Path, console: Console, **hardware: Any) -> StageContext:
    """A stage in `folder`."""
    given: dict[str, Any] = {"accelerator": "cpu", "devices": 1, "threads": 1, "loggers": (), **hardware}
    return StageContext(
        name="duel", recipe="test", config=None, folder=folder, inputs={}, seed=0,
        hardware=Hardware(**given), console=console, stage_cache=StageCache(),
    )  # fmt: skip


def train(
    folder: Path,
    *,
    hardware: dict[str, Any] | None = None,
    dtype: torch.dtype = torch.float32,
    module: dict[str, Any] | None = None,
    dies_at: int | None = None,
    signalled: dict[int, signal.Signals] | None = None,
    validation_signalled: dict[int, signal.Signals] | None = None,
    console: Console | None = None,
    **settings: Any,
) -> Duel:
    """Train a duel in `folder`, from its newest checkpoint.

    `dies_at` a step all ends with an error; while a step of `signalled` is taken, or a batch of
    `validation_signalled` is read, that signal comes.
    """
    given: dict[str, Any] = {
        "steps": 24, "batch_size": 8, "checkpoint_every": 6, "validate_every": 12, **settings
    }  # fmt: skip
    config = TrainConfig(**given)
    duel = Duel(seed=3, max_steps=config.steps, **(module or {})).to(dtype)
    fit(
        context(folder, console or Console(quiet=True), **(hardware or {})),
        duel,
        config,
        lambda *place: Vectors(*place, dtype=dtype, dies_at=dies_at, signalled=signalled),
        lambda: Vectors(8, size=3, dtype=dtype, signalled=validation_signalled),
    )
    return duel
