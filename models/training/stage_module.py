"""Base of the stages' LightningModules: one seeded step, one optimizer, plain scalar logs.

Every random draw of a training step (dropout, latents, Gumbel noise) comes from a generator state that is a
pure function of (seed, step, rank), so a run that was killed and resumed repeats the undisturbed run bit for
bit; or of the sample it is for, so that a run repeats it on any number of ranks too (`layers/draws.py`).
Codebooks draw by themselves, the same on every rank (`quantize/draws.py`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, TypedDict

import lightning as L
import torch
from torch import Tensor, nn
from torch.distributed.tensor import DTensor

from motionloom.models.layers import draws
from motionloom.models.training.distributed import alone
from motionloom.models.training.optim import OptimConfig as OptimConfig
from motionloom.models.training.sharding import sharded
from motionloom.models.training.watching import Watcher

LOG_EVERY = 10
"""Steps that a row of the log averages; averaging over ranks costs a collective each."""


class Means(TypedDict):
    """Figures that were averaged together."""

    names: list[str]
    sums: Tensor
    count: int


RowMeans = list[Means]
"""What a rank has added to the means of the log's next row."""


class StageModule(L.LightningModule, ABC):
    """A network, its losses and its optimizer. Subclasses implement `losses(batch)`."""

    def __init__(self, net: nn.Module, optim: OptimConfig, *, seed: int, max_steps: int) -> None:
        super().__init__()
        self.net = net
        self.optim_config = optim
        self.seed = seed
        self.max_steps = max_steps
        self._since: dict[tuple[str, ...], tuple[Tensor, int]] = {}
        self.draw_by_sample = False
        """Whether what a step draws depends on the samples and not on the ranks."""
        self.row: tuple[str, ...] = ()
        """Names of the figures in the newest row of the log."""
        self.gauges: dict[str, float | Tensor] = {}
        """Learning rate and gradient norm of the step that the newest row of the log ends with."""
        self.watcher: Watcher | None = None
        """What looks on, if anything does."""
        self.waited = 0.0
        """Seconds that this process has waited for other ranks where it averages gradients itself."""
        self.fused = True
        """Whether the optimizer is one kernel. False for "16-mixed": a fused step also removes the scale of
        the gradients, and they could not be clipped before it."""

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
        self.seed_draws(part)
        self.key_draws(batch, part)
        values = self.losses(batch)
        self.average(values)
        if part == self.trainer.accumulate_grad_batches - 1:
            self.log_row()
        self.log("loss", values["loss"].detach(), prog_bar=True, logger=False)
        return values["loss"]

    def seed_draws(self, part: int, turn: int = 0) -> None:
        """Seed torch for one part of a step, and one of several losses that are computed on it in turn."""
        key = (self.seed * 1_000_003 + self.global_step) * 4099 + self.global_rank
        torch.manual_seed((key + (part << 48) + (turn << 56)) % 2**63)

    def key_draws(self, batch: dict[str, Any], part: int, turn: int = 0) -> None:
        """Have the draws of a part of a step depend on its samples, where they do."""
        if self.draw_by_sample:
            rows, device = len(batch["length"]), batch["length"].device
            first = (part * self.trainer.world_size + self.global_rank) * rows
            samples = torch.arange(first, first + rows, device=device)
            draws.begin(self.seed, self.global_step, samples, turn)

    def on_after_backward(self) -> None:
        """Draws by sample are for a step; a backward pass may repeat them (activation checkpointing)."""
        draws.end()

    @property
    def ends_row(self) -> bool:
        """Whether a row of the log ends with the step that is being taken."""
        return (self.global_step + 1) % LOG_EVERY == 0

    def on_train_epoch_start(self) -> None:
        """Averages begin anew with a chunk; in the middle of one a run that goes on has those so far."""
        self._since = {}

    def average(self, values: dict[str, Tensor]) -> None:
        """Add figures of a step, or of a part of one, to the means of the next row."""
        names = tuple(values)
        figures = torch.stack([v.detach().float() for v in values.values()])
        if self.watcher is not None:
            self.watcher.figures(names, figures)
        if names in self._since:
            sums, count = self._since[names]
            self._since[names] = (sums + figures, count + 1)
        else:
            self._since[names] = (figures, 1)

    def row_means(self) -> RowMeans:
        """What was added since the last row."""
        return [
            {"names": list(names), "sums": sums.cpu(), "count": count}
            for names, (sums, count) in self._since.items()
        ]

    def go_on_with_row(self, means: RowMeans) -> None:
        """Begin with what was added before."""
        self._since = {tuple(m["names"]): (m["sums"].to(self.device), m["count"]) for m in means}

    def log_row(self) -> None:
        """Where a row ends with this step: log the means of what was added since the last one."""
        if not self.ends_row:
            return
        means: dict[str, Any] = {}
        for names, (sums, count) in self._since.items():
            means |= {f"train/{k}": v for k, v in zip(names, (sums / count).unbind(), strict=True)}
        self.log_dict(means, sync_dist=True)
        self.row = tuple(means)
        self._since = {}

    def validation_step(self, batch: dict[str, Any], batch_idx: int) -> None:
        """The same losses on held-out data; every rank gets the same batches and the same figures.

        What a loss draws here depends on (seed, batch) alone, so two validations differ by the weights only.
        """
        draws.end()
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
        self.gauges = {}
        norm = self.clip(list(self.net.parameters()), gradient_clip_val)
        if norm is not None:
            self.gauges = {"lr": optimizer.param_groups[0]["lr"], "grad_norm": norm}

    def clip(self, params: list[nn.Parameter], largest: float | None) -> Tensor | None:
        """Clip by the norm of all gradients, if there is a largest one; the norm before, where a row ends."""
        norm = None
        if largest or self.ends_row:
            norm = torch.nn.utils.get_total_norm([p.grad for p in params if p.grad is not None])
        if self.watcher is not None:
            self.watcher.gradients(params, norm)
        if norm is None:
            return None
        if largest:
            torch.nn.utils.clip_grads_with_norm_(params, largest, norm)
        if not self.ends_row:
            return None
        return norm.full_tensor() if isinstance(norm, DTensor) else norm

    def configure_optimizers(self) -> Any:
        """The optimizer of the trainable parameters, linear warm-up, then constant or cosine."""
        config = self.optim_config
        optimizer = config.build([p for p in self.net.parameters() if p.requires_grad], fused=self.fused)
        schedule = torch.optim.lr_scheduler.LambdaLR(
            optimizer, lambda step: config.factor(step, self.max_steps)
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}
