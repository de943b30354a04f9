"""`write_dataset`: source items -> shuffled, indexed, byte-reproducible WebDataset shards.

- The plan is fixed before anything is converted: items of a split are shuffled once by the seed and cut into
  shards. A dropped item is simply absent from its shard, so what one shard holds never depends on another.
- One task per shard, run in this process or in a pool of spawned ones, each on one thread: the number of
  workers cannot change a byte. Several machines may each write a `Part` of the shards; `join_parts` then
  finds them and adds what only one writer can: `index.npz` and `manifest.json`.
- Killed at any moment and run again, the result is the same: tar, then its index, then (all shards done)
  `index.npz`, then `manifest.json`, each renamed into place from a temporary file. A shard is kept on the
  second run when its index carries the same fingerprint and its sha256 still fits.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Generic, TypeVar

from motionloom.datasets.base.config import require_local
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import parse_json, read_plain
from motionloom.datasets.base.lock import folder_lock
from motionloom.datasets.base.pool import Workers
from motionloom.datasets.base.progress import Meter
from motionloom.datasets.base.records import MANIFEST_FILE, Manifest, Split
from motionloom.datasets.shards.checksums import LocalShard, require_intact
from motionloom.datasets.shards.finish import (
    OLD_FOLDER,
    Planned,
    differences,
    finish,
    remove_strays,
    shards_in,
    write_record,
)
from motionloom.datasets.shards.index import ShardIndex, index_path
from motionloom.datasets.shards.options import DatasetFacts, WriteOptions
from motionloom.datasets.shards.staging import put
from motionloom.datasets.shards.store import RemoteStore
from motionloom.datasets.shards.tar import MOST_CLIPS
from motionloom.datasets.shards.tasks import (
    Convert,
    Result,
    ShardTask,
    finished_shard,
    plan_shards,
    write_shard,
)

T = TypeVar("T")

_NAME = re.compile(r"[A-Za-z0-9_-]+")


def write_dataset(
    out: Path,
    items: Sequence[tuple[Split, T]],
    convert: Convert[T],
    facts: DatasetFacts,
    how: WriteOptions | None = None,
    *,
    describe: Callable[[T], str] = str,
) -> Manifest:
    """Convert `items`, each already assigned to a split, into shards under `out`; return the manifest.

    `convert` must be picklable with several workers. It may raise `DropClip(reason)` to leave an item out;
    any other exception drops the item with its reason too, or stops the run when `how.strict`. `describe` as
    for `dataset_writer`.
    """
    with dataset_writer(out, items, facts, how, describe=describe) as writer:
        return writer.write(convert)


@contextmanager
def dataset_writer(
    out: Path,
    items: Sequence[tuple[Split, T]],
    facts: DatasetFacts,
    how: WriteOptions | None = None,
    *,
    describe: Callable[[T], str] = str,
    depends_on: Callable[[T], object] | None = None,
    removed: Sequence[tuple[Split, T]] = (),
    store: RemoteStore | None = None,
) -> Iterator[DatasetWriter[T]]:
    """Context that locks `out` and compares it with the plan, for work between that and the writing.

    `store` is the bucket that the folder stands for (`staging.py`); then a part is written.

    `describe` names an item in reports and in the digest by which an earlier run's clips are kept, so it must
    not change between runs. `depends_on` returns the item's content as plain JSON; without it only names and
    the facts' options are compared. `removed` as for `plan_shards`.
    """
    how = how or WriteOptions()
    _check_arguments(facts, how)
    require_local(out)
    out.mkdir(parents=True, exist_ok=True)
    with folder_lock(out, shared=how.part is not None), Workers(how.workers) as pool:
        tasks = plan_shards(out, items, facts, how, describe, depends_on, removed)
        yield DatasetWriter(out, tasks, facts, how, pool, store)


class DatasetWriter(Generic[T]):
    """The shards of one run, planned and compared with what an earlier run finished."""

    def __init__(
        self,
        out: Path,
        tasks: list[ShardTask[T]],
        facts: DatasetFacts,
        how: WriteOptions,
        pool: Workers,
        store: RemoteStore | None,
    ) -> None:
        self.out = out
        self._store = store
        self._pool = pool
        self._how = how
        self._name = facts.name
        self._planned = _planned(tasks, facts)
        _require_same(out, self._planned.manifest)
        part = how.part
        self._tasks = tasks if part is None else [task for at, task in enumerate(tasks) if part.has(at)]
        with ThreadPoolExecutor(pool.count) as threads:  # hashing runs outside the interpreter's lock
            self._results = list(threads.map(self._finished, self._tasks))
        self._todo = [at for at, result in enumerate(self._results) if result is None]
        self._news = ""
        if self._todo:
            if store is not None and (out / MANIFEST_FILE).exists():
                store.remove(MANIFEST_FILE)
            for folder in (out, out / OLD_FOLDER):  # a removal that was killed has no say any more
                (folder / MANIFEST_FILE).unlink(missing_ok=True)
            if part is None:
                self._take_over(tasks)
        if part is None:
            remove_strays(out, self._planned)

    def _take_over(self, tasks: list[ShardTask[T]]) -> None:
        """Move an earlier run's shards that differ from the plan aside, and plan to keep their clips."""
        folder = self.out / OLD_FOLDER
        # Shards that do not fit the plan move aside first: their names now belong to other clips.
        finished = {task.path for task, result in zip(tasks, self._results, strict=True) if result}
        for path in sorted(shards_in(self.out, self._name, ".tar")):
            if path not in finished:
                folder.mkdir(parents=True, exist_ok=True)
                path.replace(folder / path.name)
                if index_path(path).exists():
                    index_path(path).replace(index_path(folder / path.name))
        wanted = {item.made_from for at in self._todo for item in tasks[at].items}
        kept: dict[str, Path] = {}
        sources: set[str] = set()
        for path in sorted(shards_in(folder, self._name, ".tar")):
            with suppress(UserError):  # damaged, or without an index: made again
                index = ShardIndex.load_json(index_path(path))
                if index.shard is not None:
                    require_intact(LocalShard(path, index.shard))
                    sources.update(clip.source for clip in index.clips)
                    sources.update(drop.source for drop in index.dropped)
                    kept |= {clip.made_from: path for clip in index.clips if clip.made_from in wanted}
        for at in self._todo:
            own = {item.made_from: kept[item.made_from] for item in tasks[at].items if item.made_from in kept}
            self._tasks[at] = replace(tasks[at], kept=own)
        if sources:
            self._news = self._changes(sources, {item.name for task in tasks for item in task.items})

    def _changes(self, before: set[str], now: set[str]) -> str:
        """Return the differences from the shards of an earlier run, in words."""
        tasks = [self._tasks[at] for at in self._todo]
        again = [item.name for task in tasks for item in task.items if item.made_from not in task.kept]
        new = sum(name not in before for name in again)
        counts = ((new, "new"), (len(again) - new, "changed"), (len(before - now), "gone"))
        words = ", ".join(f"{count:,} {word}" for count, word in counts if count) or "none changed"
        return f"{self.out}: of an earlier run's clips {len(now) - len(again):,} are kept; {words}"

    @property
    def progress_line(self) -> str:
        """One line on the shards that an earlier run has finished; empty when there are none."""
        if self._news:
            return self._news
        finished = len(self._tasks) - len(self._todo)
        if not finished:
            return ""
        clips = sum(shard.samples for result in self._results if result and (shard := result[0]) is not None)
        state = f"{finished:,} of {len(self._tasks):,} shards ({clips:,} clips)"
        if self._todo:
            return f"{self.out}: goes on after {state} of an earlier run"
        return f"{self.out}: finished already, {state}; nothing to convert"

    def pending(self) -> list[T]:
        """Items that must be converted."""
        tasks = [self._tasks[at] for at in self._todo]
        return [item.item for task in tasks for item in task.items if item.made_from not in task.kept]

    def write(self, convert: Convert[T]) -> Manifest:
        """Write unfinished shards and, unless this is a part, index and manifest; a part's covers itself."""
        part = self._how.part
        if part is None:
            return finish(self.out, self._planned, self._shards(convert))
        if self._store is None:
            write_record(self.out, part, self._planned)
        manifest = self._planned.with_results(self._shards(convert))
        if self._store is not None:
            record = write_record(self.out, part, self._planned)
            put(self._store, self.out, *_names(self.out, "joint_maps/*"), record)
        return manifest

    def _finished(self, task: ShardTask[T]) -> Result | None:
        return finished_shard(task.path, task.fingerprint, self._store, strict=task.strict)

    def _shards(self, convert: Convert[T]) -> list[Result]:
        done = len(self._tasks) - len(self._todo)
        with Meter("writing shards", len(self._tasks), done=done, shown=self._how.progress) as meter:
            tasks = [self._tasks[at] for at in self._todo]
            for position, result in self._pool.run(partial(write_shard, convert=convert), tasks):
                self._results[self._todo[position]] = result
                if self._store is not None:  # the index behind its shard, which then leaves this disk
                    path = tasks[position].path
                    put(self._store, self.out, path.name, index_path(path).name)
                    path.unlink(missing_ok=True)
                meter.advance()
        return [result for result in self._results if result is not None]


