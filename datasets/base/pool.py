"""Independent tasks in this process or in spawned ones, each on one thread; deaths become sentences."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.connection import wait
from pathlib import Path
from types import TracebackType
from typing import Self, TypeVar

import threadpoolctl  # type: ignore[import-untyped]

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.os_errors import of_the_machine, sentence_of

T = TypeVar("T")
R = TypeVar("R")


def usable_cores() -> int:
    """Cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class Workers:
    """`count` processes, started when two or more tasks first need them and kept until the block ends.

    Spawned, because the parent may hold threads; one pool for all steps of a conversion, because a worker
    spends seconds on its imports.
    """

    def __init__(self, count: int) -> None:
        self.count = count
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)

    def run(self, work: Callable[[T], R], tasks: Sequence[T]) -> Iterator[tuple[int, R]]:
        """(position, result) of every task as it finishes.

        `work` and the tasks must be picklable when there are several of each. `UserError` when a worker is
        killed or the disk is full.
        """
        try:
            if self.count <= 1 or len(tasks) <= 1:
                for position, task in enumerate(tasks):
                    yield position, on_one_thread(work, task)
                return
            # Forking would copy the locks of the parent's threads as they are, some of them held for ever.
            if self._pool is None:
                context = multiprocessing.get_context("spawn")
                self._pool = ProcessPoolExecutor(
                    min(self.count, len(tasks)), context, initializer=_exit_with_parent
                )
            with _starting():
                futures = {
                    self._pool.submit(on_one_thread, work, task): position
                    for position, task in enumerate(tasks)
                }
            for future in as_completed(futures):
                yield futures.pop(future), future.result()  # results may be large: none is kept
        except (BrokenProcessPool, BrokenPipeError):  # the latter where one died as it started
            raise UserError(
                "a conversion worker was killed (out of memory?); run again with fewer workers: "
                "finished work is kept"
            ) from None
        except OSError as error:
            if of_the_machine(error):
                raise UserError(str(sentence_of(error))) from None
            raise


def on_one_thread(work: Callable[[T], R], task: T) -> R:
    """Sums in numerical libraries depend on their thread count; one thread makes bytes reproducible."""
    torch = sys.modules.get("torch")
    before = torch.get_num_threads() if torch else 0
    with threadpoolctl.threadpool_limits(1):
        if torch:
            torch.set_num_threads(1)
        try:
            return work(task)
        finally:
            if torch:
                torch.set_num_threads(before)


@contextmanager
def _starting() -> Iterator[None]:
    """Start workers that leave Ctrl-C to their parent, and do not import a program that would run anew in
    each, being without `if __name__ == "__main__"`, or that is gone, having come from stdin.
    """
    program = sys.modules["__main__"]
    file = Path(getattr(program, "__file__", None) or "")
    hidden = not file.is_file() or "__main__" not in file.read_text(encoding="utf-8", errors="replace")
    found = {name: getattr(program, name) for name in ("__file__", "__spec__") if hasattr(program, name)}
    # Blocked here, it is blocked in them from their first instruction on, up to `_exit_with_parent`.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        if hidden:
            program.__spec__ = None
            vars(program).pop("__file__", None)
        yield
    finally:
        vars(program).update(found)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _exit_with_parent() -> None:
    """End this worker when its parent dies, even by SIGKILL, where it would otherwise wait for ever; and at
    Ctrl-C without a word: its parent says it.
    """
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # a parent in the background is not ended by it
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    parent = multiprocessing.parent_process()
    assert parent is not None
    threading.Thread(target=_watch, args=(parent.sentinel,), daemon=True).start()


def _watch(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)
