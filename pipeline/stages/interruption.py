"""Stopping at a signal without giving up a step: the training saves at the next border of a step and ends.

- The handler notes the signal and nothing else. Saving inside a handler would see a step half taken, and a
  collective there would wait for ranks that are elsewhere.
- All ranks agree on the step, by one all-reduce of a number about twice a second.
- A validation that a signal comes into ends behind its current batch. What it has seen is dropped and the
  checkpoint says so: the training that goes on begins with that validation.

SIGTERM is what schedulers, Kubernetes and torchrun send first; SIGUSR1 and SIGUSR2 are the warnings that
SLURM and submitit are asked to send before a time limit or a preemption. Ctrl-C ends a run at once, and it
goes on from its newest checkpoint.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from types import FrameType
from typing import Any

import lightning as L
import torch
import torch.distributed as dist
from lightning.pytorch.callbacks import Callback

from motionloom.pipeline.launch.process import Interrupted
from motionloom.pipeline.stages.progress import MetricLog
from motionloom.pipeline.stages.saving import Checkpoints

SIGNALS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGUSR1", "SIGUSR2") if hasattr(signal, name))
"""What a training answers by saving."""

VALIDATE = "validate"
"""Key of a checkpoint whose step is still to be validated; absent from all others."""

_BETWEEN = 0.5
"""Seconds from one agreement of the ranks to the next."""
_GROWTH = 4
"""An interval in borders grows by no more than this at once: the first steps are slow."""
_PATIENCE = timedelta(minutes=30)


class Signals:
    """Notes the first signal instead of letting it end the process; a context manager.

    Further ones change nothing: launchers repeat what the whole process group has got already. Only the main
    thread can be asked to note signals; in another one this does nothing.
    """

    def __init__(self) -> None:
        self.number = 0
        """The first signal that has come; 0 for none."""
        self.answered = False
        """Whether the training ends because of it."""
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Signals:
        """Note from here on."""
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._note) for number in SIGNALS}
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """As it was before; a signal that came too late for the training is passed on."""
        for number, handler in self._before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        self._before = {}
        if kind is None and self.number and not self.answered:
            signal.raise_signal(self.number)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.number = self.number or number


@contextmanager
def unsignalled() -> Iterator[None]:
    """Processes started inside never get those signals: a group that is signalled keeps its loader workers.

    They end with their parent, or when it asks them to.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)  # what came meanwhile is delivered now


class Agreement:
    """Which signal any rank has got, asked of all ranks at the same steps; one process asks itself."""

    def __init__(self, signals: Signals, world: int) -> None:
        self.signals = signals
        self.group = dist.new_group(backend="gloo", timeout=_PATIENCE) if world > 1 else None
        self._count = self._next = self._last = 0
        self._every = 1
        self._time = time.monotonic()

    def at_border(self) -> int:
        """The signal, or 0; every rank calls this at every border of steps or of validation batches."""
        if self.group is None:
            return self.signals.number
        self._count += 1
        return self.now() if self._count >= self._next else 0

    def now(self) -> int:
        """Ask in any case."""
        if self.group is None:
            return self.signals.number
        seconds = time.monotonic() - self._time
        asked = torch.tensor([float(self.signals.number), seconds], dtype=torch.float64)
        dist.all_reduce(asked, dist.ReduceOp.MAX, self.group)
        taken, seconds = self._count - self._last, float(asked[1])
        if taken > 0:  # the slowest rank's clock decides for all
            fitting = int(taken * _BETWEEN / max(seconds, 1e-6))
            self._every = max(1, min(fitting, _GROWTH * self._every))
        self._last, self._next, self._time = self._count, self._count + self._every, time.monotonic()
        return int(asked[0])

    def anew(self) -> None:
        """From here on borders come at another pace."""
        self._every, self._last, self._time = 1, self._count, time.monotonic()
        self._next = self._count + 1

    def meet(self) -> None:
        """Wait for all ranks."""
        if self.group is not None:
            dist.barrier(self.group)


