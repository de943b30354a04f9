"""Crash bundles: `crash/step_XXXXXXXX/` of a stage, with all that repeating the failed step needs.

`crash.json` says what happened, `batch.safetensors` holds the batch of the step, and `checkpoint.ckpt` is a
link to the last checkpoint before it (a copy where there are no links), which no clean-up of checkpoints
takes away. Nothing in it is pickled but the checkpoint, which is only read as weights are.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import torch
from pydantic import Field
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from motionloom.datasets.base.files import write_bytes
from motionloom.datasets.schema import Config, UserError
from motionloom.pipeline.store.files import link_or_copy, write_json

FOLDER = "crash"
"""Of a stage's folder."""
RECORD, BATCH, CHECKPOINT = "crash.json", "batch.safetensors", "checkpoint.ckpt"


class SampleRecord(Config):
    """A sample of a batch: which clip, and which of its frames (of its token groups, for a GPT)."""

    clip: str
    first: int
    length: int


class StepRecord(Config):
    """One of the last steps: what it read, and the figures it gave, a number for each part of its batch."""

    step: int
    batches: list[int]
    samples: list[SampleRecord] = Field(default_factory=list)
    figures: dict[str, list[float]] = Field(default_factory=dict)


class CheckpointRecord(Config):
    """The last good checkpoint before the failure."""

    step: int
    path: str
    """Where it lay, for people; the bundle has its own name for it."""


class CrashRecord(Config):
    """`crash.json`."""

    stage: str
    recipe: str
    kind: Literal["not_finite", "exception"]
    step: int = Field(ge=1)
    """The step that failed, counted as the log does."""
    rank: int = Field(ge=0)
    world: int = Field(ge=1)
    said: str
    """One sentence."""
    error: str = ""
    """Type and words of an exception."""
    traceback: str = ""
    terms: dict[str, float] = Field(default_factory=dict)
    """Figures that were not finite."""
    groups: list[str] = Field(default_factory=list)
    """Layer groups whose gradients were not."""
    seed: int
    """Of the training's draws and batches."""
    fingerprint: str | None
    """Of the stage, its settings and inputs; None for a training outside of a run."""
    hardware: dict[str, Any]
    versions: dict[str, str]
    checkpoint: CheckpointRecord | None
    """None: it failed before the first one, and the replay begins with the training."""
    steps: list[StepRecord]
    """The last steps, the failed one at the end."""
    batch_error: str = ""
    """Why the batch itself is not in the bundle, where it could not be read again."""
    replay: str
    """The command that repeats it."""


def bundle_folder(stage: Path, step: int, rank: int, world: int) -> Path:
    """Where the bundle of a step and a process goes."""
    return stage / FOLDER / (f"step_{step:08d}" + (f"_rank_{rank}" if world > 1 else ""))


def write_bundle(
    folder: Path, record: CrashRecord, batch: Mapping[str, Tensor] | None, checkpoint: Path | None
) -> None:
    """Write a bundle; the record last, so that a folder with one is whole. One of the same step gives way."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    if checkpoint is not None:
        link_or_copy(checkpoint, folder / CHECKPOINT)
    if batch is not None:
        write_bytes(folder / BATCH, save(dict(batch)))
    write_json(folder / RECORD, record.dump())


def read_bundle(folder: Path) -> CrashRecord:
    """The record of a bundle; a `UserError` where the folder is none."""
    if not (folder / RECORD).is_file():
        raise UserError(
            f"{folder}: no crash bundle (no {RECORD}); name a folder like runs/NAME/stages/STAGE/crash/step_…"
        )
    return CrashRecord.load_json(folder / RECORD)


def read_batch(folder: Path) -> dict[str, Tensor] | None:
    """The batch of a bundle, flat; None where it has none."""
    path = folder / BATCH
    if not path.is_file():
        return None
    try:
        return dict(load_file(path))
    except (SafetensorError, OSError) as error:
        raise UserError(f"{path}: cannot be read ({error})") from None


def flat_batch(batch: Any, prefix: str = "") -> dict[str, Tensor]:
    """The tensors of a batch by their places in it; what is no tensor (captions) is left out."""
    return {name: tensor.detach().cpu().contiguous().clone() for name, tensor in _leaves(batch, prefix)}


def _leaves(value: Any, prefix: str) -> Iterator[tuple[str, Tensor]]:
    if isinstance(value, Tensor):
        yield prefix or "batch", value
    elif isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _leaves(inner, f"{prefix}.{key}" if prefix else str(key))
    elif isinstance(value, tuple) and hasattr(value, "_fields"):
        for key in value._fields:
            yield from _leaves(getattr(value, key), f"{prefix}.{key}" if prefix else key)
    elif isinstance(value, list | tuple):
        for place, inner in enumerate(value):
            yield from _leaves(inner, f"{prefix}.{place}" if prefix else str(place))


def same_batch(one: Mapping[str, Tensor], other: Mapping[str, Tensor]) -> bool:
    """Whether two flat batches are equal bit for bit, what is not a number included."""
    return one.keys() == other.keys() and all(_same(one[name], other[name]) for name in one)


def _same(one: Tensor, other: Tensor) -> bool:
    if one.shape != other.shape or one.dtype != other.dtype:
        return False
    return torch.equal(one.reshape(-1).view(torch.uint8), other.reshape(-1).view(torch.uint8))
