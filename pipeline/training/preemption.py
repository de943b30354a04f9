"""Stopping at a signal without losing a step: the training saves after the current step and ends.

- The handler notes the signal and nothing else. Saving inside a handler would see a step half taken, and a
  collective there would wait for ranks that are elsewhere.
- All ranks agree on the step, by one all-reduce of a number about twice a second.
- While torch compiles, which can take minutes, the process ends at once if no step would be lost.

SIGTERM is what schedulers, Kubernetes and torchrun send first; SIGUSR1 and SIGUSR2 are the warnings that
SLURM and submitit are asked to send before a time limit or a preemption. Ctrl-C ends a run at once, and it
goes on from its newest checkpoint.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from types import FrameType

import torch
import torch.distributed as dist
from torch._guards import CompileContext

SIGNALS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGUSR1", "SIGUSR2") if hasattr(signal, name))
"""Signals at which a training saves and ends."""

Handler = Callable[[int, FrameType | None], object] | int | None

_BETWEEN = 0.5
"""Seconds from one agreement of the ranks to the next: far below any grace time, far above an all-reduce."""
_GROWTH = 4
"""Largest factor between two intervals in steps: the first steps are slow."""
_PATIENCE = timedelta(minutes=30)
"""Longest wait for a rank; a validation batch or a checkpoint takes less."""


class Signals:
    """Context manager that notes the first signal instead of letting it end the process.

    Further ones change nothing: launchers repeat what the whole process group has got already. Only the main
    thread can be asked to note signals; in another one this does nothing.
    """

    def __init__(self) -> None:
        self.number = 0
        """The first signal that has come; 0 for none."""
        self.answered = False
        """Whether the training ends because of it."""
        self.ends_compiling: Callable[[int], BaseException | None] = lambda number: None
        """Return the error that a signal raises while torch compiles; None if something would be lost."""
        self._before: dict[signal.Signals, Handler] = {}

    def __enter__(self) -> Signals:
        if threading.current_thread() is threading.main_thread():
            # Lightning turns Ctrl-C off for good when it has come.
            self._before = {number: signal.getsignal(number) for number in (*SIGNALS, signal.SIGINT)}
            self.note()
        return self

    def note(self) -> None:
        """Note signals from here on, whoever else has taken them meanwhile, and let those that wait come."""
        if self._before:
            for number in SIGNALS:
                signal.signal(number, self._note)
            self._hold(signal.SIG_UNBLOCK)

    def hold(self) -> None:
        """Have signals wait for `note`: a Trainer puts handlers of its own, which talk to other ranks."""
        if self._before:
            self._hold(signal.SIG_BLOCK)

    def _hold(self, how: int) -> None:
        if hasattr(signal, "pthread_sigmask"):
            signal.pthread_sigmask(how, SIGNALS)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Restore the handlers; a signal that the training has not answered is raised again."""
        if self._before:
            self.note()
        for number, handler in self._before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        self._before = {}
        if kind is None and self.number and not self.answered:
            signal.raise_signal(self.number)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.number = self.number or number
        end = self.ends_compiling(number) if CompileContext.current_compile_id() is not None else None
        if end is not None:
            self.answered = True
            raise end


@contextmanager
def signals_blocked() -> Iterator[None]:
    """Context in which started processes (loader workers) ignore signals and end with their parent."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)  # what came meanwhile is delivered now


class Agreement:
    """Agreement of all ranks, at the same steps, on the signal that any of them has got."""

    def __init__(self, signals: Signals, world: int) -> None:
        self.signals = signals
        self.group = dist.new_group(backend="gloo", timeout=_PATIENCE) if world > 1 else None
        self._count = self._next = self._last = 0
        self._every = 1
        self._time = time.monotonic()

    def after_step(self) -> int:
        """Return the signal or 0; every rank calls this after every step and every validation batch."""
        if self.group is None:
            return self.signals.number
        self._count += 1
        return self.now() if self._count >= self._next else 0

    def now(self) -> int:
        """Return the signal or 0, always with a collective."""
        if self.group is None:
            return self.signals.number
        # One all-reduce carries both the signal and the pace; MAX lets any rank's signal win.
        seconds = time.monotonic() - self._time
        agreed = torch.tensor([float(self.signals.number), seconds], dtype=torch.float64)
        dist.all_reduce(agreed, dist.ReduceOp.MAX, self.group)
        steps = self._count - self._last
        seconds = float(agreed[1])
        if steps > 0:  # the slowest rank's clock decides for all
            fitting = int(steps * _BETWEEN / max(seconds, 1e-6))
            self._every = max(1, min(fitting, _GROWTH * self._every))
        self._last = self._count
        self._next = self._count + self._every
        self._time = time.monotonic()
        return int(agreed[0])

    def restart_pace(self) -> None:
        """Measure the interval anew: calls change from steps to batches of a validation, or back."""
        self._every = 1
        self._last = self._count
        self._time = time.monotonic()
        self._next = self._count + 1

    def barrier(self) -> None:
        if self.group is not None:
            dist.barrier(self.group)
