"""Trainings that go wrong: a loss or gradient that is not finite, an error in a step, a process that hangs.

`crash/step_XXXXXXXX/` of the stage's folder then holds the batch of that step and the traceback; resuming
from the checkpoint before it repeats the step bit for bit. A process that makes no progress for
`hardware.stall_seconds` writes the tracebacks of all its threads and ends; the others end with it, by
torchrun or the time-out of their process group.
"""

from __future__ import annotations

import faulthandler
import math
import time
import traceback
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import torch
import torch.distributed as dist
from rich.console import Console
from rich.markup import escape
from safetensors.torch import save
from torch import Tensor

from motionloom.datasets.base.files import write_bytes, write_text
from motionloom.datasets.schema import UserError
from motionloom.datasets.shards.checksums import state_of
from motionloom.models.training.distributed import rank, world_size
from motionloom.models.training.stage_module import LOG_EVERY, StageModule
from motionloom.pipeline.contract.stage import CompletedStage
from motionloom.pipeline.launch.process import JointError, TeamError
from motionloom.pipeline.store.data import Data
from motionloom.pipeline.store.files import open_own
from motionloom.pipeline.store.training_log import CRASHES
from motionloom.pipeline.training.loaders import TrainingData
from motionloom.pipeline.training.telemetry import all_ranks


class NotFiniteError(UserError):
    """A loss or a gradient is not finite."""


@dataclass(frozen=True)
class Failure:
    """The first step whose loss or gradient was not finite."""

    step: int
    """Counted from 1, as in the log."""
    terms: dict[str, float] = field(default_factory=dict)
    """Figures that were not finite; empty if only the gradient was not."""

    @property
    def order(self) -> float:
        """Earliest first; of one step, a process whose own loss failed before one that got its gradient."""
        return 2.0 * self.step + (not self.terms)

    def describe(self) -> str:
        if not self.terms:
            return f"in step {self.step} the gradient is not finite"
        terms = ", ".join(f"{name} = {value}" for name, value in self.terms.items())
        return f"in step {self.step} the loss is not finite ({terms})"


def first_failure(module: StageModule) -> Failure | None:
    """Read and clear what the module has noted of its latest steps."""
    figures, norms = module.figures[:], module.norms[:]
    module.figures.clear()
    module.norms.clear()
    failures: list[Failure] = []
    if figures:
        values = torch.cat([part.values for part in figures]).tolist()
        for part in figures:
            own, values = dict(zip(part.names, values, strict=False)), values[len(part.names) :]
            terms = {name: value for name, value in own.items() if not math.isfinite(value)}
            if any(_is_loss(name) for name in terms):
                failures.append(
                    Failure(part.step, dict(sorted(terms.items(), key=lambda item: _is_loss(item[0]))))
                )
    if norms:
        values = torch.stack([norm.float() for _, norm in norms]).tolist()
        failures += [
            Failure(step) for (step, _), value in zip(norms, values, strict=True) if not math.isfinite(value)
        ]
    return min(failures, key=lambda failure: failure.order, default=None)


def _is_loss(name: str) -> bool:
    """Whether a figure is minimised: a stage's own loss, or an optimizer group's."""
    return name == "loss" or name.endswith("_loss")


