"""Clips that must not be in a data set any more: `motionloom data remove`.

`removed.json` keeps them out of later conversions into the same folder. It holds no name, but salted hashes
of their ids, their files' names and their subjects: whoever knows a name can look whether it is there.

Killed at any moment, the folder has no manifest, so nothing reads it, until `remove` or a conversion is given
again: the old manifest and the shards concerned lie in `.old` until the new manifest stands.
"""

from __future__ import annotations

import hashlib
import secrets
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError, nearest
from motionloom.datasets.base.files import sync_folder, write_json
from motionloom.datasets.base.json_doors import whole
from motionloom.datasets.base.lock import folder_lock
from motionloom.datasets.base.records import (
    CLEANED_FILE,
    MANIFEST_FILE,
    REMOVED_FILE,
    Decisions,
    Manifest,
    ShardInfo,
)
from motionloom.datasets.convert.common.splits import original_of, subject_of
from motionloom.datasets.shards.checksums import LocalShard, require_intact
from motionloom.datasets.shards.finish import OLD_FOLDER, Planned, finish
from motionloom.datasets.shards.index import ClipEntry, ShardIndex, index_path
from motionloom.datasets.shards.reader import load_manifest, manifest_layout
from motionloom.datasets.shards.sample import Sample, meta_from_json
from motionloom.datasets.shards.tasks import Result, ShardItem, ShardTask, without, write_shard

_DERIVED = ("search.npz", "report.html", "clean.html")
"""Files beside the shards that are made of them, with names, words or motions of clips."""


class Removed(Config):
    """`removed.json`."""

    salt: str
    hashes: tuple[str, ...] = ()
    """sha256 of the salt and of what is removed, sorted."""

    @classmethod
    def of(cls, root: Path) -> Removed:
        """Read the record of a folder; one that holds nothing where there is none."""
        path = root / REMOVED_FILE
        return cls.load_json(path) if path.is_file() else cls(salt=secrets.token_hex(16))

    @cached_property
    def _known(self) -> frozenset[str]:
        return frozenset(self.hashes)

    def _hash(self, name: str) -> str:
        return hashlib.sha256(f"{self.salt} {name}".encode()).hexdigest()

    def lists(self, name: str) -> bool:
        return self._hash(name) in self._known

    def has(self, clip_id: str, source: str) -> bool:
        """Whether a clip, its file or its subject is removed, or the clip that it mirrors."""
        return bool(self._known) and any(map(self.lists, _names(clip_id, source)))

    def and_more(self, names: Iterable[str]) -> Removed:
        return Removed(salt=self.salt, hashes=tuple(sorted({*self.hashes, *map(self._hash, names)})))


def _names(clip_id: str, source: str) -> Iterator[str]:
    """By what a clip may be removed."""
    yield f"id {clip_id}"
    yield f"source {source}"
    if (original := original_of(clip_id)) is not None:
        yield f"id {original}"
    yield from (f"subject {name}" for name in _subjects(source))


def _subjects(source: str) -> list[str]:
    """The subject of a file, and the folders that it lies in."""
    parts = subject_of(source.partition(" (")[0]).split("/")
    return ["/".join(parts[:count]) for count in range(len(parts), 0, -1)]


class Removal(NamedTuple):
    """Numbers of clips and shards that were removed or written again, and the set's new manifest."""

    clips: int
    shards: int
    manifest: Manifest


def remove(root: Path, *, ids: Sequence[str] = (), subjects: Sequence[str] = ()) -> Removal:
    """Take clips out of the shards of a data set, by their ids or all of some subjects, with the clips that
    mirror them. Shards that hold none of them are not touched.

    Nothing given finishes what was killed. `UserError` for what the set does not hold and did not, and when
    nothing would be left.
    """
    if not root.is_dir():
        raise UserError(f"{root}: no such folder")
    with folder_lock(root):
        aside = root / OLD_FOLDER
        finished = root / MANIFEST_FILE
        pending = aside / MANIFEST_FILE
        if finished.exists() or not pending.exists():
            manifest = load_manifest(root)
            if not (ids or subjects):
                raise UserError(f"{root}: give the clips to remove: --subject NAME or --id ID")
            shutil.rmtree(aside, ignore_errors=True)
        else:
            manifest = Manifest.load_json(pending)
        indices = {shard.name: ShardIndex.load_json(_old_index(root, shard)) for shard in manifest.shards}
        clips = [clip for index in indices.values() for clip in index.clips]
        before = Removed.of(root)
        given = [*(f"id {name}" for name in ids), *(f"subject {name}" for name in subjects)]
        record = before.and_more(given)
        gone = [clip for clip in clips if record.has(clip.id, clip.source)]
        _require_known(root, clips, given, before)
        if len(gone) == len(clips):
            raise UserError(f"{root}: nothing would be left; delete the folder")
        # What is damaged must not be written again as if it were whole.
        lost = {clip.id for clip in gone}
        for shard in manifest.shards:
            if any(clip.id in lost for clip in indices[shard.name].clips):
                old = aside / shard.name
                require_intact(LocalShard(old if old.exists() else root / shard.name, shard))
        record = record.and_more(
            f"{kind} {getattr(clip, kind)}" for clip in gone for kind in ("id", "source")
        )
        if finished.exists():
            aside.mkdir(exist_ok=True)
            finished.replace(pending)
            sync_folder(root)
        write_json(root / REMOVED_FILE, record.dump())
        kept = _unnamed(manifest, gone, record)
        licences = Counter(manifest.licences)
        results = list[Result]()
        written = 0
        for shard in manifest.shards:
            index = indices[shard.name]
            dropped = [drop for drop in index.dropped if not record.has("", drop.source)]
            concerned = [clip for clip in index.clips if record.has(clip.id, clip.source)]
            info: ShardInfo | None = shard
            if concerned:
                licences.subtract(_put_aside(root, shard, concerned))
                info = _rewritten(root, kept, shard, index, concerned)
                index = ShardIndex.load_json(index_path(root / shard.name))
                written = written + 1
            if concerned or len(dropped) < len(index.dropped):
                write_json(
                    index_path(root / shard.name), index.model_copy(update={"dropped": dropped}).dump()
                )
            results.append((info, []))
        _forget(root, {clip.id for clip in gone})
        kept = kept.model_copy(update={"licences": {name: n for name, n in licences.items() if n > 0}})
        planned = Planned(manifest=kept, fingerprints={}, items=0, lost=[], most_lost=1.0)
        return Removal(len(gone), written, finish(root, planned, results))


