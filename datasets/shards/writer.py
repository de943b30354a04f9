"""`write_dataset`: source items -> shuffled, indexed, byte-reproducible WebDataset shards.

- The plan is fixed before anything is converted: items of a split are shuffled once by the seed and cut into
  shards. A dropped item is simply absent from its shard, so what one shard holds never depends on another.
- One task per shard, run in this process or in a pool of spawned ones, each on one thread: the number of
  workers cannot change a byte.
- Killed at any moment and run again, the result is the same: tar, then its index, then (all shards done)
  `index.npz`, then `manifest.json`, each renamed into place from a temporary file. A shard is kept on the
  second run when its index carries the same fingerprint and its sha256 still fits.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import SCHEMA_VERSION, Dropped, Manifest, ShardInfo, Split, UserError
from motionloom.datasets.shards.files import sync_folder, write_json
from motionloom.datasets.shards.index import (
    INDEX_FILE,
    MANIFEST_FILE,
    SPLITS,
    ShardIndex,
    SplitIndex,
    index_path,
    save_index,
)
from motionloom.datasets.shards.pool import run_tasks
from motionloom.datasets.shards.sample import MotionType
from motionloom.datasets.shards.tasks import Convert, plan_shards

T = TypeVar("T")

_NAME = re.compile(r"[A-Za-z0-9_-]+")


def write_dataset(
    out: Path,
    items: Sequence[tuple[Split, T]],
    convert: Convert[T],
    *,
    name: str,
    layout: MotionLayout,
    licence: str,
    converter: str,
    converter_version: int,
    options: dict[str, Any],
    workers: int = 1,
    clips_per_shard: int = 256,
    seed: int = 0,
    strict: bool = False,
    progress: bool = True,
    describe: Callable[[T], str] = str,
    motion_type: MotionType = "float32",
    dropped: Sequence[Dropped] = (),
    licences: dict[str, int] | None = None,
    audio: dict[str, Any] | None = None,
    notes: Sequence[str] = (),
) -> Manifest:
    """Convert `items`, each already assigned to a split, into shards under `out`; return the manifest.

    `convert` must be picklable when `workers > 1`. It may raise `DropClip(reason)` to leave an item out; any
    other exception drops the item with its reason too, or stops the run when `strict`. `describe` names an
    item in the manifest's drop list and in the fingerprint that decides whether a finished shard is kept, so
    it must not change between runs; a change of the source files' *content* is not noticed unless it shows in
    `describe` or `options`. `dropped` (clips the plan already left out), `licences`, `audio` and `notes` go
    into the manifest as they are.
    """
    _check_arguments(name, workers, clips_per_shard, options)
    out.mkdir(parents=True, exist_ok=True)
    with _folder_lock(out):
        _check_same_dataset(out, name)
        made_from = {
            "schema_version": SCHEMA_VERSION,
            "layout": [layout.name, layout.family, layout.fps, layout.skeleton_name],
            "converter": [converter, converter_version],
            "options": options,
            "motion_type": motion_type,
        }
        tasks = plan_shards(
            out, items, name=name, layout=layout, made_from=made_from, clips_per_shard=clips_per_shard,
            seed=seed, strict=strict, describe=describe, motion_type=motion_type,
        )  # fmt: skip
        (out / MANIFEST_FILE).unlink(missing_ok=True)
        _remove_strays(out, name, keep={task.path for task in tasks})
        results = run_tasks(tasks, convert, workers=workers, progress=progress)
        shards = [shard for shard, _ in results if shard is not None]
        failed = [drop for _, drops in results for drop in drops]
        if not shards:
            reasons = "; ".join(f"{drop.source}: {drop.reason}" for drop in failed[:3])
            raise UserError(f"{out}: no clip survived the conversion ({len(failed)} dropped: {reasons})")
        _finish_index(out, shards)
        manifest = Manifest(
            name=name,
            layout=layout.name,
            family=layout.family,
            fps=layout.fps,
            skeleton=layout.skeleton_name,
            licence=licence,
            converter=converter,
            converter_version=converter_version,
            options=options,
            shards=shards,
            dropped=[*dropped, *failed],
            licences=licences or {},
            audio=audio,
            notes=list(notes),
        )
        write_json(out / MANIFEST_FILE, manifest.dump())
        return manifest


@contextmanager
def _folder_lock(out: Path) -> Iterator[None]:
    """Refuse a second writer in the same folder; the kernel frees the lock when the process dies."""
    handle = os.open(out, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UserError(
                f"{out}: another conversion is writing here; wait for it or choose another folder"
            ) from None
        yield
    finally:
        os.close(handle)


def _check_arguments(name: str, workers: int, clips_per_shard: int, options: dict[str, Any]) -> None:
    if not _NAME.fullmatch(name):
        raise UserError(f"dataset name '{name}': use letters, digits, '-' and '_' only")
    if workers < 1 or clips_per_shard < 1:
        raise UserError(f"workers ({workers}) and clips per shard ({clips_per_shard}) must be at least 1")
    try:
        json.dumps(options, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise UserError(f"converter options must be plain JSON values: {error}") from None


def _check_same_dataset(out: Path, name: str) -> None:
    """Never write over another dataset's folder."""
    path = out / MANIFEST_FILE
    if path.exists():
        found = Manifest.load_json(path).name
        if found != name:
            raise UserError(f"{out} holds dataset '{found}', not '{name}'; choose another folder")


def _remove_strays(out: Path, name: str, keep: set[Path]) -> None:
    """Delete temporary files of killed runs, and shards of this dataset that the plan does not have."""
    names = {path.name for path in keep} | {index_path(path).name for path in keep}
    shard = re.compile(rf"{re.escape(name)}-({'|'.join(SPLITS)})-\d{{6,}}\.(tar|index\.json)")
    temporary = re.compile(
        rf"\.({shard.pattern}|{re.escape(INDEX_FILE)}|{re.escape(MANIFEST_FILE)})\.\d+\.tmp"
    )
    for path in out.iterdir():
        if temporary.fullmatch(path.name) or (shard.fullmatch(path.name) and path.name not in names):
            path.unlink()
    sync_folder(out)


def _finish_index(out: Path, shards: list[ShardInfo]) -> None:
    """Concatenate the shard indices into `index.npz`; refuse an id that two clips share."""
    splits: dict[Split, SplitIndex] = {}
    owners: dict[str, str] = {}
    for split in SPLITS:
        splits[split] = SplitIndex.build(
            _unique(ShardIndex.load_json(index_path(out / shard.name)), shard.name, owners)
            for shard in shards
            if shard.split == split
        )
    save_index(out, splits)


def _unique(index: ShardIndex, shard: str, owners: dict[str, str]) -> ShardIndex:
    for clip in index.clips:
        if clip.id in owners:
            raise UserError(
                f"clip id '{clip.id}' is in {owners[clip.id]} and again in {shard}; "
                f"make the converter's ids unique"
            )
        owners[clip.id] = shard
    return index
