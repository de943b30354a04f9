"""Opening what earlier stages made: shards, statistics, text cache."""

from __future__ import annotations

import json
from pathlib import Path

from motionloom.datasets.schema import Caption, Manifest
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.shards.statistics import FeatureStats
from motionloom.datasets.text.cache import TextCache

SHARDS = "shards"
REFERENCE = "reference.json"


def shards_of(folder: Path) -> Path:
    """The shard folder behind a data stage."""
    reference = folder / REFERENCE
    if reference.is_file():
        return Path(json.loads(reference.read_text())["path"])
    return folder / SHARDS


def splits_of(folder: Path) -> list[str]:
    """Splits that hold at least one clip."""
    manifest = Manifest.load_json(shards_of(folder) / "manifest.json")
    held = {shard.split for shard in manifest.shards if shard.samples}
    return [split for split in ("train", "val", "test") if split in held]


def open_split(folder: Path, split: str) -> ShardDataset:
    """One split of a data stage."""
    return ShardDataset.open(shards_of(folder), split)


def held_out(folder: Path, *, prefer: str = "val") -> str:
    """A split for validation: the preferred one, else the other held-out one, else train."""
    splits = splits_of(folder)
    other = "test" if prefer == "val" else "val"
    return next(split for split in (prefer, other, "train") if split in splits)


def open_stats(folder: Path) -> FeatureStats:
    """Statistics of a stats stage."""
    return FeatureStats.load(folder / "stats.safetensors")


def open_text(folder: Path) -> TextCache:
    """Cache of a text stage."""
    return TextCache.open(folder / "cache")


def captions_of(dataset: ShardDataset, index: int, *, face: bool) -> list[Caption]:
    """Body or face captions of a clip."""
    return dataset.face_texts(index) if face else dataset.texts(index)
