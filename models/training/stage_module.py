"""Base of the stages' LightningModules: one seeded step, one optimizer, plain scalar logs.

Every random draw of a training step (dropout, latents, Gumbel noise) comes from a generator state that is a
pure function of (seed, step, rank), so a run that was killed and resumed repeats the undisturbed run bit for
bit. Codebooks draw by themselves, the same on every rank (`quantize/draws.py`).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any, Literal

import lightning as L
import torch
from pydantic import Field
from torch import Tensor, nn

from motionloom.datasets.schema import Config
from motionloom.models.training.distributed import alone
from motionloom.models.training.sharding import sharded

LOG_EVERY = 10
"""Steps that a row of the log averages; averaging over ranks costs a collective each."""


class OptimConfig(Config):
    """AdamW and its learning-rate schedule."""

    lr: float = Field(1e-4, gt=0)
    betas: tuple[float, float] = (0.9, 0.99)
    weight_decay: float = Field(0.0, ge=0)
    warmup_steps: int = Field(0, ge=0)
    schedule: Literal["constant", "cosine"] = "constant"
    grad_clip: float = Field(1.0, ge=0)
    """Largest gradient norm; 0 turns clipping off."""


class StageModule(L.LightningModule, ABC):
    """A network, its losses and its optimizer. Subclasses implement `losses(batch)`."""

    def __init__(self, net: nn.Module, optim: OptimConfig, *, seed: int, max_steps: int) -> None:
        super().__init__()
        self.net = net
        self.optim_config = optim
        self.seed = seed
        self.max_steps = max_steps
        self._since: Tensor | None = None
        self._count = 0
        self.fused = True
        """Whether AdamW is one kernel. False for "16-mixed": a fused step also removes the scale of the
        gradients, and they could not be clipped before it."""

    @abstractmethod
    def losses(self, batch: dict[str, Any]) -> dict[str, Tensor]:
        """Losses and scalar metrics of one batch; "loss" is minimised, the others are only logged."""

    def configure_model(self) -> None:
        """Cut the network over the ranks where the strategy lays them out for that (FSDP)."""
        if self.device_mesh is not None:
            self.net = sharded(self.net, self.device_mesh["data_parallel"])

    def compile_losses(self) -> None:
        """Compile networks and losses as one graph; seeding and logging stay outside. A break is an error.

        Graphs of stages that ran before in this process are dropped: the number that one function may have
        is limited, and all tokenizers share theirs.
        """
        torch.compiler.reset()
        self.losses = torch.compile(self.losses, fullgraph=True)  # type: ignore[method-assign]

    def training_step(self, batch: dict[str, Any], batch_idx: int) -> Tensor:
        """One step; seeds torch from (seed, step, part of the step, rank) first."""
        part = batch_idx % self.trainer.accumulate_grad_batches
        key = (self.seed * 1_000_003 + self.global_step) * 4099 + self.global_rank
        torch.manual_seed((key + (part << 48)) % 2**63)
        values = self.losses(batch)
        self._average(values, last=part == self.trainer.accumulate_grad_batches - 1)
        self.log("loss", values["loss"].detach(), prog_bar=True, logger=False)
        return values["loss"]

    def on_train_epoch_start(self) -> None:
        """Averages begin anew with a chunk, as they do in a run that goes on from its checkpoint."""
        self._since, self._count = None, 0

    def _average(self, values: dict[str, Tensor], *, last: bool) -> None:
        """Log the means over the steps, and parts of steps, since the last row."""
        figures = torch.stack([v.detach().float() for v in values.values()])
        self._since = figures if self._since is None else self._since + figures
        self._count += 1
        if last and (self.global_step + 1) % LOG_EVERY == 0:
            means = (self._since / self._count).unbind()
            self.log_dict({f"train/{k}": v for k, v in zip(values, means, strict=True)}, sync_dist=True)
            self._since, self._count = None, 0

    def validation_step(self, batch: dict[str, Any], batch_idx: int) -> None:
        """The same losses on held-out data; every rank gets the same batches and the same figures.

        What a loss draws here depends on (seed, batch) alone, so two validations differ by the weights only.
        """
        torch.manual_seed((self.seed * 1_000_003 + batch_idx) % 2**63)
        with alone():
            values = self.losses(batch)
        size = len(batch["length"])
        self.log_dict({f"val/{k}": v for k, v in values.items()}, batch_size=size)

    def configure_gradient_clipping(
        self,
        optimizer: torch.optim.Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clip by the norm of all gradients, those cut over ranks too.

        Lightning's own would refuse a fused optimizer in every mixed precision, bfloat16 included.
        """
        if gradient_clip_val:
            torch.nn.utils.clip_grad_norm_(self.net.parameters(), gradient_clip_val)

    def configure_optimizers(self) -> Any:
        """AdamW over the trainable parameters, linear warm-up, then constant or cosine."""
        config = self.optim_config
        params = [p for p in self.net.parameters() if p.requires_grad]
        optimizer = torch.optim.AdamW(
            params, lr=config.lr, betas=config.betas, weight_decay=config.weight_decay, fused=self.fused
        )

        def factor(step: int) -> float:
            if step < config.warmup_steps:
                return (step + 1) / config.warmup_steps
            if config.schedule == "constant":
                return 1.0
            done = (step - config.warmup_steps) / max(1, self.max_steps - config.warmup_steps)
            return 0.5 * (1 + math.cos(math.pi * min(1.0, done)))

        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, factor)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}
