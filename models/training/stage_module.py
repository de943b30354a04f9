"""Base of the stages' LightningModules: a network, its losses, and one training step.

Every random draw of a training step (dropout, latents, Gumbel noise) comes from a generator state that is a
pure function of (seed, step, rank), so a run that was killed and resumed repeats the undisturbed run bit for
bit.
Codebooks draw by themselves, the same on every rank (`quantize/base.py`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any, NamedTuple, TypedDict

import lightning as L
import torch
from lightning.fabric import Fabric
from torch import Tensor, nn
from torch.amp import GradScaler
from torch.distributed.tensor import DTensor
from torch.nn.parallel import DistributedDataParallel
from torch.optim import Optimizer

from motionloom.models.training.distributed import alone, rank
from motionloom.models.training.optim import OptimConfig as OptimConfig

LOG_EVERY = 10
"""Steps that a row of the log averages."""

Batch = dict[str, Any]
"""Tensors, and conditions of tensors, by name (`datasets/loading`)."""


class Means(TypedDict):
    """Figures that were averaged together."""

    names: list[str]
    sums: Tensor
    count: int


class StepFigures(NamedTuple):
    """Losses and metrics of one part of a step, still on the device."""

    step: int
    """Counted from 1, as in the log."""
    names: tuple[str, ...]
    values: Tensor
    """float32 [len(names)]."""


@dataclass(frozen=True)
class Execution:
    """How this process computes a step: devices, precision and processes are Fabric's."""

    fabric: Fabric
    model: nn.Module
    """The module, or DDP around it; its `forward` is `StageModule.forward`."""
    half: torch.dtype | None = None
    """Type of mixed precision; None computes in the type of the weights."""
    scaler: GradScaler | None = None
    """The loss scaler of float16, which alone needs one."""

    def autocast(self) -> AbstractContextManager[object]:
        """Mixed precision of a forward pass; every use of a weight has a cast of its own, so that its
        gradients add up in float32.
        """
        device = self.fabric.device.type
        enabled = self.half is not None
        return torch.autocast(device, dtype=self.half, enabled=enabled, cache_enabled=False)

    def without_sync(self, skip: bool) -> AbstractContextManager[object]:
        """Inside, DDP does not average gradients if `skip`: more parts of the step follow."""
        if skip and isinstance(self.model, DistributedDataParallel):
            no_sync: AbstractContextManager[object] = self.model.no_sync()
            return no_sync
        return nullcontext()

    def step(self, optimizer: Optimizer) -> None:
        """Let an optimizer step; float16 passes over steps whose gradients overflow."""
        if self.scaler is None:
            optimizer.step()
        else:
            self.scaler.step(optimizer)