def _require_known(root: Path, clips: Sequence[ClipEntry], given: Iterable[str], before: Removed) -> None:
    """`UserError` for a name that no clip has, nor a clip that was removed before."""
    known = {name for clip in clips for name in _names(clip.id, clip.source)}
    for name in given:
        if name not in known and not before.lists(name):
            kind, _, word = name.partition(" ")
            alike = sorted(one.removeprefix(f"{kind} ") for one in known if one.startswith(f"{kind} "))
            raise UserError(f"{root}: no clip of {kind} '{word}'{nearest(word, alike, alike[:5])}")


def _old_index(root: Path, shard: ShardInfo) -> Path:
    """Path of a shard's index from before the removal."""
    moved = index_path(root / OLD_FOLDER / shard.name)
    return moved if moved.exists() else index_path(root / shard.name)


def _put_aside(root: Path, shard: ShardInfo, concerned: Sequence[ClipEntry]) -> Counter[str]:
    """Move a shard, and then its index, into `.old`; return the licences of its clips."""
    old = root / OLD_FOLDER / shard.name
    if not index_path(old).exists():
        if not old.exists():
            (root / shard.name).replace(old)
        # The index last: it says that both are there.
        index_path(root / shard.name).replace(index_path(old))
        sync_folder(old.parent)
    licences = Counter[str]()
    with old.open("rb") as file:
        for clip in concerned:
            start, size = clip.members["meta.json"]
            file.seek(start)
            licences[meta_from_json(file.read(size), f"{old}: '{clip.key}'").licence] += 1
    return licences


def _rewritten(
    root: Path, manifest: Manifest, shard: ShardInfo, index: ShardIndex, gone: Sequence[ClipEntry]
) -> ShardInfo | None:
    """Write a shard again without some clips; None when no clip of it is left."""
    old = root / OLD_FOLDER / shard.name
    left = {clip.made_from for clip in gone}
    items = {
        clip.made_from: ShardItem(clip.source, clip.made_from, None)
        for clip in index.clips
        if clip.made_from not in left
    }
    number = whole(shard.name.removesuffix(".tar").rpartition("-")[2], f"{root}: {shard.name}")
    task = ShardTask[None](
        root / shard.name, shard.split, number, tuple(items.values()), manifest_layout(manifest), "float32",
        False, without(index.fingerprint, left), dict.fromkeys(items, old),
    )  # fmt: skip
    return write_shard(task, _never)[0]


def _never(item: None) -> list[Sample]:
    raise AssertionError("every clip is kept")


def _unnamed(manifest: Manifest, gone: Sequence[ClipEntry], record: Removed) -> Manifest:
    """A manifest, without shards, that names no removed file."""
    names = {clip.source for clip in gone} | {
        drop.source for drop in manifest.dropped if record.has("", drop.source)
    }
    return manifest.model_copy(
        update={
            "shards": [],
            "dropped": [drop for drop in manifest.dropped if drop.source not in names],
            "notes": [note for note in manifest.notes if not any(name in note for name in names)],
        }
    )


def _forget(root: Path, ids: set[str]) -> None:
    """Take clips out of what lies beside the shards."""
    decided = Decisions.of(root)
    if ids & {*decided.left_out, *decided.kept}:
        left_out = {clip: why for clip, why in decided.left_out.items() if clip not in ids}
        kept = tuple(clip for clip in decided.kept if clip not in ids)
        write_json(root / CLEANED_FILE, Decisions(left_out=left_out, kept=kept).dump())
    for name in _DERIVED:
        (root / name).unlink(missing_ok=True)