class Interruption(Callback):
    """Ends a training with `Interrupted` once a signal has come and the step is saved.

    The last of the callbacks: what the others do at the end of a step is in the checkpoint.
    """

    def __init__(
        self,
        name: str,
        steps: int,
        chunk: int,
        batches: int,
        signals: Signals,
        checkpoints: Checkpoints,
        metrics: MetricLog,
    ) -> None:
        self.name, self.steps, self.chunk, self.batches = name, steps, chunk, batches
        self.signals, self.checkpoints, self.metrics = signals, checkpoints, metrics
        self._agreement: Agreement | None = None
        self._cut = False
        """Whether the validation of the latest step was cut short."""

    def cuts_validation(self, done: int, count: int) -> bool:
        """Whether a validation ends behind its batch `done` of `count`; every rank asks behind every one."""
        if self._agreement is None or done >= count:
            return False
        self._cut = self._cut or self._agreement.at_border() > 0
        self.metrics.validates = not self._cut
        return self._cut

    def on_save_checkpoint(
        self, trainer: L.Trainer, pl_module: L.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Note what is to be made up for."""
        if self._cut:
            checkpoint[VALIDATE] = True

    def on_load_checkpoint(
        self, trainer: L.Trainer, pl_module: L.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """A training is not over while its last validation is to be made up for."""
        self._cut = bool(checkpoint.get(VALIDATE))
        if self._cut:
            trainer.fit_loop.epoch_loop.max_steps = self.steps + 1

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """All ranks are here; a validation that was cut short comes first."""
        self._agreement = Agreement(self.signals, trainer.world_size)
        trainer.fit_loop.epoch_loop.max_steps = self.steps
        if not self._cut:
            return
        self._cut = False
        _validate(trainer)
        if not self._cut:
            self.checkpoints.save(trainer, again=True)
        self._stop(trainer, self._agreement.now())

    def on_validation_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Its batches take another time than steps."""
        if self._agreement is not None:
            self._agreement.anew()

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """So do steps."""
        self.on_validation_start(trainer, pl_module)

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Where a step ends in the middle of a chunk."""
        step = trainer.global_step
        if (batch_idx + 1) % self.batches or step % self.chunk == 0 or step >= self.steps:
            return
        assert self._agreement is not None
        self._stop(trainer, self._agreement.at_border())

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Where a chunk ends, validated and saved."""
        assert self._agreement is not None
        self._stop(trainer, self._agreement.now())

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Where the training ends, its last checkpoint on disk."""
        assert self._agreement is not None
        self._stop(trainer, self._agreement.now())

    def _stop(self, trainer: L.Trainer, number: int) -> None:
        if not number:
            return
        assert self._agreement is not None
        self.signals.answered = True
        self.checkpoints.save(trainer)
        self.checkpoints.finish()
        self._agreement.meet()  # nobody leaves before the file is whole
        raise Interrupted(self.name, trainer.global_step, self.steps, signal.Signals(number).name)


def _validate(trainer: L.Trainer) -> None:
    """Validate before the first step, as Lightning does behind one."""
    loop, connector = trainer.fit_loop.epoch_loop.val_loop, trainer._logger_connector
    loop.restarting, first = False, connector._first_loop_iter
    trainer.validating = True
    loop.run()
    trainer.training = True
    connector._first_loop_iter = first


def leave_signals_alone(trainer: L.Trainer) -> None:
    """Keep Lightning's own answers to signals out of a training.

    Its handler of SIGTERM waits for the other ranks inside the handler, and each batch begins with a
    broadcast that a GPU must be waited for. There is no setting for either.
    """
    connector, loop = trainer._signal_connector, trainer.fit_loop.epoch_loop
    connector.register_signal_handlers = lambda: None  # type: ignore[method-assign]
    loop._broadcast_sigterm_tensor = lambda: None  # type: ignore[method-assign]
