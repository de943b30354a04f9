"""Averaged weights: an exponential moving average of a network's weights beside the ones that are trained.

The average begins with the weights after the first step. Validation and the saved model use it; training
does not. Buffers (codebooks, which are averages already, and statistics) are those of the trained network.

Lightning's own callback copies the whole module with frozen networks in it, and hands nothing over when a run
that was killed behind its last step goes on; this one averages `net` alone.
"""

from __future__ import annotations

from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback
from torch import nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from motionloom.models.training.stage_module import StageModule


class AveragedWeights(Callback):
    """Keeps the average of a `StageModule`'s network; it is in the checkpoints and equal on every rank."""

    def __init__(self, decay: float) -> None:
        self.decay = decay
        self.average: AveragedModel | None = None
        self._step = 0
        self._loaded: dict[str, Any] | None = None

    def state_dict(self) -> dict[str, Any]:
        """The average, and the step that it was last brought up to."""
        return {"step": self._step, "average": self._required().state_dict()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take the average of a checkpoint; the network that it fills is not on its device yet."""
        self._step, self._loaded = state_dict["step"], state_dict["average"]

    def on_fit_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Copy the network."""
        assert isinstance(pl_module, StageModule)
        average = get_ema_multi_avg_fn(self.decay)  # type: ignore[no-untyped-call]
        self.average = AveragedModel(pl_module.net, multi_avg_fn=average)
        if self._loaded is not None:
            self.average.load_state_dict(self._loaded)
            self._loaded = None

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Average once a step, not once a part of it."""
        assert isinstance(pl_module, StageModule)
        if trainer.global_step > self._step:
            self._required().update_parameters(pl_module.net)
            self._step = trainer.global_step

    def on_validation_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Validate with the average."""
        self._swap(pl_module)

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Train on with the trained weights."""
        self._swap(pl_module)

    @torch.no_grad()
    def fill(self, net: nn.Module) -> None:
        """Put the average into `net`, once training is over."""
        for param, mean in zip(net.parameters(), self._required().module.parameters(), strict=True):
            param.copy_(mean)

    def _required(self) -> AveragedModel:
        if self.average is None:
            raise RuntimeError("the average exists only once the fit has started")
        return self.average

    @torch.no_grad()
    def _swap(self, pl_module: L.LightningModule) -> None:
        assert isinstance(pl_module, StageModule)
        for param, mean in zip(pl_module.net.parameters(), self._required().module.parameters(), strict=True):
            trained = param.clone()
            param.copy_(mean)
            mean.copy_(trained)