class FailureGuard:
    """Finds what is not finite, on all ranks at the same steps, and saves what a failed step has read."""

    def __init__(
        self, name: str, folder: Path, module: StageModule, data: TrainingData, console: Console
    ) -> None:
        self.name, self.folder, self.module, self.data = name, folder, module, data
        self.console = console

    def check(self) -> None:
        """All ranks call this at the same steps.

        Raises:
            NotFiniteError: In the lead, if any rank has failed.
            TeamError: In the other ranks.
        """
        # The rank that failed first is the cause: the others got its gradient.
        failure = first_failure(self.module)
        orders = all_ranks([math.inf if failure is None else failure.order], self.module.device)[
            :, 0
        ].tolist()
        if not math.isfinite(min(orders)):
            return
        first, text = orders.index(min(orders)), [""]
        if first == rank():
            assert failure is not None
            sentence = f"stage {self.name}: {failure.describe()}" + (f" (rank {first})" * (world_size() > 1))
            text = [f"{sentence}; {self._save(failure.step, sentence)}"]
        if world_size() > 1:
            dist.broadcast_object_list(text, src=first)
        if rank() == 0:
            raise NotFiniteError(text[0])
        raise TeamError(text[0])

    def due(self, step: int) -> bool:
        """Whether to check after a step: reading a figure waits for a GPU, and ranks for each other."""
        alone = world_size() == 1 and self.module.device.type == "cpu"
        return alone or step % LOG_EVERY == 0

    def save_error(self, error: Exception) -> None:
        """Save the step in which an unexpected error came. Mistakes of users and lost processes need none."""
        if isinstance(error, UserError | TeamError) or "by peer" in str(error):
            return
        trace = "".join(traceback.format_exception(error))
        where = self._save(self.module.step + 1, trace)
        self.console.print(f"[yellow]    {escape(f'stage {self.name}: {where}')}[/]", soft_wrap=True)

    def _save(self, step: int, text: str) -> str:
        """Write the batch of a step and `text`; where they are, in words."""
        ranks = f"_rank_{rank()}" if world_size() > 1 else ""
        folder = self.folder / CRASHES / f"step_{step:08d}{ranks}"
        try:
            write_text(folder / "error.txt", text + "\n")
            parts = self.module.accumulate
            for part in range(parts):
                batch = self.data.train[(step - 1) * parts + part]  # item k is a pure function of k
                write_bytes(
                    folder / f"batch{part if parts > 1 else ''}.safetensors", save(flat_tensors(batch))
                )
        except Exception as error:  # the failure itself says more than that its batch is missing
            return f"its batch could not be saved in {folder} ({type(error).__name__}: {error})"
        return f"its batch and the traceback are in {folder}"


def flat_tensors(value: object, name: str = "") -> dict[str, Tensor]:
    """The tensors of a batch by their paths in it; what is no tensor (captions) is left out."""
    if isinstance(value, Tensor):
        return {name or "batch": value.detach().cpu().contiguous().clone()}
    if hasattr(value, "_asdict"):
        value = value._asdict()
    elif isinstance(value, list | tuple):
        value = {str(place): inner for place, inner in enumerate(value)}
    out: dict[str, Tensor] = {}
    for key, inner in value.items() if isinstance(value, Mapping) else ():
        out |= flat_tensors(inner, f"{name}.{key}" if name else str(key))
    return out


class ShardWatch:
    """Notices shards that somebody writes while a training reads them; `stages` fed it."""

    def __init__(self, stages: Iterable[CompletedStage]) -> None:
        data = [stage for stage in stages if stage.gives("data") and not stage.exported]
        self._states = {
            shard.path: shard.state()[:2] for stage in data for shard in Data(stage.folder).local_shards()
        }
        """Size and time of the last write."""
        self._checks = 0

    def check(self, device: torch.device) -> None:
        """All ranks call this at the same steps, and look at a part of the shards each, in turns.

        Raises:
            JointError: In all ranks, if a shard has changed or is gone.
        """
        if not self._states:
            return
        self._checks += 1
        own = self._changed((rank() + self._checks) % world_size(), world_size())
        number = float(all_ranks([math.inf if own is None else own], device).min())
        if math.isfinite(number):
            raise JointError(self._say(int(number)))

    def explain(self, error: Exception) -> Exception:
        """The error, or where this process finds that a shard has changed the one that says so."""
        number = self._changed(0, 1)
        return error if number is None else UserError(self._say(number))

    def _changed(self, first: int, every: int) -> int | None:
        """The number of a shard that is not as it was, among every so many."""
        numbered = list(enumerate(self._states.items()))[first::every]
        return next((number for number, (path, state) in numbered if state_of(path)[:2] != state), None)

    def _say(self, number: int) -> str:
        return (
            f"{list(self._states)[number]}: the shard has changed, or is gone, since this training began to "
            f"read it; put it back, or run again from the stage that made it; its checkpoints are kept"
        )


class StallTimer:
    """Ends this process, with the tracebacks of all threads, if it makes no progress for some time."""

    def __init__(self, path: Path, seconds: float) -> None:
        self.path, self.seconds = path, seconds
        self._armed = -math.inf

    @contextmanager
    def running(self) -> Iterator[None]:
        if not self.seconds:
            yield
            return
        with open_own(self.path, "w") as self._file:
            try:
                self.progress()
                yield
            finally:
                faulthandler.cancel_dump_traceback_later()
        with suppress(OSError):
            self.path.unlink()
            self.path.parent.rmdir()  # fails, as it should, where it holds something else

    def progress(self) -> None:
        """A step, a validation batch or a checkpoint is done."""
        now = time.monotonic()
        if self.seconds and now - self._armed > min(1.0, self.seconds / 4):  # arming starts a thread
            self._armed = now
            faulthandler.dump_traceback_later(self.seconds, file=self._file, exit=True)
