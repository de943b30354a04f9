"""Opening what earlier stages made: shards, statistics, text cache."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

from pydantic import Field

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.records import Caption, Manifest
from motionloom.datasets.loading.mix import MixedDataset
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.cache import CacheConfig
from motionloom.datasets.shards.checksums import LocalShard
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.datasets.shards.options import Reading
from motionloom.datasets.shards.reader import ShardDataset, read_manifest
from motionloom.datasets.shards.store import LocalStore, Store, open_store
from motionloom.pipeline.store.artifact import Terms
from motionloom.pipeline.store.run_folder import STAGE_NAME

SHARDS = "shards"
REFERENCE = "reference.json"
READER = "reader.json"
MIX = "mix.json"


class Reference(Config):
    """`reference.json` of a data stage whose shards lie elsewhere."""

    path: str
    """Folder with `manifest.json`, or a URL (`s3://`, `hf://`, `https://`, `http://`)."""
    order: Literal["global", "streamed"]
    shards_per_group: int


class Reader(Config):
    """`reader.json` beside it: what the recipe says now about how to read, which changes no result."""

    cache: CacheConfig


class MixedStage(Config):
    """One data stage of a mix."""

    stage: str = Field(pattern=STAGE_NAME)
    """Its name, which is its folder beside that of the mix."""
    folder: str | None = None
    """Folder of a stage outside the run, seen from that of the mix."""
    weight: float = Field(gt=0)


class Mix(Config):
    """`mix.json` of a stage that mixes data stages of its own run, or of others."""

    parts: list[MixedStage] = Field(min_length=1)

    def folders(self, mix: Path) -> list[Path]:
        """The folders of the stages; `mix` is that of the mix."""
        return [mix.parent / part.stage if part.folder is None else mix / part.folder for part in self.parts]


@dataclass(frozen=True)
class DataPreview:
    """A data stage that has not run yet."""

    layout: MotionLayout


@dataclass(frozen=True)
class Data:
    """The splits of a data stage: its own shards, those that it points to, or a mix of other stages."""

    folder: Path

    @cached_property
    def layout(self) -> MotionLayout:
        return self.split(self.splits[0]).layout

    def split(self, name: str) -> ClipDataset:
        """One split."""
        if self._mixed:
            parts = [(data, weight) for data, weight in self._mixed if name in data.splits]
            opened = [(data.split(name), weight) for data, weight in parts]
            return opened[0][0] if len(opened) == 1 else MixedDataset(opened)
        if not (self.folder / REFERENCE).is_file():
            return ShardDataset.open(self.folder / SHARDS, name)
        reference, reader = self._elsewhere
        reading = Reading(
            order=reference.order, shards_per_group=reference.shards_per_group, cache=reader.cache
        )
        return ShardDataset.open(reference.path, name, reading=reading)

    def held_out(self, *, prefer: str = "val") -> ClipDataset:
        """A split for validation: the preferred one, else the other held-out one, else train."""
        splits = self.splits
        other = "test" if prefer == "val" else "val"
        return self.split(next(split for split in (prefer, other, "train") if split in splits))

    @property
    def splits(self) -> list[str]:
        """Splits that hold at least one clip, of any data set."""
        shards = [shard for _, manifest in self._sources() for shard in manifest.shards]
        filled = {shard.split for shard in shards if shard.samples}
        return [split for split in ("train", "val", "test") if split in filled]

    def clips(self, split: str) -> int:
        """Return the number of clips of a split, over all data sets; 0 of a kind that is not ours."""
        if not self._is_ours:
            return 0
        shards = [shard for _, manifest in self._sources() for shard in manifest.shards]
        return sum(shard.samples for shard in shards if shard.split == split)

    @property
    def _is_ours(self) -> bool:
        return any((self.folder / name).exists() for name in (SHARDS, REFERENCE, MIX))

    def local_shards(self) -> list[LocalShard]:
        """Shards in folders of this machine; a server's are compared on arrival. None of other kinds."""
        if not self._is_ours:
            return []
        return [
            LocalShard(store.root / shard.name, shard)
            for store, manifest in self._sources()
            if isinstance(store, LocalStore)
            for shard in manifest.tars
        ]

    def terms(self) -> Terms:
        """Licences and credits of its own shards; a mix has none but those of its stages."""
        manifests = [] if self._mixed or not self._is_ours else [one for _, one in self._sources()]
        return Terms.union(
            Terms(licences=tuple(one.licences or [one.licence]), credits=tuple(one.credits))
            for one in manifests
        )

    @cached_property
    def _mixed(self) -> list[tuple[Data, float]]:
        """The stages of a mix, and their weights."""
        if not (self.folder / MIX).is_file():
            return []
        mix = Mix.load_json(self.folder / MIX)
        pairs = zip(mix.folders(self.folder), mix.parts, strict=True)
        return [(Data(place), part.weight) for place, part in pairs]

    @property
    def _elsewhere(self) -> tuple[Reference, Reader]:
        return Reference.load_json(self.folder / REFERENCE), Reader.load_json(self.folder / READER)

    def _sources(self) -> list[tuple[Store, Manifest]]:
        if self._mixed:
            return [source for data, _ in self._mixed for source in data._sources()]
        if (self.folder / REFERENCE).is_file():
            reference, reader = self._elsewhere
            store = open_store(reference.path, reader.cache)
        else:
            store = open_store(self.folder / SHARDS)
        return [(store, read_manifest(store)[0])]


def captions_of(dataset: ClipDataset, index: int, *, face: bool) -> list[Caption]:
    """Body or face captions of a clip."""
    return dataset.face_texts(index) if face else dataset.texts(index)
