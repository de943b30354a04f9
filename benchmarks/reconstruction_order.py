"""Tokenizers at an equal training budget: H2VQ, RVQ, VQ, body and hands apart, FSQ (Tables 3 and 7).

    python benchmarks/reconstruction_order.py WORK [--shards FOLDER] [--seeds 3] [--steps 1600]
    python benchmarks/reconstruction_order.py WORK --features paper --steps 5000

Every tokenizer is trained by the same recipe on the same windows with the same widths, one run a seed, and
measured on the test split: MPJPE in mm of all joints and of the body from the root, of the fingers from their
wrists (docs/evaluation.md), our pose and the world positions with the path. `--features paper` trains on the
published features with the published loss: deviations averaged over each kind of column, squared error, no
velocity term, no gains. Shards without hands leave out tokenizers of body and hands. Killed and started again
it goes on where it was.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from bench import Column, arguments, command_line, kept, report, train

from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.synth.generate import SynthConfig, synthesize
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.stage import StageCache
from motionloom.pipeline.evaluation.reconstruction import reconstruction_errors
from motionloom.pipeline.evaluation.truth import truth_of

CODES = {"num_codes": 512, "decay": 0.9, "reset_below": 0.05}
NETS: dict[str, tuple[str, dict]] = {
    "VQ": ("vq", CODES),
    "RVQ, 2 levels": ("rvq", {**CODES, "levels": 2}),
    "RVQ, 3 levels": ("rvq", {**CODES, "levels": 3}),
    "apart": ("separate", CODES),
    "H2VQ": ("h2vq", CODES),
    "FSQ": ("fsq", {"steps": [8, 8, 8]}),
}
"""Title -> stage kind and what differs. RVQ with three levels spends exactly H2VQ's bits."""

COMMON = {
    "width": 96,
    "depth": 2,
    "code_dim": 96,
    "recon": "smooth_l1",
    "velocity_weight": 0.5,
    "root_gain": 5.0,
    "finger_gain": 4.0,
}
PAPER = {"recon": "l2", "velocity_weight": 0.0, "root_gain": 1.0, "finger_gain": 0.0}
COLUMNS = (
    Column("bit/s", "bits", 0),
    Column("MPJPE, mm", "mpjpe"),
    Column("body", "mpjpe_body"),
    Column("hands", "mpjpe_hand"),
    Column("pose", "pose"),
    Column("world", "world"),
)
TRIVIAL = {"nearest training clip": "_nearest_train_clip", "mean pose": "_mean_pose"}

HANDED = ("h2vq", "separate")
"""Stage kinds that need hands."""


def stages(kind: str, net: dict[str, Any], args: argparse.Namespace) -> dict[str, Any]:
    """One tokenizer; data, statistics and windows are the same for all."""
    return {
        "data": {"kind": "shards", "path": str(args.shards.resolve()), "verify": False},
        "stats": {"kind": "stats", "group": args.features == "paper"},
        "tokenizer": {
            "kind": kind,
            "net": {**COMMON, **net, **(PAPER if args.features == "paper" else {})},
            "optim": {"lr": 2.0e-3, "warmup_steps": 30, "schedule": "cosine"},
            "train": {"steps": args.steps, "batch_size": 16, "checkpoint_every": 200, "validate_every": 0},
        },
    }


def measure(run: Path, clips: int) -> dict[str, float]:
    """Figures of one finished run."""
    finished, cache = finished_stages(run), StageCache()
    tokenizer, data = cache.get(finished["tokenizer"]), cache.get(finished["data"])
    test = data.split("test")
    truths = [truth_of(test, i) for i in range(min(clips, len(test)))]
    figures = reconstruction_errors(tokenizer, data.split("train"), truths)
    return {**figures, "bits": tokenizer.net.bits_per_second}


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("--shards", type=Path, help="whole-body shards; default: synthetic clips")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=1600)
    parser.add_argument("--features", choices=("ours", "paper"), default="ours")
    parser.add_argument("--nets", nargs="*", choices=list(NETS), default=list(NETS))
    parser.add_argument("--made", type=int, default=2000, help="synthetic clips to make")
    parser.add_argument("--clips", type=int, default=100, help="test clips at most")
    args = arguments(parser)
    if args.shards is None:
        args.shards = args.work / "shards"
        fields = {"clips": args.made, "fps": 20, "min_seconds": 2.0, "max_seconds": 5.0, "seed": 7}
        synthesize(SynthConfig.parse(fields, "synthetic clips"), args.shards, workers=2)
    handed = ShardDataset.open(args.shards, "train").layout.has_part("hand")
    results: dict[str, list[dict[str, float]]] = {}
    for seed in range(args.seeds):
        for title in args.nets:
            kind, net = NETS[title]
            if not handed and kind in HANDED:
                continue
            net = net if handed else {**net, "part": "body", "finger_gain": 0.0}
            folder = args.work / args.features / f"{title.replace(' ', '-').replace(',', '')}-{seed}"
            run = train(folder, stages(kind, net, args), seed=seed)
            row = kept(run / "figures.json", lambda run=run: measure(run, args.clips))
            results.setdefault(title, []).append(row)
    figures = [column.figure for column in COLUMNS]
    cells = {t: {f: [row[f] for row in rows if f in row] for f in figures} for t, rows in results.items()}
    first = next(iter(results.values()))[0]
    cells |= {t: {f: [first[f + end]] for f in figures if f + end in first} for t, end in TRIVIAL.items()}
    rows = [
        {"title": title, "cells": {figure: values for figure, values in found.items() if values}}
        for title, found in cells.items()
    ]
    report(f"Tokenizers, {args.steps} steps, {args.features} features", COLUMNS, rows, args.record)


if __name__ == "__main__":
    main()