class StageModule(L.LightningModule, ABC):
    """A network, its losses and its optimizer. Subclasses implement `losses(batch)`."""

    def __init__(self, net: nn.Module, optim: OptimConfig, *, seed: int, max_steps: int) -> None:
        super().__init__()
        self.net = net
        self.optim_config = optim
        self.seed = seed
        self.max_steps = max_steps
        self.step = 0
        """Steps that are done."""
        self.accumulate = 1
        """Parts that the batch of a step is cut into."""
        self.fused = True
        """Whether the optimizer is one kernel. False for "16-mixed": a fused step also removes the scale of
        the gradients, and they could not be clipped before it."""
        self.gauges: dict[str, float | Tensor] = {}
        """Learning rate and gradient norm of the step that the newest row of the log ends with."""
        self.figures: list[StepFigures] = []
        """Return the means over all parts of steps since these lists were last cleared."""
        self.norms: list[tuple[int, Tensor]] = []
        """(step, norm of the gradients) likewise, where a norm was computed."""
        self._sums: dict[tuple[str, ...], tuple[Tensor, int]] = {}

    @abstractmethod
    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Losses and scalar metrics of one batch; "loss" is minimised, the others are only logged."""

    def compile_losses(self) -> None:
        """Compile networks and losses as one graph; seeding and logging stay outside. A break is an error.

        Graphs of stages that ran before in this process are dropped: the number that one function may have
        is limited, and all tokenizers share theirs.
        """
        torch.compiler.reset()
        self.losses = torch.compile(self.losses, fullgraph=True)  # type: ignore[method-assign]

    def configure_optimizers(self) -> list[Optimizer]:
        """The optimizer of the trainable parameters; `take_step` sets its learning rate."""
        trained = [param for param in self.net.parameters() if param.requires_grad]
        return [self.optim_config.build(trained, fused=self.fused)]

    def take_step(self, parts: Iterable[Batch], optimizers: list[Optimizer], how: Execution) -> Tensor:
        """One training step on the parts of its batch; the loss of the last part."""
        (optimizer,) = optimizers
        config, loss = self.optim_config, torch.zeros(())
        for group in optimizer.param_groups:
            group["lr"] = config.lr * config.factor(self.step, self.max_steps)
        optimizer.zero_grad()
        for number, batch in enumerate(parts):
            with how.without_sync(number < self.accumulate - 1):
                with how.autocast():
                    loss = how.model(batch, number)
                how.fabric.backward(loss / self.accumulate)
        if how.scaler is not None:
            how.scaler.unscale_(optimizer)
        self.gauges = {}
        norm = self.clip(list(self.net.parameters()), config.grad_clip)
        if norm is not None:
            self.gauges = {"lr": optimizer.param_groups[0]["lr"], "grad_norm": norm}
        how.step(optimizer)
        if how.scaler is not None:
            how.scaler.update()
        self.step += 1
        return loss.detach()

    def forward(self, batch: Batch, part: int) -> Tensor:
        """Loss of one part of a step; seeds torch from (seed, step, part, rank) first."""
        self.seed_draws(part)
        values = self.losses(batch)
        self.average(values)
        return values["loss"]

    def seed_draws(self, part: int, turn: int = 0) -> None:
        """Seed torch for one part of a step, and one of several losses that are computed on it in turn."""
        key = (self.seed * 1_000_003 + self.step) * 4099 + rank()
        torch.manual_seed((key + (part << 48) + (turn << 56)) % 2**63)

    @property
    def ends_row(self) -> bool:
        """Whether a row of the log ends with the step that is being taken."""
        return (self.step + 1) % LOG_EVERY == 0

    def average(self, values: dict[str, Tensor]) -> None:
        """Add figures of a step, or of a part of one, to the means of the next row."""
        names = tuple(values)
        figures = torch.stack([v.detach().float() for v in values.values()])
        self.figures.append(StepFigures(self.step + 1, names, figures))
        sums, count = self._sums.get(names, (None, 0))
        self._sums[names] = (figures if sums is None else sums + figures, count + 1)

    def take_row(self) -> dict[str, Tensor]:
        """Means since the last row, "train/NAME" -> scalar; the next row begins."""
        means: dict[str, Tensor] = {}
        for names, (sums, count) in self._sums.items():
            means |= {f"train/{k}": v for k, v in zip(names, (sums / count).unbind(), strict=True)}
        self._sums = {}
        return means

    def row_state(self) -> list[Means]:
        """Return the sums since the last row, for a checkpoint."""
        return [
            {"names": list(names), "sums": sums.cpu(), "count": count}
            for names, (sums, count) in self._sums.items()
        ]

    def load_row(self, means: Iterable[Means]) -> None:
        self._sums = {tuple(m["names"]): (m["sums"].to(self.device), m["count"]) for m in means}

    def validation_step(self, batch: Batch, batch_idx: int) -> dict[str, Tensor]:
        """Losses on held-out data; every rank gets the same batches and the same figures.

        What a loss draws here depends on (seed, batch) alone, so two validations differ by the weights only.
        """
        torch.manual_seed((self.seed * 1_000_003 + batch_idx) % 2**63)
        with alone():
            return self.losses(batch)

    def clip(self, params: list[nn.Parameter], largest: float) -> Tensor | None:
        """Clip by the norm of all gradients (0 = not at all); the norm before, if a row of the log ends."""
        if not largest and not self.ends_row:
            return None
        norm = torch.nn.utils.get_total_norm([p.grad for p in params if p.grad is not None])
        whole = norm.full_tensor() if isinstance(norm, DTensor) else norm
        self.norms.append((self.step + 1, whole))
        if largest:
            torch.nn.utils.clip_grads_with_norm_(params, largest, norm)
        return whole if self.ends_row else None
