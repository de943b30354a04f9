"""What every converter shares: the plan it shows first, splits, clip ids, and a pool for its own work.

A converter plans before it converts: the plan lists what was found, what is missing and what will be left out
and why, so nothing is skipped silently (`convert ... --plan` prints it and stops).
"""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from multiprocessing.connection import wait
from pathlib import Path
from typing import Generic, TypeVar

import torch
from rich.table import Table

from motionloom.datasets.schema import Dropped, Split, UserError
from motionloom.datasets.shards.index import SPLITS

TRAIN_SHARE, VAL_SHARE = 0.80, 0.05
"""80/5/15, the split of HumanML3D and Motion-X, where a source brings none."""

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class ConversionPlan(Generic[T]):
    """What a conversion would do. `items` become samples; everything else is told with its reason."""

    name: str
    items: list[tuple[Split, T]]
    frames: dict[Split, int]
    """Expected frames a split, at the target frame rate."""
    found: int
    """Motion files in the source."""
    missing: list[Dropped] = field(default_factory=list)
    """Listed by captions or split files, but not in the source."""
    uncaptioned: list[str] = field(default_factory=list)
    """In the source, without captions."""
    dropped: list[Dropped] = field(default_factory=list)
    """In the source and readable, but left out."""
    broken: list[Dropped] = field(default_factory=list)
    """In the source, but cannot be read."""
    ignored: int = 0
    """Files in the source that are not motion."""
    notes: list[str] = field(default_factory=list)

    def counts(self) -> dict[Split, int]:
        """Clips a split."""
        return {split: sum(s == split for s, _ in self.items) for split in SPLITS}

    def table(self) -> Table:
        """The plan for a terminal."""
        table = Table("what", "clips", "frames", "detail", title=f"plan: {self.name}")
        counts = self.counts()
        table.add_row("found in the source", str(self.found), "", f"{self.ignored} other files ignored")
        for split in SPLITS:
            table.add_row(split, str(counts[split]), str(self.frames.get(split, 0)), "")
        table.add_row("without captions", str(len(self.uncaptioned)), "", _some(self.uncaptioned))
        told = (("missing files", self.missing), ("left out", self.dropped), ("broken", self.broken))
        for title, drops in told:
            table.add_row(title, str(len(drops)), "", _some([f"{d.source}: {d.reason}" for d in drops]))
        for note in self.notes:
            table.add_row("note", "", "", note)
        return table

    def left_out(self) -> list[Dropped]:
        """Everything that will not become a sample, with reasons."""
        return [*self.missing, *self.broken, *self.dropped]

    def require_whole(self) -> None:
        """`UserError` when anything is missing or broken (`--strict`)."""
        bad = [*self.broken, *self.missing]
        if bad:
            raise UserError(f"{bad[0].source}: {bad[0].reason} (strict: {len(bad)} missing or broken)")


def _some(lines: Sequence[str], limit: int = 5) -> str:
    more = [f"... and {len(lines) - limit} more"] if len(lines) > limit else []
    return "\n".join([*lines[:limit], *more])


def hash_split(clip_id: str) -> Split:
    """80/5/15 by the id alone, so a clip keeps its split when others come or go."""
    share = int.from_bytes(hashlib.sha256(clip_id.encode()).digest()[:8], "big") / 2**64
    if share < TRAIN_SHARE:
        return "train"
    return "val" if share < TRAIN_SHARE + VAL_SHARE else "test"


def check_id(clip_id: str, where: str) -> str:
    """The id, if it can never leave a folder when something is named after it; `UserError` otherwise."""
    parts = clip_id.split("/")
    if (
        not clip_id
        or "\\" in clip_id
        or not clip_id.isprintable()
        or any(part in ("", ".", "..") for part in parts)
        or ":" in parts[0]
    ):
        raise UserError(f"{where}: clip id '{clip_id[:80]!s}' is not a plain relative name")
    return clip_id


def read_split_files(folder: Path) -> tuple[dict[str, Split], list[str]]:
    """`train.txt`, `val.txt`, `test.txt` (one id a line) -> split of every id, and notes on repeated lines.

    An id in two splits is a leak and an error; blank lines and CRLF are fine.
    """
    splits: dict[str, Split] = {}
    notes: list[str] = []
    files = [(split, folder / f"{split}.txt") for split in SPLITS if (folder / f"{split}.txt").is_file()]
    if not files:
        raise UserError(f"{folder}: no train.txt, val.txt or test.txt")
    for split, path in files:
        try:
            lines = path.read_text(encoding="utf-8-sig").splitlines()
        except UnicodeDecodeError as error:
            raise UserError(f"{path}: not UTF-8 text (byte {error.start})") from None
        here: set[str] = set()
        for number, line in enumerate(lines, start=1):
            clip_id = line.strip()
            if not clip_id:
                continue
            where = f"{path}:{number}"
            check_id(clip_id, where)
            known = splits.setdefault(clip_id, split)
            if known != split:
                raise UserError(f"{where}: '{clip_id}' is also in {known}.txt; a clip in two splits leaks")
            if clip_id in here:
                notes.append(f"{where}: '{clip_id}' is listed twice; the first line counts")
            here.add(clip_id)
    return splits, notes


def run_pool(work: Callable[[T], R], tasks: Sequence[T], workers: int) -> Iterator[tuple[int, R]]:
    """(position, result) of every task as it finishes, in spawned processes of one thread each.

    One worker or one task runs here, also on one thread. `work` and `tasks` must be picklable.
    """
    if workers <= 1 or len(tasks) <= 1:
        before = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            for position, task in enumerate(tasks):
                yield position, work(task)
        finally:
            torch.set_num_threads(before)
        return
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(min(workers, len(tasks)), context, initializer=_start_worker)
    try:
        futures = {pool.submit(work, task): position for position, task in enumerate(tasks)}
        for future in as_completed(futures):
            yield futures[future], future.result()
    except BrokenProcessPool:
        raise UserError(
            "a conversion worker was killed (out of memory?); run again with fewer workers: "
            "finished work is kept"
        ) from None
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _start_worker() -> None:
    """One thread, and an end when the parent dies, even by SIGKILL."""
    torch.set_num_threads(1)
    parent = multiprocessing.parent_process()
    assert parent is not None
    threading.Thread(target=_exit_after, args=(parent.sentinel,), daemon=True).start()


def _exit_after(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)
