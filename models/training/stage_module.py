"""Base of the stages' LightningModules: a network, its losses, and one training step.

`motionloom run` trains them by a `lightning.Trainer` with callbacks of its own (`pipeline/training`); any
other Trainer, and a loop by hand, comes to the same weights.

Every random draw of a training step (dropout, latents, Gumbel noise) comes from a generator state that is a
pure function of (seed, step, rank), so a resumed run repeats the undisturbed run bit for bit.
Codebooks draw by themselves, the same on every rank (`quantize/base.py`).
"""

from __future__ import annotations

import copy
import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import IO, Any, Self, TypedDict

import lightning as L
import torch
from lightning.pytorch.strategies import ModelParallelStrategy
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor, nn
from torch.distributed.tensor import DTensor
from torch.optim import Optimizer

from motionloom.datasets.base.errors import UserError
from motionloom.models.layers.frozen import Frozen
from motionloom.models.training.any_trainer import require_batch, require_trainer, require_weights
from motionloom.models.training.averaging import AveragedWeights
from motionloom.models.training.compiled import Compiled
from motionloom.models.training.distributed import alone, rank
from motionloom.models.training.finite import LOG_EVERY as LOG_EVERY
from motionloom.models.training.finite import StepFigures as StepFigures
from motionloom.models.training.finite import StopNotFinite
from motionloom.models.training.optim import OptimConfig as OptimConfig
from motionloom.models.training.optim import StepSchedule as StepSchedule
from motionloom.models.training.sharding import cut_over, whole_weights

Batch = dict[str, Any]
"""Tensors, and conditions of tensors, by name (`datasets/loading`)."""


class Means(TypedDict):
    """Sums of losses and metrics that are averaged together."""

    names: list[str]
    sums: Tensor
    count: int


