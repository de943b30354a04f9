"""Opening what earlier stages made: shards, statistics, text cache."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

from pydantic import Field

from motionloom.datasets.loading.mix import MixedDataset
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import Caption, Config, Manifest
from motionloom.datasets.shards.cache import CacheConfig
from motionloom.datasets.shards.checksums import LocalShard
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.datasets.shards.options import Reading
from motionloom.datasets.shards.reader import ShardDataset, read_manifest
from motionloom.datasets.shards.store import LocalStore, Store, open_store
from motionloom.pipeline.store.run_folder import STAGE_NAME

SHARDS = "shards"
REFERENCE = "reference.json"
READER = "reader.json"
MIX = "mix.json"


class Reference(Config):
    """`reference.json` of a data stage whose shards lie elsewhere."""

    path: str
    """Folder with `manifest.json`, or a URL (`s3://`, `https://`, `http://`)."""
    order: Literal["global", "streamed"]
    shards_per_group: int


class Reader(Config):
    """`reader.json` beside it: what the recipe says now about how to read, which changes no result."""

    mode: Literal["indexed", "streamed"]
    cache: CacheConfig


class MixedStage(Config):
    """One data stage of a mix."""

    stage: str = Field(pattern=STAGE_NAME)
    """Its name, which is its folder beside that of the mix."""
    folder: str | None = None
    """Folder of a stage outside the run, seen from that of the mix."""
    weight: float = Field(gt=0, allow_inf_nan=False)


class Mix(Config):
    """`mix.json` of a stage that mixes data stages of its own run, or of others."""

    parts: list[MixedStage] = Field(min_length=1)

    def folders(self, mix: Path) -> list[Path]:
        """The folders of the stages; `mix` is that of the mix."""
        return [mix.parent / part.stage if part.folder is None else mix / part.folder for part in self.parts]


def open_split(folder: Path, split: str, *, training: bool = False) -> ClipDataset:
    """One split of a data stage.

    `training` says that batches are drawn from it by a plan: only then does the streaming reader serve, as
    the other stages visit clips in orders of their own.
    """
    if _is_plain(folder):
        return ShardDataset.open(folder / SHARDS, split)
    if (folder / MIX).is_file():
        mix = Mix.load_json(folder / MIX)
        pairs = zip(mix.folders(folder), mix.parts, strict=True)
        holding = [(place, part.weight) for place, part in pairs if split in splits_of(place)]
        opened = [(open_split(place, split, training=training), weight) for place, weight in holding]
        return opened[0][0] if len(opened) == 1 else MixedDataset(opened)
    reference = Reference.load_json(folder / REFERENCE)
    reader = Reader.load_json(folder / READER)
    reading = Reading(
        mode=reader.mode if training else "indexed",
        order=reference.order,
        shards_per_group=reference.shards_per_group,
        cache=reader.cache,
    )
    return ShardDataset.open(reference.path, split, reading=reading)


def _is_plain(folder: Path) -> bool:
    """Whether a data stage has shards of its own, and only those."""
    return not (folder / REFERENCE).is_file() and not (folder / MIX).is_file()


def splits_of(folder: Path) -> list[str]:
    """Splits that hold at least one clip, of any data set."""
    shards = [shard for _, manifest in _sources(folder) for shard in manifest.shards]
    filled = {shard.split for shard in shards if shard.samples}
    return [split for split in ("train", "val", "test") if split in filled]


def held_out(folder: Path, *, prefer: str = "val") -> str:
    """A split for validation: the preferred one, else the other held-out one, else train."""
    splits = splits_of(folder)
    other = "test" if prefer == "val" else "val"
    return next(split for split in (prefer, other, "train") if split in splits)


def local_shards(folder: Path) -> list[LocalShard]:
    """All shards of a data stage that lie in folders of this machine; a server's are compared on arrival.

    None of a kind that is not ours and keeps its data in another way.
    """
    if _is_plain(folder) and not (folder / SHARDS).is_dir():
        return []
    return [
        LocalShard(store.root / shard.name, shard)
        for store, manifest in _sources(folder)
        if isinstance(store, LocalStore)
        for shard in manifest.shards
    ]


def _sources(folder: Path) -> list[tuple[Store, Manifest]]:
    if (folder / MIX).is_file():
        places = Mix.load_json(folder / MIX).folders(folder)
        return [source for place in places for source in _sources(place)]
    if _is_plain(folder):
        store = open_store(folder / SHARDS)
    else:
        store = open_store(
            Reference.load_json(folder / REFERENCE).path, Reader.load_json(folder / READER).cache
        )
    return [(store, read_manifest(store)[0])]


@dataclass(frozen=True)
class DataPreview:
    """A data stage that has not run yet."""

    layout: MotionLayout


@dataclass(frozen=True)
class Data:
    """The splits of a data stage."""

    folder: Path

    @cached_property
    def layout(self) -> MotionLayout:
        return self.split(splits_of(self.folder)[0]).layout

    def split(self, name: str, *, training: bool = False) -> ClipDataset:
        return open_split(self.folder, name, training=training)

    def held_out(self, *, prefer: str = "val") -> ClipDataset:
        """A split that is not trained on, where there is one."""
        return self.split(held_out(self.folder, prefer=prefer))

    @property
    def splits(self) -> list[str]:
        """Splits that hold at least one clip."""
        return splits_of(self.folder)


def captions_of(dataset: ClipDataset, index: int, *, face: bool) -> list[Caption]:
    """Body or face captions of a clip."""
    return dataset.face_texts(index) if face else dataset.texts(index)
