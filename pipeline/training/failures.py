"""Trainings that go wrong: a loss or gradient that is not finite, an error in a step, a process that hangs.

A process that makes no progress for `hardware.stall_seconds` writes the tracebacks of all its threads and
ends; torchrun or the time-out of the process group ends the others.
"""

from __future__ import annotations

import faulthandler
import math
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO

import torch
import torch.distributed as dist
from rich.console import Console

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import state_of
from motionloom.datasets.base.os_errors import NO_MORE, full_place, lacks_memory
from motionloom.models.training.any_trainer import OtherNetworkError
from motionloom.models.training.distributed import rank, world_size
from motionloom.models.training.finite import first_failure
from motionloom.models.training.stage_module import StageModule
from motionloom.pipeline.contract.stage import CompletedStage
from motionloom.pipeline.launch.process import JointError, TeamError
from motionloom.pipeline.store.data import Data
from motionloom.pipeline.store.files import open_own
from motionloom.pipeline.store.training_log import optional
from motionloom.pipeline.training.telemetry import all_ranks


class NotFiniteError(JointError):
    """A loss or a gradient is not finite."""


class FailureGuard:
    """Finds what is not finite in the training of a stage, on all ranks at the same steps."""

    def __init__(self, name: str, module: StageModule) -> None:
        self.name = name
        self.module = module

    def check(self) -> None:
        """Collective: raise `NotFiniteError` if any rank has failed."""
        # The rank that failed first is the cause: the others got its gradient.
        failure = first_failure(self.module)
        orders = all_ranks([math.inf if failure is None else failure.order], self.module.device)[
            :, 0
        ].tolist()
        if not math.isfinite(min(orders)):
            return
        first = orders.index(min(orders))
        text = [""]
        if first == rank():
            assert failure is not None
            where = f" (rank {first})" * (world_size() > 1)
            text = [
                f"stage {self.name}: {failure.describe()}{where}; no checkpoint holds it: go on from the one "
                f"before with a lower learning rate or optim.grad_clip"
            ]
        if world_size() > 1:
            dist.broadcast_object_list(text, src=first)
        raise NotFiniteError(text[0])


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
        """Collective: look at some shards on each rank, in turns; `JointError` if one has changed."""
        if not self._states:
            return
        self._checks += 1
        own = self._changed((rank() + self._checks) % world_size(), world_size())
        number = float(all_ranks([math.inf if own is None else own], device).min())
        if math.isfinite(number):
            raise JointError(self._say(int(number)))

    def explain(self, error: Exception) -> Exception:
        """Return `error`, or the error of a changed shard where this process finds one that `error` may come
        from: a loss that is not finite, or what not all processes have found together.
        """
        joint = isinstance(error, (JointError, TeamError))
        number = None if joint and not isinstance(error, NotFiniteError) else self._changed(0, 1)
        return error if number is None else (JointError if joint else UserError)(self._say(number))

    def _changed(self, first: int, every: int) -> int | None:
        """Return the first changed shard among numbers `first`, `first + every`, ...; None if none is."""
        numbered = list(enumerate(self._states.items()))[first::every]
        return next((number for number, (path, state) in numbered if state_of(path)[:2] != state), None)

    def _say(self, number: int) -> str:
        return (
            f"{list(self._states)[number]}: the shard has changed, or is gone, since this training began to "
            f"read it; put it back, or run again from the stage that made it; its checkpoints are kept"
        )


def explained(error: Exception, name: str, logs: Path, resume: Path | None) -> Exception:
    """Return the error that says what happened to stage `name` in the user's words; or `error` itself.

    `logs` is the folder of stacks, `resume` the checkpoint that the training went on from.
    """
    text = str(error)
    if isinstance(error, OtherNetworkError):
        return UserError(
            f"{resume}: {text}, another network than {name} has now; give the settings that it began with, "
            f"or begin anew with --from {name}"
        )
    if lacks_memory(error):
        why = text.partition("\n")[0][:200]
        return UserError(
            f"stage {name}: rank {rank()} is out of memory ({why}); close other programs, or lower "
            f"train.batch_size or hardware.workers; the same command goes on from the last checkpoint"
        )
    if isinstance(error, OSError) and error.errno in NO_MORE and error.filename is None:
        error.filename = full_place(logs.parent)
    if not isinstance(error, RuntimeError):
        return error
    if isinstance(error, dist.DistBackendError) or "by peer" in text or "imed out" in text:
        return TeamError.lost(logs)
    if "killed by signal: Killed" in text:
        return UserError(
            f"stage {name}: a loader worker was killed, as systems do that are short of memory; "
            f"lower hardware.workers and run the same command, which goes on from the last checkpoint"
        )
    if "does not have a deterministic implementation" in text:
        what = text.partition(",")[0]
        return UserError(f"stage {name}: {what}; set hardware.deterministic: false")
    return error


class StallTimer:
    """Ends this process, with the tracebacks of all threads, if it makes no progress for some time."""

    def __init__(self, path: Path, seconds: float, console: Console) -> None:
        self.path = path
        self.seconds = seconds
        self.console = console
        self._armed = -math.inf
        self._file: IO[str] | int = 2  # standard error, where `path` cannot be written

    @contextmanager
    def running(self) -> Iterator[None]:
        if not self.seconds:
            yield
            return
        with ExitStack() as stack:
            with optional(str(self.path), self.console):
                self._file = stack.enter_context(open_own(self.path, "w"))
                stack.callback(self._remove)
            stack.callback(faulthandler.cancel_dump_traceback_later)
            self.progress()
            ended = threading.Event()
            stack.callback(ended.set)
            threading.Thread(target=self._tell, args=(ended,), daemon=True).start()
            yield

    def _tell(self, ended: threading.Event) -> None:
        """Say where the main thread hangs, a moment before this process ends: nothing may be said then."""
        while time.monotonic() - self._armed < self.seconds - 1:
            if ended.wait(0.5):
                return
        frame = sys._current_frames()[threading.main_thread().ident or 0]
        where = f"{frame.f_code.co_name} ({frame.f_code.co_filename}:{frame.f_lineno})"
        told = f"process {rank()}: no step for {self.seconds} s, it hangs in {where}; stacks: {self.path}"
        print(told, file=sys.stderr, flush=True)

    def _remove(self) -> None:
        with suppress(OSError):  # the folder may have become one that nobody writes to
            self.path.unlink(missing_ok=True)

    def progress(self) -> None:
        """A step, a validation batch or a checkpoint is done."""
        now = time.monotonic()
        if self.seconds and now - self._armed > min(1.0, self.seconds / 4):  # arming starts a thread
            self._armed = now
            faulthandler.dump_traceback_later(self.seconds, file=self._file, exit=True)
