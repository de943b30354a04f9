"""Does TMA's negative filter help where captions repeat (HumanTOMATO 3.5, D)?

    python benchmarks/negative_filter.py CLIPS WORK

CLIPS holds real captioned clips (BVH files, `captions.jsonl`, `joint_map.json`), each with several captions
of which many are shared. One TMA for every threshold and seed, in `--steps` of 64 clips. Killed and started
again it goes on where it was. Judged on test clips: recall under protocols A and B.
"""

from __future__ import annotations

from pathlib import Path

from bench import SEEDS, Column, arguments, command_line, kept, report, train

from motionloom.pipeline.evaluation.figures import MODEL
from motionloom.pipeline.evaluation.retrieval import retrieve

ARMS = {"no filter": None, "exact duplicates": 0.999, "0.95": 0.95, "0.85 (paper)": 0.85}
"""Captions with a higher sentence cosine are not negatives of each other; equal ones have 1, rounded."""
BATCH = 64
FIGURES = ("A.t2m/R@1", "A.m2t/R@1", "B.t2m/R@1", "B.m2t/R@1")
COLUMNS = [Column(figure.replace("/", " ").replace(".", ", ") + ", %", figure, 1, 100) for figure in FIGURES]


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("clips", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS))
    parser.add_argument("--steps", type=int, default=600)
    args = arguments(parser)
    protocol = {"split": "test", "steps": args.steps, "batch": BATCH}
    clips = args.clips.resolve()
    tma = {
        "kind": "tma",
        "net": {"latent": 128, "ff": 384, "layers": 2, "heads": 4, "attention_dropout": 0.0,
                "frame_stride": 4},
        "optim": {"lr": 4.0e-4, "warmup_steps": 100, "schedule": "cosine"},
    }  # fmt: skip
    stages = {
        "data": {
            "kind": "bvh", "source": str(clips), "joint_map": str(clips / "joint_map.json"), "fps": 20,
            "captions": str(clips / "captions.jsonl"), "licence": "CC-BY-NC-4.0",
        },
        "stats": {"kind": "stats"},
        "text": {"kind": "text"},
    }  # fmt: skip
    arms = {(title, seed): f"tma{n}_{seed}" for n, title in enumerate(ARMS) for seed in args.seeds}
    for (title, seed), name in arms.items():
        every = {"seed": seed, "checkpoint_every": 100, "validate_every": args.steps}
        every |= {"steps": args.steps, "batch_size": BATCH}
        stages[name] = tma | {"loss": {"threshold": ARMS[title]}, "train": every}
    run = train(args.work / "run", stages, seed=7)
    rows = []
    for title in ARMS:
        cells: dict[str, list[float]] = {figure: [] for figure in FIGURES}
        for seed in args.seeds:
            name = arms[title, seed]
            found = kept(args.work / f"{name}.json", lambda name=name: measured(run, name))
            for figure, values in cells.items():
                values.append(found[figure])
        rows.append({"title": title, "cells": cells, "seeds": args.seeds, "protocol": protocol})
    none, *filtered = rows
    for row in filtered:
        row["title"] = f"{row['title']}, less no filter"
        row["cells"] = {
            figure: [b - a for a, b in zip(none["cells"][figure], values, strict=True)]
            for figure, values in row["cells"].items()
        }
    report("TMA's negative filter on real clips", COLUMNS, rows, args.record)


def measured(run: Path, stage: str) -> dict[str, float]:
    """The figures of one TMA on the test split."""
    found = retrieve(run, stage, split="test")
    values = {figure.name: figure.value for figure in found.figures if figure.row == MODEL}
    return {name: values[name] for name in FIGURES}


if __name__ == "__main__":
    main()
