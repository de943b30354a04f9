"""Training windows a second: our shard loader against array indexing, per-sample loading and WebDataset.

Every contestant delivers batches of 256 windows of 64 frames x 263 columns. They run in turn in each round,
and the medians over rounds are compared, so a busy machine slows all of them alike. Run: `python
benchmarks/loader.py`.
"""

from __future__ import annotations

import argparse
import io
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from motionloom.datasets.loading.batches import WindowBatches
from motionloom.datasets.loading.statistics import FeatureStats, compute
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import Split
from motionloom.datasets.shards.options import DatasetFacts, WriteOptions
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.shards.sample import Sample
from motionloom.datasets.shards.writer import write_dataset

LAYOUT = MotionLayout.named("h3d263")
WINDOW, BATCH = 64, 256


@dataclass(frozen=True)
class Noise:
    """Clip i: 64 to 196 frames of noise."""

    def __call__(self, i: int) -> Sample:
        rng = np.random.default_rng(i)
        frames = int(rng.integers(WINDOW, 197))
        motion = rng.standard_normal((frames, LAYOUT.dim), dtype=np.float32)
        meta = LAYOUT.clip_meta(str(i), source="noise", split="train", frames=frames, licence="CC0")
        return Sample(meta, motion)


def shard_windows(dataset: ShardDataset, stats: FeatureStats, per_clip: int, steps: int) -> int:
    """Ours: normalised batches from the tar files."""
    batches = WindowBatches(dataset, stats, window=WINDOW, batch_size=BATCH, windows_per_clip=per_clip)
    return sum(len(batches[k]["motion"]) for k in range(steps))


def array_indexing(
    flat: np.ndarray, first: np.ndarray, frames: np.ndarray, steps: int, stats: FeatureStats | None = None
) -> int:
    """The floor: all clips in one array in memory, one gather a batch; normalised only when given `stats`."""
    rng = np.random.default_rng(0)
    inside = np.arange(WINDOW)
    done = 0
    for _ in range(steps):
        clips = rng.integers(0, len(first), BATCH)
        starts = first[clips] + (rng.random(BATCH) * (frames[clips] - WINDOW + 1)).astype(np.int64)
        batch = flat[starts[:, None] + inside]
        if stats is not None:
            batch -= stats.mean
            batch /= stats.std
        done += len(torch.from_numpy(batch))
    return done


class OneWindow(Dataset[torch.Tensor]):
    """The usual way: a list of clips in memory, one normalised window an item."""

    def __init__(self, clips: list[np.ndarray], stats: FeatureStats) -> None:
        self.clips, self.stats = clips, stats

    def __len__(self) -> int:
        return len(self.clips)

    def __getitem__(self, i: int) -> np.ndarray:
        start = np.random.randint(0, len(self.clips[i]) - WINDOW + 1)
        return (self.clips[i][start : start + WINDOW] - self.stats.mean) / self.stats.std


def per_sample(clips: list[np.ndarray], stats: FeatureStats, steps: int) -> int:
    """A loader that collates single windows."""
    done = 0
    while done < steps * BATCH:
        for batch in DataLoader(OneWindow(clips, stats), batch_size=BATCH, shuffle=True, drop_last=True):
            done += len(batch)
            if done >= steps * BATCH:
                break
    return done


def webdataset_windows(names: list[str], stats: FeatureStats, steps: int) -> int:
    """WebDataset reading the same tars in sequence, one window a clip."""
    import webdataset

    def windows() -> Iterator[np.ndarray]:
        source = webdataset.WebDataset(names, shardshuffle=False, empty_check=False)
        for sample in source:
            motion = np.load(io.BytesIO(sample["motion.npy"]), allow_pickle=False)
            start = np.random.randint(0, len(motion) - WINDOW + 1)
            yield (motion[start : start + WINDOW] - stats.mean) / stats.std

    done, part = 0, []
    while done < steps * BATCH:
        for window in windows():
            part.append(window)
            if len(part) == BATCH:
                done += len(torch.from_numpy(np.stack(part)))
                part = []
            if done >= steps * BATCH:
                break
    return done


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clips", type=int, default=2048)
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--rounds", type=int, default=7)
    told = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        items: list[tuple[Split, int]] = [("train", i) for i in range(told.clips)]
        write_dataset(
            root,
            items,
            Noise(),
            DatasetFacts("noise", LAYOUT, "CC0", converter="noise", converter_version=1, options={}),
            WriteOptions(workers=os.cpu_count() or 1),
        )
        dataset = ShardDataset.open(root, "train")
        stats = compute(dataset)
        clips = [dataset.motion(i).copy() for i in range(len(dataset))]
        flat = np.concatenate(clips)
        first = np.cumsum(dataset.frames) - dataset.frames
        names = [str(root / shard.name) for shard in dataset.manifest.shards]
        few = max(1, told.steps // 8)
        contestants: dict[str, tuple[Callable[[int], int], int]] = {
            "array indexing in memory (floor)": (
                lambda n: array_indexing(flat, first, dataset.frames, n),
                told.steps,
            ),
            "the same, normalised": (
                lambda n: array_indexing(flat, first, dataset.frames, n, stats),
                told.steps,
            ),
            "ours, shards, 1 window a clip": (lambda n: shard_windows(dataset, stats, 1, n), told.steps),
            "ours, shards, 4 windows a clip": (lambda n: shard_windows(dataset, stats, 4, n), told.steps),
            "per-sample loader in memory": (lambda n: per_sample(clips, stats, n), told.steps),
            "webdataset, 1 window a clip": (lambda n: webdataset_windows(names, stats, n), few),
        }
        rates: dict[str, list[float]] = {name: [] for name in contestants}
        for turn in range(told.rounds + 1):
            for name, (run, steps) in contestants.items():
                start = time.perf_counter()
                done = run(steps)
                if turn:  # the first round only warms caches
                    rates[name].append(done / (time.perf_counter() - start))
        floor = statistics.median(next(iter(rates.values())))
        print(f"{told.clips} clips, {flat.nbytes / 2**20:.0f} MiB; windows of {WINDOW} x {LAYOUT.dim}")
        for name, values in rates.items():
            rate = statistics.median(values)
            print(f"{name:34} {rate:10.0f} windows/s   {rate / floor:5.2f} x floor")


if __name__ == "__main__":
    main()