def _planned(tasks: Sequence[ShardTask[T]], facts: DatasetFacts) -> Planned:
    layout = facts.layout
    stated = {name: value for name, value in vars(facts).items() if name in Manifest.model_fields}
    stated |= {"layout": layout.name, "family": layout.family, "skeleton": layout.skeleton_name}
    manifest = Manifest(**stated, fps=layout.fps, shards=[])
    return Planned(
        manifest=manifest,
        fingerprints={task.path.name: task.fingerprint for task in tasks},
        items=sum(len(task.items) for task in tasks),
        not_ours=list(facts.not_ours),
        lost=list(facts.lost),
        most_lost=facts.most_lost,
    )


def _names(folder: Path, pattern: str) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.glob(pattern))


def _check_arguments(facts: DatasetFacts, how: WriteOptions) -> None:
    if not _NAME.fullmatch(facts.name):
        raise UserError(f"dataset name '{facts.name}': use letters, digits, '-' and '_' only")
    if how.workers < 1 or not 1 <= how.clips_per_shard <= MOST_CLIPS:
        raise UserError(
            f"workers ({how.workers}) must be at least 1, clips per shard ({how.clips_per_shard}) 1 to "
            f"{MOST_CLIPS}"
        )
    try:
        json.dumps(facts.options, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise UserError(f"converter options must be plain JSON values: {error}") from None


def _require_same(out: Path, now: Manifest) -> None:
    """Refuse to write over another dataset, or over a finished one with other options."""
    path = out / MANIFEST_FILE
    try:
        before = Manifest.parse(parse_json(read_plain(path), str(path)), str(path))
    except FileNotFoundError:  # or another part took it away meanwhile
        return
    if before.name != now.name:
        raise UserError(f"{out} holds dataset '{before.name}', not '{now.name}'; choose another folder")
    if changed := differences(before, now):
        raise UserError(
            f"{out} holds this dataset, finished with other options ({changed}); choose another folder, or "
            f"delete this one to make it anew"
        )
