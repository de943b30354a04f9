"""One shard as one task: its fingerprint, its writing, and reuse of a finished one.

A task holds everything that its bytes depend on, and its fingerprint is the hash of that. So tasks may run in
any order, in any process or as elements of a cluster's job array, and a second run keeps finished shards.
"""

from __future__ import annotations

import platform
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Generic, NamedTuple, TypeVar

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import HashingFile, atomic_file, sha256_of_json, write_json
from motionloom.datasets.base.json_doors import open_plain
from motionloom.datasets.base.randomness import permutation
from motionloom.datasets.base.records import SPLITS, ClipMeta, Dropped, MotionType, ShardInfo, Split
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.checksums import LocalShard, require_intact
from motionloom.datasets.shards.index import ClipEntry, ShardIndex, Written, clip_entries, index_path
from motionloom.datasets.shards.left_out import drop
from motionloom.datasets.shards.options import DatasetFacts, WriteOptions
from motionloom.datasets.shards.sample import DropClip, Sample, encode_sample, meta_from_json
from motionloom.datasets.shards.store import RemoteStore

T = TypeVar("T")
Convert = Callable[[T], Sample | list[Sample]]
Result = tuple[ShardInfo | None, list[Dropped]]
"""A shard (None when every clip of it was dropped) and what was dropped."""


class ShardItem(NamedTuple, Generic[T]):
    """One item of a shard."""

    name: str
    """Name in reports."""
    made_from: str
    """Digest of everything that its clips depend on."""
    item: T


@dataclass(frozen=True)
class ShardTask(Generic[T]):
    """Everything one shard depends on."""

    path: Path
    split: Split
    number: int
    items: tuple[ShardItem[T], ...]
    layout: MotionLayout
    motion_type: MotionType
    strict: bool
    fingerprint: str
    kept: Mapping[str, Path] = field(default_factory=dict)
    """`made_from` of clips -> the tar of an earlier run that has them."""


def plan_shards(
    out: Path,
    items: Sequence[tuple[Split, T]],
    facts: DatasetFacts,
    how: WriteOptions,
    describe: Callable[[T], str],
    depends_on: Callable[[T], object] | None = None,
    removed: Sequence[tuple[Split, T]] = (),
) -> list[ShardTask[T]]:
    """Return the shards with their items in order: known before the first one is converted.

    With `depends_on`, which returns an item's content, a shard takes the items whose names have hashes that
    begin with some bits, and its number says which: a full one is split by the next bit. So an item that
    comes or goes changes its own shard alone, whatever the order in which a set has grown. `removed` items
    leave their places empty, so that no other item moves to another shard.
    """
    tasks: list[ShardTask[T]] = []
    made_from = sha256_of_json(facts.made_from())
    for position, split in enumerate(SPLITS):
        members = [item for item_split, item in items if item_split == split]
        present = len(members)
        members += [item for item_split, item in removed if item_split == split]
        names = [describe(item) for item in members]
        if depends_on is None:
            order = permutation(len(members), how.seed, position).tolist()
            firsts = range(0, len(members), how.clips_per_shard)
            shards = [(at, order[first : first + how.clips_per_shard]) for at, first in enumerate(firsts)]
        else:
            hashed = sorted((int(sha256_of_json([how.seed, name]), 16), i) for i, name in enumerate(names))
            shards = list(_by_prefix(hashed, how.clips_per_shard))
        # A fingerprint hashes all that a shard's bytes depend on: a later run keeps the shards that fit.
        for number, places in shards:
            digests = {}
            for i in places:
                content = None if depends_on is None else depends_on(members[i])
                digests[i] = sha256_of_json([made_from, split, names[i], content])
            chosen = tuple(ShardItem(names[i], digests[i], members[i]) for i in places if i < present)
            fingerprint = sha256_of_json([facts.name, split, number, list(digests.values())])
            fingerprint = without(fingerprint, (digests[i] for i in places if i >= present))
            path = out / f"{facts.name}-{split}-{number:06d}.tar"
            tasks.append(
                ShardTask(
                    path, split, number, chosen, facts.layout, facts.motion_type, how.strict, fingerprint
                )
            )
    return tasks


def _by_prefix(
    hashed: Sequence[tuple[int, int]], most: int, number: int = 0, bit: int = 255
) -> Iterator[tuple[int, list[int]]]:
    """(number, items) of shards of at most `most` of the sorted (hash, item), in their order.

    Shards are the leaves of a tree: number n, when full, becomes 2 n + 1 and 2 n + 2 by a bit of the hashes.
    """
    if len(hashed) <= most or bit < 0:  # the latter: items of one name
        yield number, [item for _, item in hashed]
        return
    half = sum(not value >> bit & 1 for value, _ in hashed)
    for child, part in ((2 * number + 1, hashed[:half]), (2 * number + 2, hashed[half:])):
        if part:
            yield from _by_prefix(part, most, child, bit - 1)


def without(fingerprint: str, removed: Iterable[str]) -> str:
    """The fingerprint of a shard from which items were removed, by their `made_from`."""
    whole, *before = fingerprint.split("-")
    return "-".join([whole, *sorted({*before, *(digest[:16] for digest in removed)})])


