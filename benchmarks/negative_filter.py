"""Does TMA's negative filter help where captions repeat (HumanTOMATO 3.5, D)?

    python benchmarks/negative_filter.py CLIPS WORK

CLIPS holds real captioned clips (BVH files, `captions.jsonl`, `joint_map.json`), each with several captions
of which many are shared. One TMA with and one without the filter for every seed, 600 steps of 64. Killed and
started again it goes on where it was. Judged on test clips: recall under protocols A and B, and the share of
captions with a side ("left", "right") that lie nearer to their clip than the same caption with the other
side, whose sentence embedding the filter takes for the same.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import torch
import torch.nn.functional as F
from bench import SEEDS, Column, arguments, command_line, kept, report, train

from motionloom.pipeline.contract.stage import StageCache
from motionloom.pipeline.evaluation.figures import MODEL
from motionloom.pipeline.evaluation.judges import Judge
from motionloom.pipeline.evaluation.retrieval import alignment_stage, retrieve
from motionloom.pipeline.evaluation.truth import truth_of

ARMS = {"no filter": None, "0.85 (the paper)": 0.85}
"""Captions with a higher sentence cosine are not negatives of each other."""
OTHER = {"left": "right", "right": "left"}
FIGURES = ("A.t2m/R@1", "A.m2t/R@1", "B.t2m/R@1", "B.m2t/R@1", "B.t2m/R@3")
COLUMNS = [Column(figure.replace("/", " ").replace(".", ", ") + ", %", figure, 1, 100) for figure in FIGURES]


def sides_told_apart(run: Path, stage: str) -> float:
    """Return the share of test captions with a side that are nearer to their clip than the other side is."""
    source = alignment_stage(run, stage)
    cache = StageCache("cpu")
    dataset = cache.get(source.inputs["data"]).split("test")
    truths = [truth_of(dataset, i) for i in range(len(dataset))]
    truths = [t for t in truths if re.search(r"\b(left|right)\b", t.caption)]
    swapped = [
        replace(t, caption=re.sub(r"\b(left|right)\b", lambda m: OTHER[m[0]], t.caption)) for t in truths
    ]
    judge = Judge(cache.get(source))
    motion = judge.recorded(truths)
    own, other = (F.cosine_similarity(judge.texts(rows), motion) for rows in (truths, swapped))
    return float((own > other).double().mean())


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("clips", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS))
    args = arguments(parser)
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
        every = {"steps": 600, "batch_size": 64, "seed": seed, "checkpoint_every": 200, "validate_every": 600}
        stages[name] = tma | {"loss": {"threshold": ARMS[title]}, "train": every}
    run = train(args.work / "run", stages, seed=7)
    rows = []
    for title in ARMS:
        cells: dict[str, list[float]] = {figure: [] for figure in (*FIGURES, "sides")}
        for seed in args.seeds:
            name = arms[title, seed]
            found = kept(args.work / f"{name}.json", lambda name=name: measured(run, name))
            for figure, values in cells.items():
                values.append(found[figure])
        rows.append({"title": title, "cells": cells, "seeds": args.seeds})
    both = [row["cells"] for row in rows]
    apart = {
        figure: [b - a for a, b in zip(*(cells[figure] for cells in both), strict=True)] for figure in FIGURES
    }
    rows.append({"title": "with the filter less without it, by seed", "cells": apart, "seeds": args.seeds})
    sides = Column("sides told apart, % (chance 50)", "sides", 1, 100)
    report("TMA's negative filter on real clips", [*COLUMNS, sides], rows, args.record)


def measured(run: Path, stage: str) -> dict[str, float]:
    """The figures of one TMA on the test split."""
    with torch.no_grad():
        sides = sides_told_apart(run, stage)
    found = retrieve(run, stage, split="test")
    values = {figure.name: figure.value for figure in found.figures if figure.row == MODEL}
    return {name: values[name] for name in FIGURES} | {"sides": sides}


if __name__ == "__main__":
    main()
