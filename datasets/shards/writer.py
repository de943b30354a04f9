"""`write_dataset`: source items -> shuffled, indexed, byte-reproducible WebDataset shards.

- The plan is fixed before anything is converted: items of a split are shuffled once by the seed and cut into
  shards. A dropped item is simply absent from its shard, so what one shard holds never depends on another.
- One task per shard, run in this process or in a pool of spawned ones, each on one thread: the number of
  workers cannot change a byte. Several machines may each write a `Part` of the shards; a run without a part
  then finds them and adds what only one writer can: `index.npz` and `manifest.json`.
- Killed at any moment and run again, the result is the same: tar, then its index, then (all shards done)
  `index.npz`, then `manifest.json`, each renamed into place from a temporary file. A shard is kept on the
  second run when its index carries the same fingerprint and its sha256 still fits.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from rich.progress import Progress

from motionloom.datasets.base.files import remove_temporaries, sync_folder, write_json
from motionloom.datasets.base.lock import folder_lock
from motionloom.datasets.base.pool import Workers
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import SCHEMA_VERSION, Dropped, Manifest, ShardInfo, Split, UserError
from motionloom.datasets.shards.index import (
    MANIFEST_FILE,
    SPLITS,
    ShardIndex,
    SplitIndex,
    index_path,
    save_index,
)
from motionloom.datasets.shards.sample import MotionType
from motionloom.datasets.shards.tasks import (
    Convert,
    Part,
    Result,
    ShardTask,
    finished_shard,
    plan_shards,
    write_shard,
)

T = TypeVar("T")

WORK_FOLDER = ".work"
"""Inside the folder of the shards: what a first step makes; removed when the manifest stands."""

SOURCE_CHECKSUM = "source_sha256"
"""The option that tells of the source's content: a finished dataset follows its source."""

FirstStep = Callable[[Sequence[T], Workers], None]

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
    first: FirstStep[T] | None = None,
    part: Part | None = None,
) -> Manifest:
    """Convert `items`, each already assigned to a split, into shards under `out`; return the manifest.

    `convert` must be picklable when `workers > 1`. It may raise `DropClip(reason)` to leave an item out; any
    other exception drops the item with its reason too, or stops the run when `strict`. `describe` names an
    item in the manifest's drop list and in the fingerprint that decides whether a finished shard is kept, so
    it must not change between runs; a change of the source files' *content* is not noticed unless it shows in
    `describe` or `options`. `dropped` (clips the plan already left out), `licences`, `audio` and `notes` go
    into the manifest as they are. `first` is called with the items of the shards that are not finished, if
    there are any, before these are written; it may use `out / WORK_FOLDER`.

    With `part` only that part is made and no manifest is written; the one returned tells of the part. Parts
    may run at once; the run without a part excludes all others.
    """
    _check_arguments(name, workers, clips_per_shard, options)
    out.mkdir(parents=True, exist_ok=True)
    with folder_lock(out, shared=part is not None), Workers(workers) as pool:
        _check_same_dataset(out, name, layout, options)
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
        if part is None:
            _remove_strays(out, name, keep={task.path for task in tasks})
        results = _make(tasks, convert, first, part, pool, out, progress)
        shards = [shard for shard, _ in results if shard is not None]
        failed = [drop for _, drops in results for drop in drops]
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
        if part is None:
            if not shards:
                told = "; ".join(f"{drop.source}: {drop.reason}" for drop in [*failed, *dropped][:3])
                raise UserError(f"{out}: no clip survived the conversion ({told or 'there was none'})")
            _finish_index(out, shards)
            write_json(out / MANIFEST_FILE, manifest.dump())
            shutil.rmtree(out / WORK_FOLDER, ignore_errors=True)
        return manifest


def _make(
    tasks: list[ShardTask[T]],
    convert: Convert[T],
    first: FirstStep[T] | None,
    part: Part | None,
    pool: Workers,
    out: Path,
    progress: bool,
) -> list[Result]:
    """Find or write the shards of `part` (all without one); results in task order."""
    features_only = part is not None and part.step == "features"
    mine = [task for position, task in enumerate(tasks) if features_only or not part or part.has(position)]
    with ThreadPoolExecutor(pool.count) as threads:  # hashing runs outside the interpreter's lock
        found = list(threads.map(lambda task: finished_shard(task, verify=not features_only), mine))
    todo = [position for position, result in enumerate(found) if result is None]
    if todo:
        (out / MANIFEST_FILE).unlink(missing_ok=True)
        if first is not None:
            first([item for position in todo for _, item in mine[position].named_items], pool)
    if features_only:
        return []
    with Progress(disable=not progress) as bar:
        shown = bar.add_task("writing shards", total=len(mine), completed=len(mine) - len(todo))
        for at, result in pool.run(_Write(convert), [mine[position] for position in todo]):
            found[todo[at]] = result
            bar.advance(shown)
    return [result for result in found if result is not None]


@dataclass(frozen=True)
class _Write(Generic[T]):
    """`write_shard` with its converter, for the pool."""

    convert: Convert[T]

    def __call__(self, task: ShardTask[T]) -> Result:
        return write_shard(task, self.convert)


def _check_arguments(name: str, workers: int, clips_per_shard: int, options: dict[str, Any]) -> None:
    if not _NAME.fullmatch(name):
        raise UserError(f"dataset name '{name}': use letters, digits, '-' and '_' only")
    if workers < 1 or clips_per_shard < 1:
        raise UserError(f"workers ({workers}) and clips per shard ({clips_per_shard}) must be at least 1")
    try:
        json.dumps(options, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise UserError(f"converter options must be plain JSON values: {error}") from None


def _check_same_dataset(out: Path, name: str, layout: MotionLayout, options: dict[str, Any]) -> None:
    """Never write over another dataset, or over a finished one that was made with other options."""
    try:
        manifest = json.loads((out / MANIFEST_FILE).read_bytes())
        found, before = manifest.get("name"), dict(manifest.get("options") or {})
    except FileNotFoundError:
        return
    except (ValueError, AttributeError, TypeError):
        raise UserError(f"{out / MANIFEST_FILE}: not a manifest; choose another folder") from None
    if found != name:
        raise UserError(f"{out} holds dataset '{found}', not '{name}'; choose another folder")
    before |= {"layout": manifest.get("layout"), "fps": manifest.get("fps")}
    now = {**json.loads(json.dumps(options)), "layout": layout.name, "fps": layout.fps}
    changed = [
        f"{key} {json.dumps(before.get(key))} -> {json.dumps(now.get(key))}"
        for key in sorted({*before, *now})
        if key != SOURCE_CHECKSUM and before.get(key) != now.get(key)
    ]
    if changed:
        raise UserError(
            f"{out} holds this dataset, finished with other options ({'; '.join(changed[:3])}"
            f"{f'; and {len(changed) - 3} more' if len(changed) > 3 else ''}); choose another folder, or "
            f"delete this one to make it anew"
        )


def _remove_strays(out: Path, name: str, keep: set[Path]) -> None:
    """Delete temporary files of killed runs, and shards of this dataset that the plan does not have."""
    names = {path.name for path in keep} | {index_path(path).name for path in keep}
    shard = re.compile(rf"{re.escape(name)}-({'|'.join(SPLITS)})-\d{{6,}}\.(tar|index\.json)")
    for folder in (out, *out.glob(".*/")):
        remove_temporaries(folder)
    for path in out.iterdir():
        if shard.fullmatch(path.name) and path.name not in names:
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
