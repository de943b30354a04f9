"""The end of a conversion: list of clips left out, `index.npz` and `manifest.json` of finished shards.

Parts of a conversion leave a record each (`Planned`), from which `join_parts` does the same later.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from pydantic import Field

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import remove_temporaries, sync_folder, write_json
from motionloom.datasets.base.lock import folder_lock
from motionloom.datasets.base.records import (
    INDEX_FILE,
    MANIFEST_FILE,
    SPLITS,
    Decisions,
    Dropped,
    Manifest,
    ShardInfo,
    Split,
)
from motionloom.datasets.shards.card import CARD_FILE, write_card
from motionloom.datasets.shards.columns import carry_over, drop_columns
from motionloom.datasets.shards.index import ShardIndex, SplitIndex, index_path, save_index
from motionloom.datasets.shards.left_out import DOUBTFUL, LEFT_OUT_FILE, doubtful, grouped, write_left_out
from motionloom.datasets.shards.options import SOURCE_CHECKSUM, Part
from motionloom.datasets.shards.sample import MEMBERS
from motionloom.datasets.shards.staging import put, staged
from motionloom.datasets.shards.store import RemoteStore
from motionloom.datasets.shards.tasks import Result, finished_shard

OLD_FOLDER = ".old"
"""Inside the folder of the shards: shards of an earlier run whose clips are taken over; removed when the
manifest stands."""
PARTS_FOLDER = ".parts"
"""Inside it, too: the record of each part, until they are joined."""


class Planned(Config):
    """Facts of a finished set beside its shards; equal in all parts of one conversion."""

    manifest: Manifest
    """Manifest without shards; `dropped` are the clips that the plan left out."""
    fingerprints: dict[str, str]
    """Fingerprint of every shard of all parts by its name, in the manifest's order."""
    items: int = Field(ge=0)
    """Items of all shards."""
    not_ours: list[Dropped] = Field(default_factory=list)
    """As in `DatasetFacts`."""
    lost: list[Dropped]
    most_lost: float = Field(ge=0)
    """As in `DatasetFacts`."""

    def with_results(self, results: Sequence[Result]) -> Manifest:
        """Return the manifest with finished shards."""
        shards = [shard for shard, _ in results if shard is not None]
        failed = [drop for _, drops in results for drop in drops]
        return self.manifest.model_copy(
            update={"shards": shards, "dropped": [*self.manifest.dropped, *failed]}
        )


def write_record(out: Path, part: Part, planned: Planned) -> str:
    """Write a part's record, unless the set is joined already; return its name."""
    name = f"{PARTS_FOLDER}/{part.number}-of-{part.count}.json"
    if not (out / MANIFEST_FILE).exists():
        write_json(out / name, planned.dump())
    return name


def join_parts(place: Path | str) -> Manifest:
    """Make one data set of the finished parts in a folder or bucket; one that is joined already is left as it
    is.

    `UserError` for parts that are missing, unfinished, or made of other sources or with other settings.
    """
    with staged(place) as (out, store):
        if not out.is_dir():
            raise UserError(f"{out}: no such folder")
        manifest = _join(out, store)
        if store is not None:
            put(store, out, CARD_FILE, LEFT_OUT_FILE, INDEX_FILE, MANIFEST_FILE)
            # The plan's shards: one without a clip is an index alone. None where all was joined before.
            keep = {path.stem for path in shards_in(out, manifest.name, ".index")}
            for name in reversed(store.names("")):  # the records last: a join that is killed has them still
                shard = name.removesuffix(".index").removesuffix(".tar")
                is_stray = _is_shard(manifest.name, f"{shard}.tar") and keep and shard not in keep
                if is_stray or name.startswith(f"{PARTS_FOLDER}/"):
                    store.remove(name)
        return manifest


