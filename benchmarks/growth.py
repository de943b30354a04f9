"""How cost grows with the data set: counts, bytes and CPU time at 1 k to 1 M clips, and each row's exponent.

    python benchmarks/growth.py WORK --record growth

Sets above 4,096 clips are made of hard links of one of that size, under an index that repeats its rows: they
open and load as any other set does. Row by row `clips ** exponent` fits best.
"""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from bench import Column, arguments, command_line, report

from motionloom.datasets.base.records import INDEX_FILE, MANIFEST_FILE, Caption
from motionloom.datasets.loading.batches import WindowBatches
from motionloom.datasets.loading.plan import BatchPlan, Share
from motionloom.datasets.loading.shared import SharedBatches
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.loading.steps import Steps
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards import reader
from motionloom.datasets.shards.index import SplitIndex, load_index, save_index
from motionloom.datasets.shards.options import DatasetFacts, Reading, WriteOptions
from motionloom.datasets.shards.reader import ShardDataset, load_manifest
from motionloom.datasets.shards.sample import Sample
from motionloom.datasets.shards.writer import write_dataset
from motionloom.models.metrics.retrieval import accuracy_among, other_texts, recall

SIZES = (1_000, 10_000, 100_000, 1_000_000)
LAYOUT = MotionLayout.named("body133")
LINKED = 4_096
"""Clips of the set that larger ones link to."""
SHARD = 256
BATCH = 256
JUDGED = 12_000
"""Test clips of Motion-X: evaluations of more are not asked for."""
Figures = dict[str, float]

MOST = {
    "index.npz and manifest.json, bytes a clip": 170,
    "sent to a loader worker, bytes a clip": 12,
    "system calls a window of an open shard": 1,
    "of a window of another shard": 3,
    "opens a shard in four steps": 1,
    "of the set that each of two nodes reads, times a half": 1.1,
    "shards of a node before its first step": 5,
}
"""The counts, and what they may be at any size: a test holds this."""


def clip(number: int) -> Sample:
    """Noise of 20 to 40 frames, two captions."""
    frames = 20 + number % 21
    motion = np.random.default_rng(number).standard_normal((frames, LAYOUT.dim)).astype(np.float32)
    meta = LAYOUT.clip_meta(f"clip-{number:07d}", source="made", split="train", frames=frames, licence="CC0")
    return Sample(meta, motion, texts=[Caption(text=f"{verb} {number}") for verb in ("walk", "turn")])


