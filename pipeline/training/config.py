"""Training configuration: length, precision, checkpoints, and where batches come from.

It is apart from `trainer.py` because a recipe is read and planned without Lightning.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sized
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol, Self

from pydantic import BaseModel, Field, field_validator, model_validator

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError, nearest
from motionloom.datasets.base.register import Table, discover
from motionloom.datasets.loading.plan import Share
from motionloom.datasets.loading.steps import Numbered
from motionloom.models.training.optim import OptimConfig
from motionloom.pipeline.contract.fingerprint import RUNTIME
from motionloom.pipeline.contract.stage import StageConfig, StageContext
from motionloom.pipeline.launch.hardware import Hardware, require_loggers

if TYPE_CHECKING:
    import lightning as L

BatchSource = Callable[[int, Share], Numbered[Any]]
"""(items of a step on all processes, share of this one) -> batches; item n is its rows of part `n % parts` of
step `n // parts`."""


class SizedBatches(Numbered[Any], Sized, Protocol):
    """Batches by number, and how many there are."""


EvalSource = Callable[[], SizedBatches]
"""All validation batches: every process reads the same, so the figures depend on no rank."""


@dataclass(frozen=True)
class Batches:
    """Sources of a training's batches."""

    train: BatchSource
    validation: EvalSource | None


@dataclass(frozen=True)
class TrainingCallback:
    """A callback of Lightning's by its name in recipes; `make` is called when the training of a stage begins.

    `train/...` and `val/...` are in `trainer.callback_metrics` after each row of the log, and
    `on_validation_end` is called after each validation. Its `state_dict` is in the checkpoints.
    """

    name: str
    make: Callable[[StageContext], L.Callback]


CALLBACKS: Table[TrainingCallback] = Table(TrainingCallback, "callback of trainings")


