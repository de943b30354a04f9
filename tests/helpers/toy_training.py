"""A stage kind that trains a small network on random vectors, and goes wrong where its settings say so."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import torch
from tiny_adversaries import DIM, Steps
from torch import Tensor, nn
from toy_stages import register_toys

from motionloom.datasets.loading.plan import Share
from motionloom.models.training.stage_module import StageModule
from motionloom.pipeline.contract.stage import Inputs
from motionloom.pipeline.store.weights import LayoutFacts, ModelFacts
from motionloom.pipeline.training.config import TrainConfig, TrainedStageConfig
from motionloom.pipeline.training.trained_stage import Batches, Example, Log, TrainedStage


class ToyConfig(TrainedStageConfig):
    """Sizes, and what goes wrong with which batch."""

    width: int = 8
    dropout: float = 0.2
    """Drawn by each process for itself: without it they train as one."""
    fails_at: int | None = None
    """Number of the batch."""
    failure: Literal["nan", "error"] = "nan"
    fails_on_rank: int = 0
    train: TrainConfig = TrainConfig(steps=30, batch_size=8, checkpoint_every=5, validate_every=0)


class ToyNet(nn.Module):
    """Two layer groups."""

    def __init__(self, width: int, dropout: float) -> None:
        super().__init__()
        self.encoder = nn.Sequential(nn.Linear(DIM, width), nn.Tanh(), nn.Dropout(dropout))
        self.decoder = nn.Linear(width, DIM)

    def forward(self, x: Tensor) -> Tensor:
        """Reconstruct rows [B, D]."""
        out: Tensor = self.decoder(self.encoder(x))
        return out


class ToyModule(StageModule):
    """A reconstruction, and a penalty that is always finite."""

    def losses(self, batch: dict[str, Any]) -> dict[str, Tensor]:
        """Reconstruction error and the size of what is made."""
        if bool(batch["broken"].any()):
            raise ArithmeticError("the toy is broken")
        made = self.net(batch["motion"])
        recon = (made - batch["motion"]).square().mean()
        return {"loss": recon, "recon": recon, "weight": self.net.decoder.weight.square().mean()}


class ToyBatches(Steps):
    """Item k is this rank's rows of batch k."""

    def __init__(self, config: ToyConfig, seed: int, batch: int, share: Share) -> None:
        super().__init__(batch, share)
        self.config, self.seed, self.rank = config, seed, share.rank

    def made(self, step: int, part: int) -> dict[str, Tensor]:
        generator = torch.Generator().manual_seed(self.seed * 10**6 + step)
        rows = torch.randn(self.batch, DIM, generator=generator)[self.rows]
        fails = step == self.config.fails_at and self.rank == self.config.fails_on_rank
        if fails and self.config.failure == "nan":
            rows[1, 2] = torch.nan
        broken = torch.full((len(rows),), fails and self.config.failure == "error")
        return {"motion": rows, "length": torch.full((len(rows),), 3), "broken": broken}


class ToyTraining(TrainedStage):
    """`kind: toy`; it needs no data."""

    name, summary, config = "toy", "a toy", ToyConfig
    takes = ()

    def facts(self, config: Any, given: Inputs) -> ModelFacts:
        """Its width."""
        layout = LayoutFacts(name="body133", fps=20.0, family="exact")
        return ModelFacts(
            kind="toy", config={"width": config.width, "dropout": config.dropout}, layout=layout
        )

    def network(self, facts: ModelFacts, given: Inputs) -> nn.Module:
        """Untrained."""
        return ToyNet(facts.config["width"], facts.config["dropout"])

    def module(self, config: Any, net: nn.Module, given: Inputs, seed: int) -> StageModule:
        """With its loss."""
        return ToyModule(net, config.optim, seed=seed, max_steps=config.train.steps)

    def batches(self, config: Any, net: nn.Module, given: Inputs, seed: int, log: Log) -> Batches:
        """Random vectors."""
        return Batches(lambda *at: ToyBatches(config, seed, *at), None)

    def example(self, config: Any, net: nn.Module, given: Inputs, batch: int) -> Example:
        """Never asked for."""
        raise AssertionError("a toy is not estimated")


RECIPE = """
name: toys
seed: 4
hardware: {accelerator: cpu, devices: 1, threads: 1, loggers: []}
stages:
  toy: {kind: toy, optim: {lr: 0.01}}
"""


def toy_recipe(folder: Path, monkeypatch: Any) -> Path:
    """A recipe of one toy, which is known until the test ends."""
    register_toys(monkeypatch, ToyTraining())
    path = folder / "toys.yaml"
    path.write_text(RECIPE)
    return path