def made(folder: Path, clips: int) -> Path:
    """A data set of so many clips, in whole shards above `LINKED`; made once."""
    root = folder / str(clips)
    if (root / MANIFEST_FILE).exists():
        return root
    if clips <= LINKED:
        facts = DatasetFacts(
            "made", LAYOUT, licence="CC0", converter="growth", converter_version=1, options={}
        )
        write_dataset(
            root, [("train", n) for n in range(clips)], clip, facts,
            WriteOptions(clips_per_shard=SHARD, progress=False), describe=str,
        )  # fmt: skip
        return root
    base = made(folder, LINKED)
    manifest = json.loads((base / MANIFEST_FILE).read_bytes())
    times = -(-clips // LINKED)
    root.mkdir(parents=True)
    shards = []
    for shard in manifest["shards"] * times:
        shards.append({**shard, "name": f"made-train-{len(shards):06d}.tar"})
        os.link(base / shard["name"], root / shards[-1]["name"])
    one = load_index(base, "train", load_manifest(base).shards)
    columns = {name: np.concatenate([values] * times) for name, values in vars(one).items()}
    columns["id_ends"] = (one.id_ends + np.arange(times)[:, None] * one.id_ends[-1]).ravel()
    save_index(root, {"train": SplitIndex(**columns)})
    (root / MANIFEST_FILE).write_text(json.dumps({**manifest, "shards": shards}))
    return root


@contextmanager
def counted() -> Iterator[dict[str, int]]:
    """How often files are opened, read and closed by number."""
    calls = dict.fromkeys(("open", "pread", "close"), 0)

    def counting(name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(*given: Any) -> Any:
            calls[name] += 1
            return real(*given)

        return call

    with mock.patch.multiple(os, **{name: counting(name, getattr(os, name)) for name in calls}):
        yield calls


def batches_of(root: Path, **reading: Any) -> WindowBatches:
    dataset = ShardDataset.open(root, "train", reading=Reading(**reading))
    zero = np.zeros(LAYOUT.dim, dtype=np.float32)
    batches = WindowBatches(dataset, FeatureStats(zero, zero + 1, LAYOUT), window=16, batch_size=BATCH)
    batches.crops._kept = None  # as a worker reads: anew
    return batches


def counts(root: Path) -> Figures:
    """What does not depend on the machine."""
    batches = batches_of(root)
    clips = len(batches.dataset)
    stored = sum((root / name).stat().st_size for name in (INDEX_FILE, MANIFEST_FILE))
    sent = len(pickle.dumps(SharedBatches(Steps(lambda *_: batches, 1), 0)))
    steps = [batches.plan.batch(k)[1] for k in range(4)]
    with counted() as calls:
        for clip in np.concatenate(steps).tolist():
            batches.dataset.motion(clip, 0, 16)
    with mock.patch.object(reader, "open_shards", lambda: 1):
        alone = batches_of(root).dataset
        alone.motion(0)
        with counted() as anew:
            alone.motion(len(alone) - 1)
    per_shard = np.asarray([shard.samples for shard in load_manifest(root).shards])
    shard_of = np.repeat(np.arange(len(per_shard)), per_shard)
    streamed = batches_of(root, order="streamed").plan
    node = [shard_of[streamed.local(k, Share(0, 2))[1]] for k in range(streamed.batches_per_epoch)]
    found = (
        stored / clips,
        sent / clips,
        calls["pread"] / (4 * BATCH),
        sum(anew.values()),
        calls["open"] / len(np.unique(shard_of[np.concatenate(steps)])),
        2 * len(np.unique(np.concatenate(node))) / len(per_shard),
        len(np.unique(node[0])),
    )
    return dict(zip(MOST, found, strict=True))


_WORKER = """
import pathlib, pickle, sys, time
import torch
def own():
    return int(next(r for r in open("/proc/self/smaps_rollup") if r.startswith("Anonymous")).split()[1]) / 1e3
before = own()
batches = iter(pickle.loads(pathlib.Path(sys.argv[1]).read_bytes()))
next(batches)
print(time.process_time(), own() - before)
"""


def times(root: Path, work: Path) -> Figures:
    """CPU seconds and memory, of this machine."""
    began = time.process_time()
    batches = batches_of(root)
    opened = time.process_time() - began
    began = time.process_time()
    BatchPlan(len(batches.dataset), BATCH, seed=1).batch(0)
    ordered = time.process_time() - began
    batches[0]
    began = time.process_time()
    for k in range(1, 41):
        batches[k]
    step = (time.process_time() - began) / 40
    (work / "sent").write_bytes(pickle.dumps(SharedBatches(Steps(lambda *_: batches, 1), 0)))
    command = [sys.executable, "-P", "-c", _WORKER, str(work / "sent")]
    worker = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    return {
        "open a split, CPU ms": 1e3 * opened,
        "order of an epoch, CPU ms": 1e3 * ordered,
        "a step of 256 windows, CPU ms": 1e3 * step,
        "a loader worker's first batch, CPU s": float(worker[0]),
        "its own memory beside torch's, MB": float(worker[1]),
    }


def judged(clips: int) -> Figures:
    """CPU seconds of evaluations in which every clip is compared with all."""
    if clips > JUDGED:
        return {}
    draw = torch.Generator().manual_seed(0)
    text = torch.randn(clips, 256, generator=draw)
    motion = text + torch.randn(clips, 256, generator=draw)
    alone = torch.arange(clips)
    calls: dict[str, Callable[[], object]] = {
        "recall in the whole split, CPU s": lambda: recall(text, motion),
        "accuracy among 61, CPU s": lambda: accuracy_among(motion, text, other_texts(alone, 60)),
    }
    found = {}
    for name, call in calls.items():
        began = time.process_time()
        call()
        found[name] = time.process_time() - began
    return found


def exponent(sizes: list[int], values: list[float]) -> float:
    """The power of the number of clips that fits best."""
    return float(np.polyfit(np.log(sizes), np.log(np.maximum(values, 1e-9)), 1)[0])


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("--sizes", type=int, nargs="+", default=list(SIZES))
    args = arguments(parser)
    table: dict[str, dict[int, float]] = {}
    for size in args.sizes:
        root = made(args.work, size)
        for name, value in (counts(root) | times(root, args.work) | judged(size)).items():
            table.setdefault(name, {})[size] = value
    rows = []
    for name, values in table.items():
        cells = {str(size): f"{value:.3g}" for size, value in values.items()}
        if len(values) > 1:
            cells["exponent"] = f"{exponent(list(values), list(values.values())):.1f}".replace("-0.0", "0.0")
        rows.append({"title": name, "cells": cells})
    columns = [Column(f"{size:,}", str(size)) for size in args.sizes]
    report("Growth", [*columns, Column("exponent", "exponent")], rows, args.record)


if __name__ == "__main__":
    main()
