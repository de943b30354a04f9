"""What a `lightning.Trainer` may be for a stage's module: all that would train it wrongly is refused."""

from __future__ import annotations

from collections.abc import Mapping

import lightning as L
import torch
from lightning.pytorch.callbacks import GradientAccumulationScheduler, WeightAveraging
from lightning.pytorch.strategies import DDPStrategy, ModelParallelStrategy, SingleDeviceStrategy
from lightning.pytorch.trainer.states import TrainerFn
from torch import Tensor, nn

from motionloom.datasets.base.errors import UserError

PRECISIONS = ("32-true", "bf16-mixed", "64-true")
"""Others round the weights themselves, or need losses scaled that several terms share."""

REFUSED: dict[type[L.Callback], str] = {
    GradientAccumulationScheduler: "steps are cut into equally many parts; take accumulate_grad_batches",
    WeightAveraging: "it averages codebooks and tables as well; take motionloom.models.AveragedWeights",
}
"""Callbacks, with their subclasses, that train a stage's module wrongly."""


class OtherNetworkError(UserError):
    """A checkpoint is of another network."""


def require_trainer(module: L.LightningModule, trainer: L.Trainer, stage: str, *, shardable: bool) -> None:
    """Raise `UserError` where a Trainer would train, validate or test `module` wrongly or not at all."""
    if stage in ("test", "predict"):
        raise UserError(
            f"trainer.{TrainerFn(stage).value}: a stage's module is trained and validated; take "
            f"trainer.validate, and MotionModel for motions"
        )
    if module._compiler_ctx is not None:
        raise UserError("torch.compile(module): call module.compile_losses() and give the module itself")
    if trainer.precision not in PRECISIONS:
        raise UserError(f"precision {trainer.precision}: take one of {', '.join(PRECISIONS)}")
    strategy = trainer.strategy
    if not isinstance(strategy, SingleDeviceStrategy | DDPStrategy | ModelParallelStrategy):
        raise UserError(f"strategy {type(strategy).__name__}: take ddp, which keeps codebooks whole")
    if isinstance(strategy, ModelParallelStrategy) and not shardable:
        raise UserError(f"strategy ModelParallelStrategy: {type(module).__name__} must be whole; take ddp")
    for callback in trainer.callbacks:  # type: ignore[attr-defined]
        for kind, why in REFUSED.items():
            if isinstance(callback, kind):
                raise UserError(f"callback {type(callback).__name__}: {why}")


def require_batch(batch: Mapping[str, object], net: nn.Module) -> None:
    """Raise `UserError` where a batch's numbers or lengths cannot be meant for `net`."""
    own = next((param.dtype for param in net.parameters()), torch.float32)
    for name, value in batch.items():
        if isinstance(value, Tensor) and value.dtype == torch.float64 != own:
            raise UserError(f"batch: '{name}' is float64 and the network {own}; give {name}.float()")
    length = batch.get("length")
    motion = batch.get("motion")
    if not isinstance(length, Tensor):
        return
    most = motion.shape[1] if isinstance(motion, Tensor) and motion.dim() == 3 else None
    if not length.numel() or float(length.min()) < 0 or float(length.max()) < 1:
        raise UserError("batch: 'length' must be numbers of frames from 0 on, and one of them above 0")
    if most is not None and int(length.max()) > most:
        raise UserError(f"batch: 'length' says {int(length.max())} frames and 'motion' has {most}")


def require_weights(there: Mapping[str, Tensor], here: Mapping[str, Tensor]) -> None:
    """Raise `OtherNetworkError` where the weights of a checkpoint are not of the network that is here."""
    for name in dict.fromkeys([*here, *there]):
        sizes = [tuple(side[name].shape) if name in side else "nothing" for side in (there, here)]
        if sizes[0] != sizes[1]:
            raise OtherNetworkError(
                f"the checkpoint does not fit: {name} is {sizes[0]} there and {sizes[1]} here"
            )