class StageModule(L.LightningModule, ABC):
    """A network, its losses and its optimizer. Subclasses implement `losses(batch)`."""

    compilable = True
    """Whether `compile_losses` is known to work; torch cannot compile recurrent networks as one graph."""
    shardable = False
    """Whether FSDP can cut the network: it is used through `forward` alone, and has no codebook."""

    def __init__(self, net: nn.Module, optim: OptimConfig, *, seed: int, max_steps: int) -> None:
        super().__init__()
        self.net = net
        self.optim_config = optim
        self.seed = seed
        self.max_steps = max_steps
        self._step = 0
        self.accumulate = 1
        """Parts that the batch of a step is cut into."""
        self.ema: float | None = None
        """Decay of the average of the weights that a Trainer keeps; None for none."""
        self.logs_rows = False
        """Whether a callback logs the means of ten steps, so that no step is logged by itself."""
        self.gauges: dict[str, float | Tensor] = {}
        """Learning rate and gradient norm of the step that the newest row of the log ends with."""
        self.figures: list[StepFigures] = []
        """Figures of all parts of steps since these lists were last cleared."""
        self.norms: list[tuple[int, Tensor]] = []
        """(step, norm of the gradients) likewise, where a norm was computed."""
        self._sums: dict[tuple[str, ...], tuple[Tensor, int]] = {}
        self._seen: set[bool] = set()
        """Modes, training or not, whose first batch has been looked at."""
        self._whole: list[nn.Module] = []
        """The network of which a cut copy is trained, out of reach of `parameters`."""

    @property
    def step(self) -> int:
        """Number of steps done, by the Trainer's count if there is one."""
        return self._step if self._trainer is None else self._trainer.global_step

    @step.setter
    def step(self, step: int) -> None:
        self._step = step

    @property
    def lr(self) -> float:
        """The highest learning rate, by the name that Lightning's `Tuner.lr_find` looks for."""
        return self.optim_config.lr

    @lr.setter
    def lr(self, lr: float) -> None:
        self.optim_config = self.optim_config.model_copy(update={"lr": lr})

    def setup(self, stage: str) -> None:
        """Take `accumulate_grad_batches` over from a Trainer; `UserError` where it would train wrongly."""
        require_trainer(self, self.trainer, stage, shardable=self.shardable)
        self._seen = set()
        if self.automatic_optimization:
            self.accumulate = self.trainer.accumulate_grad_batches

    def configure_callbacks(self) -> Sequence[L.Callback]:
        """Return what every Trainer needs: an end where a loss is not finite, and the average of `ema`."""
        if self.logs_rows:  # the pipeline's own callbacks do both
            return []
        return [*([AveragedWeights(self.ema)] if self.ema else []), StopNotFinite()]

    def configure_model(self) -> None:
        """Under FSDP, replace the network by a copy that is cut over the ranks."""
        if self._trainer is not None and isinstance(self.trainer.strategy, ModelParallelStrategy):
            assert self.device_mesh is not None
            self._whole.append(self.net)
            self.net = cut_over(copy.deepcopy(self.net), self.device_mesh["data_parallel"])

    def on_fit_start(self) -> None:
        """Move frozen networks to the device of `net`."""
        for value in vars(self).values():
            if isinstance(value, Frozen):
                value.module.to(self.device)

    def on_train_start(self) -> None:
        """Go on with the settings and the schedule of now, whatever a checkpoint was written with."""
        for optimizer in self.trainer.optimizers:
            for group in optimizer.param_groups:
                group |= {key: optimizer.defaults[key] for key in ("betas", "weight_decay")}
        for config in self.trainer.lr_scheduler_configs:
            if isinstance(config.scheduler, StepSchedule) and self.automatic_optimization:
                config.scheduler.set_step(self.step)  # others set theirs as they step

    def on_fit_end(self) -> None:
        """Give the whole network back its weights, where a cut copy was trained; a collective."""
        if self._whole:
            weights = whole_weights(self.net)
            self.net = self._whole.pop()
            if rank() == 0:
                self.net.load_state_dict(weights)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Raise `OtherNetworkError` where the checkpoint's weights do not fit."""
        if "state_dict" in checkpoint:  # FSDP has loaded it already
            require_weights(checkpoint["state_dict"], self.state_dict())

    @classmethod
    def load_from_checkpoint(
        cls,
        checkpoint_path: str | Path | IO[bytes],
        map_location: Any = None,
        hparams_file: str | Path | None = None,
        strict: bool | None = None,
        weights_only: bool | None = None,
        **arguments: Any,
    ) -> Self:
        """Return a module with a checkpoint's weights, of a run's own training or of a Trainer's.

        Its hyper-parameters name the kind of stage, the config and the folders of the stages that fed it.
        Those may lie elsewhere by now: `inputs={"data": "runs/other/stages/data"}`. With `net` and `optim`
        among the arguments the module is built from these alone, as a module built by hand must be.

        Raises:
            UserError: An input is not there, or the checkpoint has no hyper-parameters.
        """
        if "net" in arguments:
            return super().load_from_checkpoint(
                checkpoint_path, map_location, hparams_file, strict, weights_only, **arguments
            )
        # Who knows kinds of stages stands on the floor above, and is found as a package's plugin is.
        (who,) = entry_points(group="motionloom.checkpoints", name="stage")
        rebuild = who.load()
        content = torch.load(checkpoint_path, map_location or "cpu", weights_only=True)
        module = rebuild(content, checkpoint_path, arguments.get("inputs", {}))
        if not isinstance(module, cls):
            raise TypeError(f"{checkpoint_path} is of a {type(module).__name__}, no {cls.__name__}")
        module.load_state_dict(content["state_dict"], strict=strict is not False)
        if content.get("average") is not None:
            AveragedWeights(0.0).fill(module.net, content["average"])
        return module

    @abstractmethod
    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return figures of one batch, scalars []: "loss" is minimised, the others are only logged."""

    def compile_losses(self, *, graphs: bool = False) -> None:
        """Compile networks and losses as one graph; seeding and logging stay outside.

        Where that fails there is one warning, and training goes on in eager mode with the same random draws.

        Args:
            graphs: Replay the kernels of each call as a CUDA graph; only with one optimizer in one process
                that runs backward before the next forward.
        """
        self.losses = Compiled(self.losses, self.net, graphs=graphs)  # type: ignore[assignment]

    def configure_optimizers(self) -> list[OptimizerLRSchedulerConfig]:
        """Return the optimizer of the trainable parameters with its schedule, as Lightning takes them."""
        trained = [param for param in self.net.parameters() if param.requires_grad]
        optimizer = self.optim_config.build(trained)
        factor = partial(self.optim_config.factor, max_steps=self.length_of_training())
        self.schedule = StepSchedule(optimizer, factor)
        return [{"optimizer": optimizer, "lr_scheduler": {"scheduler": self.schedule, "interval": "step"}}]

    def length_of_training(self) -> int:
        """Return the steps of the training: the Trainer's where it has an end, else `max_steps`."""
        trainer = self._trainer
        if trainer is None:
            return self.max_steps
        steps = trainer.estimated_stepping_batches
        if not self.automatic_optimization and steps != trainer.max_steps:  # it has counted parts
            steps = math.ceil(steps / self.accumulate) if math.isfinite(steps) else steps
        if not 0 < steps < math.inf or steps == self.max_steps:
            return self.max_steps
        warnings.warn(
            f"this Trainer takes {steps:,} steps and the module was made for {self.max_steps:,}: the "
            f"learning-rate schedule goes by the Trainer's",
            stacklevel=2,
        )
        return int(steps)

    def lr_scheduler_step(self, scheduler: Any, metric: Any) -> None:
        """Set the rate of the next step, which depends on its number alone."""
        if isinstance(scheduler, StepSchedule):
            scheduler.set_step(self.step)
        else:
            super().lr_scheduler_step(scheduler, metric)

    def optimizer_step(
        self, epoch: int, batch_idx: int, optimizer: Any, optimizer_closure: Callable[[], Any] | None = None
    ) -> None:
        """Step; where a CUDA graph fails the gradients are computed again without graphs."""
        assert optimizer_closure is not None
        gradients = partial(self.without_failed_graph, optimizer_closure)
        super().optimizer_step(epoch, batch_idx, optimizer, gradients)

    def without_failed_graph(self, gradients: Callable[[], Any]) -> Any:
        """Return what `gradients` returns; once a CUDA graph has failed in it, it is called again without."""
        losses = self.losses
        if not (isinstance(losses, Compiled) and losses.graphs):
            return gradients()
        restore = self.saved_state()
        try:
            return gradients()
        except RuntimeError as error:
            losses.leave(error)
            restore()
            return gradients()

    def configure_gradient_clipping(
        self,
        optimizer: Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clip as `optim.grad_clip` says, unless the Trainer has a value of its own."""
        if gradient_clip_val is not None:
            super().configure_gradient_clipping(optimizer, gradient_clip_val, gradient_clip_algorithm)
            return
        norm = self.clip(list(self.net.parameters()), self.optim_config.grad_clip)
        self.gauges = {} if norm is None else {"lr": optimizer.param_groups[0]["lr"], "grad_norm": norm}

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor | None:
        """Loss of one part of a step; seeds torch from (seed, step, part, rank) first.

        `batch_idx` counts the parts of all steps. A module of one optimizer returns the loss, whose gradient
        the loop takes; `AlternatingModule` takes its whole step itself.
        """
        self.seed_draws(batch_idx % self.accumulate)
        with self.reading(batch):
            values = self.losses(batch)
        self.record(values, batch)
        return values["loss"]

    def on_before_batch_transfer(self, batch: Batch, dataloader_idx: int) -> Batch:
        """Return the batch; `UserError` where the first of a training or validation is wrong.

        It is looked at before it lies on a GPU, which would be waited for.
        """
        if self.training not in self._seen:
            self._seen.add(self.training)
            require_batch(batch, self.net)
        return batch

    @contextmanager
    def reading(self, batch: Batch) -> Iterator[None]:
        """Context in which losses read a batch: `UserError` where it lacks a key."""
        try:
            yield
        except KeyError as error:
            key = error.args[0] if error.args else None
            if not isinstance(key, str) or key in batch:
                raise
            raise UserError(
                f"batch: {type(self).__name__} reads '{key}', which is not there; it has {', '.join(batch)}"
            ) from error

    def seed_draws(self, part: int, turn: int = 0) -> None:
        """Seed torch for one part of a step, and one of several losses that are computed on it in turn."""
        key = (self.seed * 1_000_003 + self.step) * 4099 + rank()
        torch.manual_seed((key + (part << 48) + (turn << 56)) % 2**63)

    @property
    def ends_row(self) -> bool:
        """Whether the current step is the last one of a row of the log."""
        return (self.step + 1) % LOG_EVERY == 0

    def record(self, values: dict[str, Tensor], batch: Batch) -> None:
        """Add figures of a part of a step to the means of the next row, and log them to a Trainer."""
        self.average(values)
        if self._trainer is not None and not self.logs_rows:
            self.log_dict({f"train/{k}": v for k, v in values.items()}, batch_size=_rows(batch))

    def average(self, values: dict[str, Tensor]) -> None:
        """Add figures of a step, or of a part of one, to the means of the next row."""
        names = tuple(values)
        figures = torch.stack([v.detach().float() for v in values.values()])
        self.figures.append(StepFigures(self.step + 1, names, figures))
        sums, count = self._sums.get(names, (None, 0))
        self._sums[names] = (figures if sums is None else sums + figures, count + 1)

    def saved_state(self) -> Callable[[], None]:
        """Return a function that restores buffers (codebooks) and figures, to repeat a part of a step."""
        buffers = {name: buffer.clone() for name, buffer in self.named_buffers()}
        figures = list(self.figures)
        sums = dict(self._sums)

        def restore() -> None:
            for name, buffer in self.named_buffers():
                buffer.copy_(buffers[name])
            self.load_state_dict(buffers, strict=False)  # codebooks read from theirs whether they have begun
            self.figures = figures
            self._sums = sums

        return restore

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
        with alone(), self.reading(batch):
            values = self.losses(batch)
        if self._trainer is not None and not self.logs_rows:
            figures = {f"val/{k}": v for k, v in values.items()}
            self.log_dict(figures, batch_size=_rows(batch), sync_dist=True)
        return values

    def test_step(self, *_: object) -> None:
        """Not reached: `setup` refuses `trainer.test`."""

    def predict_step(self, *_: object) -> None:
        """Not reached: `setup` refuses `trainer.predict`."""

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


def _rows(batch: Batch) -> int:
    return next(len(value) for value in batch.values() if isinstance(value, Tensor))