def _join(out: Path, store: RemoteStore | None) -> Manifest:
    with folder_lock(out):
        records = {
            Part.parse(path.stem.replace("-of-", "/")): Planned.load_json(path)
            for path in sorted((out / PARTS_FOLDER).glob("*-of-*.json"))
        }
        if not records:
            if (out / MANIFEST_FILE).exists():
                return Manifest.load_json(out / MANIFEST_FILE)
            raise UserError(f"{out}: no part in it; make the parts first: data convert … --part 1/8")
        planned = _require_one_plan(out, records)
        with ThreadPoolExecutor() as threads:  # hashing runs outside the interpreter's lock
            fingerprints = planned.fingerprints.items()
            results = list(threads.map(lambda one: finished_shard(out / one[0], one[1], store), fingerprints))
        count = max(part.count for part in records)
        missing = _missing(results, count)
        if missing:
            parts = [f"{number}/{count}" for number in missing]
            raise UserError(
                f"{out}: part {', '.join(parts)} {'is' if len(parts) == 1 else 'are'} missing or not "
                f"finished: give the same data convert … --part {parts[0]}"
            )
        if store is None:
            remove_strays(out, planned)
        else:
            drop_columns(out, planned.with_results([one for one in results if one is not None]).shards)
        return finish(out, planned, [result for result in results if result is not None])


def missing_parts(out: Path, count: int) -> list[int]:
    """Numbers of the parts of `count` that are not finished in `out`, as an earlier run has planned them."""
    record = next(iter(sorted((out / PARTS_FOLDER).glob("*-of-*.json"))), None)
    if record is None:
        return [] if (out / MANIFEST_FILE).exists() else [*range(1, count + 1)]
    fingerprints = Planned.load_json(record).fingerprints.items()
    return _missing([finished_shard(out / name, fingerprint) for name, fingerprint in fingerprints], count)


def _missing(results: Sequence[Result | None], count: int) -> list[int]:
    return sorted({at % count + 1 for at, result in enumerate(results) if result is None})


def _require_one_plan(out: Path, records: Mapping[Part, Planned]) -> Planned:
    """Return the plan that all parts share; `UserError` where one has another."""
    (one, planned), *others = records.items()
    for part, other in others:
        if other.fingerprints != planned.fingerprints:
            changed = differences(planned.manifest, other.manifest)
            raise UserError(
                f"{out}: part {part} is not of the same source and settings as part {one} "
                f"({changed or 'its files, captions or joint maps are others'}): give one of them again, or "
                f"delete its record in {out / PARTS_FOLDER}"
            )
    return planned


def differences(before: Manifest, now: Manifest) -> str:
    """Return up to three options that differ, as `fps 20.0 -> 10.0`; the source does not count."""
    old, new = (one.dump()["options"] | {"layout": one.layout, "fps": one.fps} for one in (before, now))
    keys = [key for key in sorted({*old, *new} - {SOURCE_CHECKSUM}) if old.get(key) != new.get(key)]
    told = [_difference(key, old.get(key), new.get(key)) for key in keys[:3]]
    return "; ".join([*told, f"and {len(keys) - 3} more"] if len(keys) > 3 else told)


def _difference(key: str, before: object, now: object) -> str:
    """`fps 20.0 -> 10.0`; facts of files are not spelled out."""
    if isinstance(before, dict) or isinstance(now, dict):
        return f"{key} is another"
    return f"{key} {json.dumps(before)} -> {json.dumps(now)}"