class TrainConfig(Config):
    """Length and arithmetic of one training run."""

    steps: int = Field(1000, ge=1)
    """Number of optimizer steps."""
    seed: int | None = Field(None, ge=0)
    """Seed of the first weights, batches and draws; null = the recipe's. Trainings that differ in it alone
    show how far a result is chance."""
    batch_size: int = Field(256, ge=1)
    """Global batch, over all processes and accumulated parts."""
    accumulate: int = Field(1, ge=1)
    """Parts the batch of a step is cut into, to need less memory; the gradient is the mean of theirs.

    Equal to the whole batch where a loss is a mean over samples and the parts hold equally many real frames
    or tokens. Three things cannot be: a contrastive loss sees the negatives of its own part only, a learnt
    codebook is updated with every part (an average and resets over smaller batches), and so is the batch
    normalisation of `tm2t`'s critic. More processes instead of more parts change none.
    """
    precision: Literal["32-true", "bf16-mixed"] = "32-true"
    residual: Literal["fp32", "bf16"] = "fp32"
    """Type of the sums along pre-norm transformer blocks with `precision: bf16-mixed`: bf16 moves fewer bytes
    and rounds each sum. Generation takes fp32."""
    strategy: Literal["ddp", "fsdp"] = Field("ddp", json_schema_extra=RUNTIME)
    """Distribution over processes: each holds the whole network (`ddp`), or a part of the weights, gradients
    and optimizer state (`fsdp`: gpt stages, for networks that do not fit; not with compile).
    One process holds all; the results are the same."""
    compile: bool | None = None
    """Compile networks and losses with torch.compile, as one graph; null = on a GPU, where the network is
    known to allow it. Where it fails a warning says so, and the training goes on without."""
    ema: float | None = Field(None, ge=0, lt=1)
    """Decay a step of an average of the weights, such as 0.999, less at first; validation and the saved model
    take the average. null or 0 turns it off."""
    checkpoint_activations: bool = Field(False, json_schema_extra=RUNTIME)
    """Keep only the borders of transformer blocks for the backward pass and compute the rest again there:
    less memory, about a third more time, the same figures."""
    checkpoint_every: int = Field(100, ge=1, json_schema_extra=RUNTIME)
    """Steps between checkpoints: the most that a kill can cost."""
    keep_checkpoints: int = Field(2, ge=2, json_schema_extra=RUNTIME)
    """Number of newest checkpoints to keep; at least two, in case the newest is damaged."""
    keep_every: int = Field(0, ge=0, json_schema_extra=RUNTIME)
    """Also keep, for ever, each checkpoint whose step is a multiple of this; 0 keeps none of them."""
    sample_every: int = Field(0, ge=0, json_schema_extra=RUNTIME)
    """Steps between samples, rounded up to checkpoints: a generator's motions for a few validation clips, and
    figures of them, drawn on the CPU by a process beside the training; 0 turns them off."""
    validate_every: int = Field(200, ge=0, json_schema_extra=RUNTIME)
    """Steps between validations, rounded up to checkpoints; 0 turns them off."""
    callbacks: tuple[str, ...] = Field((), json_schema_extra=RUNTIME)
    """Registered callbacks that the Trainer calls as well, by name. One from another package counts by its
    code, so a change of it trains again."""
    profiler: Literal["simple", "advanced", "pytorch"] | None = Field(None, json_schema_extra=RUNTIME)
    """Lightning's profiler, whose report lies in the stage's `logs/`."""

    @field_validator("ema")
    @classmethod
    def _off(cls, value: float | None) -> float | None:
        return value or None  # one way to say it, so that the other is no change

    @model_validator(mode="after")
    def _rounded(self) -> Self:
        if self.residual == "bf16" and self.precision != "bf16-mixed":
            raise ValueError("residual: bf16 is for precision: bf16-mixed; set that too or leave it out")
        return self

    @field_validator("callbacks")
    @classmethod
    def _known(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if names:
            discover()
        for name in names:
            if name not in CALLBACKS:
                hint = nearest(name, [*CALLBACKS], what="callbacks")
                raise ValueError(f"no callback '{name}' is registered{hint}")
        return names

    def seed_of(self, recipe: int) -> int:
        """Return the seed of the training in a recipe of seed `recipe`."""
        return recipe if self.seed is None else self.seed

    def local_batch(self, world: int) -> int:
        """Items a process reads at once; the global batch must divide evenly."""
        parts = world * self.accumulate
        if self.batch_size % parts:
            raise UserError(
                f"train.batch_size {self.batch_size} does not divide by {world} processes x accumulate "
                f"{self.accumulate}; make it a multiple of {parts}"
            )
        return self.batch_size // parts


class TrainedStageConfig(StageConfig):
    """Base of the configs of stages that train."""

    shardable: ClassVar[bool] = False
    """Whether `train.strategy: fsdp` can cut the network: it must be used through `forward` alone."""

    optim: OptimConfig = OptimConfig()
    train: TrainConfig = TrainConfig()
    published: Path | None = Field(None, json_schema_extra=RUNTIME)
    """Safetensors of the release of a published model: they are loaded, and nothing is trained. Kinds that
    know the names of one: diffusion (MDM), motion_vae and latent_diffusion (MLD). The file's checksum counts,
    not its place."""

    def require_fit(self, hardware: Hardware) -> None:
        """The global batch must divide over the processes, and the arithmetic suit the device and FSDP."""
        self.train.local_batch(hardware.world())
        require_loggers(hardware.loggers)
        if self.train.strategy == "fsdp":
            self._require_shardable()

    def schedule_of_length(self) -> str | None:
        """Describe the learning-rate schedule that depends on `train.steps`; None if none does."""
        schedules = (f"{key}.schedule {optim.schedule}" for key, optim in optimizers_of(self))
        return next((one for one in schedules if not one.endswith(" constant")), None)

    def doubts(self) -> list[str]:
        """Return a warning for each setting that probably does not do what is meant."""
        found = optimizers_of(self)
        steps = self.train.steps
        loss = getattr(self, "loss", None)
        begins = {key: getattr(loss, key, 0) for key in ("align_from", "adversarial_start")}
        return [
            *(f"{key}.{doubt}" for key, optim in found for doubt in optim.doubts(steps)),
            *(
                f"loss.{key} {step:,} is no step of this training, which has {steps:,}: it never begins"
                for key, step in begins.items()
                if step >= steps
            ),
        ]

    def _require_shardable(self) -> None:
        if not self.shardable:
            raise UserError(
                "train.strategy fsdp is for gpt stages: the other networks fit on every GPU, and learnt "
                "codebooks must be whole on every process; set train.strategy: ddp"
            )
        if self.train.compile:
            raise UserError(
                "train.compile makes one graph and train.strategy fsdp gathers weights between the blocks; "
                "set one of them back"
            )
        if self.train.ema:
            raise UserError(
                "train.ema averages whole weights and train.strategy fsdp keeps each in several processes; "
                "set train.ema: null or strategy: ddp"
            )


def optimizers_of(config: BaseModel, prefix: str = "") -> Iterator[tuple[str, OptimConfig]]:
    """The optimizers in a config by their dotted keys."""
    for name in type(config).model_fields:
        value = getattr(config, name)
        if isinstance(value, OptimConfig):
            yield f"{prefix}{name}", value
        elif isinstance(value, BaseModel):
            yield from optimizers_of(value, f"{prefix}{name}.")
