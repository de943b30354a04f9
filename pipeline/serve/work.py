"""`Worker`: one thread that the model belongs to, and the requests that wait for it, first come first served.

Each request has a future of its own, so answers cannot be mixed up; one whose client has gone is dropped
before it is begun.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

T = TypeVar("T")


class Busy(Exception):  # noqa: N818 - an answer, not a fault
    """As many requests wait as may wait."""


class Stopped(Exception):  # noqa: N818
    """The server is stopping."""


class Worker:
    """Runs calls one after another in a thread of its own.

    Args:
        waiting: Calls that may wait, besides the one that runs.
    """

    def __init__(self, waiting: int) -> None:
        self.waiting = waiting
        self._calls: queue.Queue[Callable[[], None]] = queue.Queue(waiting)
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._work, name="model", daemon=True)
        self._thread.start()

    def submit(self, call: Callable[[], T]) -> Future[T]:
        """The future of a call; `Busy` where too many wait, `Stopped` after `stop`."""
        future: Future[T] = Future()

        def run() -> None:
            if self._stopped.is_set():
                if future.set_running_or_notify_cancel():
                    future.set_exception(Stopped())
                return
            if not future.set_running_or_notify_cancel():
                return
            try:
                future.set_result(call())
            except BaseException as error:
                future.set_exception(error)

        if self._stopped.is_set():
            raise Stopped
        try:
            self._calls.put_nowait(run)
        except queue.Full:
            raise Busy from None
        return future

    @property
    def length(self) -> int:
        return self._calls.qsize()

    @property
    def stopped(self) -> bool:
        """Whether `stop` was called; long calls look at it."""
        return self._stopped.is_set()

    def stop(self) -> None:
        """Answer all that wait with `Stopped`; what runs is let finish."""
        self._stopped.set()

    def _work(self) -> None:
        while True:
            try:
                call = self._calls.get(timeout=0.2)
            except queue.Empty:
                if self._stopped.is_set():
                    return
                continue
            call()
