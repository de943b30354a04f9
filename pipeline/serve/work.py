"""`Worker`: one thread that the model belongs to, and the requests that wait for it, first come first served.

Each request has a future of its own, so answers cannot be mixed up; one whose client has gone is dropped
before it is begun.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

T = TypeVar("T")


class Busy(Exception):  # noqa: N818 - an answer, not a fault
    """The largest allowed number of requests waits."""


class Worker:
    """Runs calls one after another in a thread of its own; asked by one thread alone.

    Args:
        waiting: Calls that may wait, besides the one that runs.
    """

    def __init__(self, waiting: int) -> None:
        self.waiting = waiting
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="model")
        self._calls: list[Future[Any]] = []

    def submit(self, call: Callable[[], T], *, begun: bool = False) -> Future[T]:
        """The future of a call; `Busy` where too many wait, unless it goes on with one that was begun."""
        if self.length >= self.waiting and not begun:
            raise Busy(f"{self.waiting} requests are waiting already; try again in a moment")
        future = self._pool.submit(call)
        self._calls.append(future)
        return future

    @property
    def length(self) -> int:
        """Calls that wait."""
        self._calls = [future for future in self._calls if not future.done()]
        return sum(not future.running() for future in self._calls)

    def stop(self) -> None:
        """Drop all that wait; what runs is let finish."""
        self._pool.shutdown(wait=False, cancel_futures=True)