def finish(out: Path, planned: Planned, results: Sequence[Result]) -> Manifest:
    """Write the files beside the shards, the manifest last; `UserError` if too few clips became samples."""
    manifest = planned.with_results(results)
    manifest = manifest.model_copy(update={"excluded": Decisions.of(out).left_out})
    failed = manifest.dropped[len(planned.manifest.dropped) :]
    write_left_out(out, [*manifest.dropped, *planned.not_ours])
    if not manifest.shards:
        groups = grouped([*failed, *planned.manifest.dropped])
        some = "; ".join(map(str, groups[:3])) or "there was none"
        where = f"; all of them: {out / LEFT_OUT_FILE}" if len(manifest.dropped) > 1 else ""
        raise UserError(f"{out}: no clip survived the conversion ({some}){where}")
    # The index is written before the manifest: whoever sees a manifest finds everything that it names.
    doubts: list[Dropped] = []
    splits, made_on = _finish_index(out, manifest.shards, doubts)
    others = [note for note in manifest.notes if not note.startswith(DOUBTFUL)]  # of before a removal
    manifest = manifest.model_copy(update={"notes": [*others, *doubtful(doubts)]})
    columns = carry_over(out, out / OLD_FOLDER, manifest.shards)
    manifest = manifest.model_copy(update={"columns": columns})
    if len(made_on) > 1:
        kinds = f"{len(made_on)} kinds of processor ({', '.join(sorted(made_on))})"
        note = f"made on {kinds}: the last digits of clips may differ from those of a set made on one"
        manifest = manifest.model_copy(update={"notes": list(dict.fromkeys([*manifest.notes, note]))})
    held = [name for at, name in enumerate(MEMBERS) if any(index.sizes[:, at].any() for index in splits)]
    write_card(out, manifest, held)
    write_json(out / MANIFEST_FILE, manifest.dump())
    for folder in (OLD_FOLDER, PARTS_FOLDER):
        shutil.rmtree(out / folder, ignore_errors=True)
    # A wrong map or unit rather than bad clips.
    lost = [*planned.lost, *failed]
    clips = planned.items + len(planned.lost)
    if len(lost) > planned.most_lost * clips:
        raise UserError(
            f"{out}: {len(lost)} of {clips} clips cannot be used ({grouped(lost)[0]}); the rest is "
            f"converted; all reasons are in {out / LEFT_OUT_FILE}; to accept them: --set most_rejected=1"
        )
    return manifest


def remove_strays(out: Path, planned: Planned) -> None:
    """Delete temporary files of killed runs, and shards of this dataset that the plan does not have."""
    for folder in (out, *out.glob(".*/")):
        remove_temporaries(folder)
    for path in shards_in(out, planned.manifest.name, ".tar", ".index"):
        if path.name.replace(".index", ".tar") not in planned.fingerprints:
            path.unlink()
    sync_folder(out)


def shards_in(folder: Path, name: str, *suffixes: str) -> list[Path]:
    """Shards of the data set `name`, or their indices."""
    if not folder.is_dir():
        return []
    return [path for path in folder.iterdir() if _is_shard(name, path.name, *suffixes)]


def _is_shard(name: str, file: str, *suffixes: str) -> bool:
    ends = "|".join(map(re.escape, suffixes or (".tar",)))
    return re.fullmatch(rf"{re.escape(name)}-({'|'.join(SPLITS)})-\d{{6,}}({ends})", file) is not None


def _finish_index(
    out: Path, shards: Sequence[ShardInfo], doubts: list[Dropped]
) -> tuple[Collection[SplitIndex], set[str]]:
    """Write `index.npz`; what it holds of each split, and the kinds of processor that made the shards.

    What the judge of motion has found in the clips goes to `doubts`.
    """
    splits: dict[Split, SplitIndex] = {}
    owners: dict[str, str] = {}
    made_on: set[str] = set()

    def read(shard: ShardInfo) -> ShardIndex:
        index = ShardIndex.load_json(index_path(out / shard.name))
        made_on.update(index.kinds)
        doubts.extend(index.doubts)
        return _unique(index, shard.name, owners)

    for split in SPLITS:
        splits[split] = SplitIndex.build(read(shard) for shard in shards if shard.split == split)
    save_index(out, splits)
    return splits.values(), made_on


def _unique(index: ShardIndex, shard: str, owners: dict[str, str]) -> ShardIndex:
    for clip in index.clips:
        if clip.id in owners:
            raise UserError(
                f"clip id '{clip.id}' is in {owners[clip.id]} and again in {shard}; "
                f"make the converter's ids unique"
            )
        owners[clip.id] = shard
    return index
