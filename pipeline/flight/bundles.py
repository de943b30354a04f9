"""Crash bundles as a training leaves them: the failed step, its batch, the way back to it."""

from __future__ import annotations

import platform
import shlex
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import lightning as L
import torch.distributed as dist
from rich.markup import escape
from torch import Tensor
from torch.utils.data import Dataset

from motionloom.datasets.schema import UserError
from motionloom.models.training.stage_module import StageModule
from motionloom.pipeline.contract.stage import StageContext
from motionloom.pipeline.flight.watch import Failure, Watch
from motionloom.pipeline.launch.process import TeamError
from motionloom.pipeline.store.artifact import fingerprint_now
from motionloom.pipeline.store.checkpoints import readable
from motionloom.pipeline.store.crash import (
    CheckpointRecord,
    CrashRecord,
    SampleRecord,
    StepRecord,
    bundle_folder,
    flat_batch,
    write_bundle,
)

_VERSIONS = ("motionloom", "torch", "lightning", "numpy", "safetensors")


@dataclass
class Bundles:
    """Writes the bundles of one training, in its process."""

    context: StageContext
    train: Callable[[int, int, int], Dataset[Any]]
    """Where its batches come from, as `fit` has it."""
    batch_size: int
    accumulate: int
    steps: int
    """How many of the last steps a bundle lists."""
    settle: Callable[[], None]
    """Returns when the checkpoint that is being written is on disk."""
    watch: Watch | None = None

    def wait(self, world: int) -> None:
        """Let what is being written end, of the process that writes; all processes call it."""
        with suppress(UserError, OSError):
            self.settle()
        if world > 1:
            dist.barrier()

    def of_failure(
        self, trainer: L.Trainer, module: StageModule, failure: Failure, said: str
    ) -> tuple[Path, str]:
        """The bundle of what was not finite, and why there is none."""
        facts = {"kind": "not_finite", "terms": failure.terms, "groups": list(failure.groups)}
        return self._write(trainer, module, failure.step, said, facts)

    def of_exception(self, trainer: L.Trainer, module: StageModule, error: BaseException) -> None:
        """A bundle of an error in a step, and a line that says where it lies.

        A mistake that the user can fix, an interruption, a process that has gone and an error outside of the
        steps need none: repeating a step shows nothing about them.
        """
        other = not isinstance(error, Exception) or isinstance(error, UserError | TeamError)
        if other or self.watch is None or trainer.validating or "by peer" in str(error):
            return
        try:
            self.watch.read()
        except Exception:  # a device that is lost cannot be read any more
            self.watch.recent.clear()
        step = trainer.global_step + 1
        words = f"{type(error).__name__}: {error}"
        said = f"stage {self.context.name}: step {step} on rank {trainer.global_rank} ended with {words}"
        trace = "".join(traceback.format_exception(error))
        facts = {"kind": "exception", "error": words, "traceback": trace}
        folder, problem = self._write(trainer, module, step, said, facts)
        more = f"no crash bundle could be written ({problem})"
        line = more if problem else f"repeat that step with: {self.command(folder)}"
        self.context.console.print(f"[yellow]    {escape(f'{said}; {line}')}[/]", soft_wrap=True)

    @staticmethod
    def command(folder: Path) -> str:
        """What repeats the step of a bundle."""
        return f"motionloom replay {shlex.quote(str(folder))}"

    def _write(
        self, trainer: L.Trainer, module: StageModule, step: int, said: str, facts: dict[str, Any]
    ) -> tuple[Path, str]:
        rank, world = trainer.global_rank, trainer.world_size
        folder = bundle_folder(self.context.folder, step, rank, world)
        try:
            found = self._checkpoint(step)
            data, trouble = self._dataset(rank, world)
            batch: dict[str, Tensor] | None = None
            if data is not None:
                batch, trouble = self._batch(data, step)
            record = CrashRecord(
                stage=self.context.name,
                recipe=self.context.recipe,
                step=step,
                rank=rank,
                world=world,
                said=said,
                seed=module.seed,
                fingerprint=fingerprint_now(self.context.folder),
                hardware=self.context.hardware.dump(),
                versions={name: metadata.version(name) for name in _VERSIONS}
                | {"python": platform.python_version()},
                checkpoint=None if found is None else CheckpointRecord(step=found[1], path=str(found[0])),
                steps=self._steps(data, step),
                batch_error=trouble,
                replay=self.command(folder),
                **facts,
            )
            write_bundle(folder, record, batch, None if found is None else found[0])
        except Exception as error:  # the failure itself says more than that its bundle is missing
            return folder, f"{type(error).__name__}: {error}"
        return folder, ""

    def _checkpoint(self, step: int) -> tuple[Path, int] | None:
        """The newest sound checkpoint before a step, and its own step."""
        folder = self.context.folder / "checkpoints"
        for path, content in readable(folder, lambda _: None):
            if content["global_step"] < step:
                return path, int(content["global_step"])
        return None

    def _dataset(self, rank: int, world: int) -> tuple[Dataset[Any] | None, str]:
        """The batches, opened anew; those of the loader may be what is broken."""
        try:
            return self.train(self.batch_size // self.accumulate, rank, world), ""
        except Exception as error:
            return None, f"{type(error).__name__}: {error}"

    def _numbers(self, step: int) -> range:
        """The batches of a step."""
        return range((step - 1) * self.accumulate, step * self.accumulate)

    def _batch(self, data: Dataset[Any], step: int) -> tuple[dict[str, Tensor] | None, str]:
        out: dict[str, Tensor] = {}
        try:
            for part, number in enumerate(self._numbers(step)):
                out |= flat_batch(data[number], f"part{part}" if self.accumulate > 1 else "")
        except Exception as error:
            return None, f"{type(error).__name__}: {error}"
        return out, ""

    def _steps(self, data: Dataset[Any] | None, step: int) -> list[StepRecord]:
        figures = {} if self.watch is None else dict(self.watch.recent)
        listed = range(max(1, step - self.steps + 1), step + 1)
        return [
            StepRecord(
                step=one,
                batches=list(self._numbers(one)),
                samples=[s for number in self._numbers(one) for s in samples_of(data, number)],
                figures=figures.get(one, {}),
            )
            for one in listed
        ]


def samples_of(data: Any, number: int) -> list[SampleRecord]:
    """Which clips batch `number` of a process is made of, where its data set says so (`samples`)."""
    say = getattr(data, "samples", None)
    if say is None:
        return []
    try:
        return [SampleRecord(clip=s.clip, first=s.first, length=s.length) for s in say(number)]
    except Exception:  # what cannot be read is in `batch_error`
        return []
