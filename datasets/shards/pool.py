"""Runs shard tasks in this process or in a pool of spawned ones, and turns their deaths into sentences."""

from __future__ import annotations

import errno
import multiprocessing
import os
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait
from typing import TypeVar

from rich.progress import Progress

from motionloom.datasets.schema import Dropped, ShardInfo, UserError
from motionloom.datasets.shards.tasks import Convert, ShardTask, write_shard

T = TypeVar("T")
Result = tuple[ShardInfo | None, list[Dropped]]


def run_tasks(
    tasks: list[ShardTask[T]], convert: Convert[T], *, workers: int, progress: bool
) -> list[Result]:
    """Results in task order, whatever order the workers finish in."""
    results: dict[int, Result] = {}
    with Progress(disable=not progress) as bar:
        shown = bar.add_task("writing shards", total=len(tasks))
        for position, result in _finished_tasks(tasks, convert, workers):
            results[position] = result
            bar.advance(shown)
    return [results[position] for position in range(len(tasks))]


def _finished_tasks(
    tasks: list[ShardTask[T]], convert: Convert[T], workers: int
) -> Iterator[tuple[int, Result]]:
    try:
        if workers == 1 or len(tasks) <= 1:
            for position, task in enumerate(tasks):
                yield position, write_shard(task, convert)
            return
        pool = ProcessPoolExecutor(
            min(workers, len(tasks)), multiprocessing.get_context("spawn"), initializer=_exit_with_parent
        )
        try:
            futures = {
                pool.submit(write_shard, task, convert): position for position, task in enumerate(tasks)
            }
            for future in as_completed(futures):
                yield futures[future], future.result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
    except BrokenProcessPool:
        raise UserError(
            "a conversion worker was killed (out of memory?); run again with fewer workers: "
            "finished shards are kept"
        ) from None
    except OSError as error:
        if error.errno == errno.ENOSPC:
            folder = tasks[0].path.parent
            raise UserError(
                f"{folder}: the disk is full; free space and run again: finished shards are kept"
            ) from None
        raise


def _exit_with_parent() -> None:
    """End this worker when its parent dies, even by SIGKILL; it would otherwise wait for ever."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    threading.Thread(target=_watch, args=(parent.sentinel,), daemon=True).start()


def _watch(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)
