"""What an earlier conversion into the same folder means for the next one."""

from __future__ import annotations

from collections import Counter
from contextlib import suppress
from pathlib import Path

from motionloom.datasets.convert.common.plan import C, ConversionPlan
from motionloom.datasets.schema import SPLITS, Split, UserError
from motionloom.datasets.shards.index import load_index
from motionloom.datasets.shards.reader import load_manifest


def moved_clips(folder: Path, plan: ConversionPlan[C]) -> str:
    """Return how many clips of the finished set in a folder are in another split in the plan, by splits;
    empty where all stay.
    """
    before: dict[str, Split] = {}
    with suppress(UserError):  # none, or unfinished
        shards = load_manifest(folder).shards
        for split in SPLITS:
            index = load_index(folder, split, [shard for shard in shards if shard.split == split])
            before |= {index.id(clip): split for clip in range(len(index))}
    pairs = Counter(
        f"{before[clip.id]} -> {split}" for split, clip in plan.items if before.get(clip.id, split) != split
    )
    counts = ", ".join(f"{count:,} {pair}" for pair, count in sorted(pairs.items()))
    return f"{folder}: {pairs.total():,} clips move to another split: {counts}" if pairs else ""