def write_shard(task: ShardTask[T], convert: Convert[T]) -> Result:
    """Write one shard and its index."""
    from webdataset.writer import TarWriter  # imports torch: two seconds that kept shards do not pay

    written: list[Written] = []
    dropped: list[Dropped] = []
    doubts: list[Dropped] = []
    made_on: set[str] = set()
    with atomic_file(task.path) as file:
        hashing = HashingFile(file)
        # No owner and no time in the headers: the same clips are the same bytes on any machine, on any day.
        with TarWriter(hashing, encoder=False, user="", group="", mtime=0) as tar:
            for item in task.items:
                old = task.kept.get(item.made_from)
                made_on |= _index_of(old)[0] if old else {_processor()}
                samples = _kept(old, item.made_from) if old else convert_item(task, convert, item)
                if isinstance(samples, Dropped):
                    dropped.append(samples)
                    continue
                for clip_id, present, members in samples:
                    tar.write({"__key__": _key(task, item, clip_id), **members})
                    doubts += doubts_of(meta_from_json(members["meta.json"], clip_id))
                    written.append(Written(clip_id, present, item.name, item.made_from))
    info = None
    # Offsets are read back from the file that lies on the disk, not from what was meant to be written.
    entries = clip_entries(task.path, written)
    if entries:
        info = ShardInfo(
            name=task.path.name,
            split=task.split,
            samples=len(entries),
            frames=sum(entry.frames for entry in entries),
            bytes=task.path.stat().st_size,
            sha256=hashing.hexdigest,
        )
    else:
        task.path.unlink()  # webdataset treats a shard without samples as an error
    index = ShardIndex(
        fingerprint=task.fingerprint,
        shard=info,
        clips=entries,
        dropped=dropped,
        doubts=doubts,
        made_on=", ".join(sorted(made_on)),
    )
    write_json(index_path(task.path), index.dump())
    return info, dropped


def _key(task: ShardTask[T], item: ShardItem[T], clip_id: str) -> str:
    """Key of a clip: its id, as names in tars may be, and a digest that no clip of another split or set has.

    Readers take several splits or sets together and refuse a key that comes twice. It is the clip's own: it
    stays when others come and go. By 48 bits, 10^5 ids that look alike meet once in 5 x 10^4 sets.
    """
    name = re.sub(r"[^A-Za-z0-9_-]", "_", clip_id)[-48:]
    data_set = task.path.name.rpartition("-")[0]
    return f"{name}-{sha256_of_json([data_set, item.made_from, clip_id])[:12]}".lstrip("-")


def _processor() -> str:
    """Return kind and widest instructions of the processor, which decide rounding: `x86_64 AVX2`."""
    import torch

    return f"{platform.machine()} {torch.backends.cpu.get_cpu_capability()}"


Encoded = list[tuple[str, int, dict[str, bytes]]]
"""(clip id, present, encoded members) of each sample of one item."""


def _kept(tar: Path, made_from: str) -> Encoded:
    """The samples as an earlier run wrote them."""
    out = []
    with open_plain(tar) as file:
        for clip in _index_of(tar)[1].get(made_from, []):
            members = {}
            for name, (start, size) in clip.members.items():
                file.seek(start)
                members[name] = file.read(size)
            out.append((clip.id, clip.held, members))
    return out


def _index_of(tar: Path) -> tuple[set[str], dict[str, list[ClipEntry]]]:
    """The kinds of processor of an earlier run's shard, and its clips by what they are made from."""
    return _read_index(tar, tar.stat().st_mtime_ns)


@lru_cache(maxsize=8)
def _read_index(tar: Path, changed: int) -> tuple[set[str], dict[str, list[ClipEntry]]]:
    """Read an index, cached by path and time of change."""
    index = ShardIndex.load_json(index_path(tar))
    clips_by_origin = dict[str, list[ClipEntry]]()
    for clip in index.clips:
        clips_by_origin.setdefault(clip.made_from, []).append(clip)
    return index.kinds, clips_by_origin


def doubts_of(meta: ClipMeta) -> list[Dropped]:
    """Return the faults that the judge of motion has found in a clip."""
    return [Dropped(source=meta.source, reason=fault.text) for fault in meta.faults or ()]


def convert_item(task: ShardTask[T], convert: Convert[T], item: ShardItem[T]) -> Encoded | Dropped:
    """Return the samples of one item, or the reason why it has none."""
    label = item.name
    try:
        output = convert(item.item)
        samples = output if isinstance(output, list) else [output]
        return [
            (
                sample.meta.id,
                sample.meta.present,
                encode_sample(sample, split=task.split, layout=task.layout, motion_type=task.motion_type),
            )
            for sample in samples
        ]
    except DropClip as decision:
        return Dropped(source=label, reason=str(decision))
    except Exception as error:  # a converter meets whatever a bad file makes of its libraries
        failed = drop(label, error)
        if task.strict:
            raise UserError(
                f"{label}: {failed.reason} (strict: the run stops at the first bad item)"
            ) from error
        return failed


def finished_shard(
    tar: Path, fingerprint: str, store: RemoteStore | None = None, *, strict: bool = False
) -> Result | None:
    """Return an earlier run's result of a task from the same inputs, or None when it must be made.

    The shard is in the folder of `tar`, or in the bucket that this stands for.
    """
    try:
        if store is not None and not index_path(tar).exists():
            store.get(index_path(tar).name, index_path(tar))
        index = ShardIndex.load_json(index_path(tar))
        if index.fingerprint != fingerprint or (strict and any(index.dropped)):
            return None
        if index.shard is not None:
            if store is None:
                require_intact(LocalShard(tar, index.shard))
            elif store.digest(tar.name) != index.shard.sha256:
                return None
    except UserError:  # none, or damaged: made again
        return None
    return index.shard, index.dropped
