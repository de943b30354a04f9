"""Does L_align help (HumanTOMATO 3.6)? One GPT, and three ways to go on from it for as many steps.

    motionloom run humantomato-synthetic --until data --set data.wordings=few
    python benchmarks/alignment.py runs/humantomato-synthetic/stages/data WORK

Tokenizer, statistics and TMA are those of the package's model `synthetic`. A GPT of its size is trained on
tokens alone, then trained on for every seed: on the tokens, with L_align on what is predicted after the true
tokens (the paper's), and on samples. Killed and started again it goes on where it was.

One motion is drawn for the caption of each validation clip, with the same seeds for all trainings, and judged
on its joints (`motionloom.datasets.actions.measure`), which no network saw: `every` is the share of right
attributes, `whole` that of motions with all right. TMA's recall is beside it, although L_align trains with
TMA. Differences are paired, with two intervals of 95 %: captions and seeds drawn anew together (bootstrap),
which is narrow for three seeds, and Student's t over the seeds, which knows nothing of other captions.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from bench import Column, Record, arguments, command_line, kept, report, train
from numpy.typing import NDArray

from motionloom.datasets.actions.measure import agrees
from motionloom.datasets.motion.canonical import canonicalize
from motionloom.datasets.motion.features.codec import encode
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import StageCache
from motionloom.pipeline.evaluation.estimate import estimate
from motionloom.pipeline.evaluation.judges import Judge
from motionloom.pipeline.evaluation.latent_metrics import LatentRow, recalls
from motionloom.pipeline.evaluation.reference_baselines import by_nearest_caption, by_nearest_labels
from motionloom.pipeline.evaluation.truth import perform, truth_of
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.store.evaluator import embed_motions

Joints = NDArray[np.float64]
Counts = NDArray[np.float64]
"""Right attributes, attributes and whether all are right, [..., clips, 3]."""

ARMS: dict[str, dict[str, Any]] = {
    "tokens": {"align_weight": 0.0},
    "predictions": {"align_weight": 0.1, "threshold": None},
    "samples": {"align_on": "samples", "align_weight": 2.0, "threshold": None},
}
SAMPLING = SamplingConfig(top_p=1.0)
SEEDS, BATCH, CLIPS, SIZE, DRAWS = (1, 2, 3), 16, 600, 32, 10_000
"""Seeds of the continuations; clips of a step; judged clips; candidates of TMA's recall; bootstrap draws."""
COLUMNS = (
    Column("every, %", "every"),
    Column("less `tokens`", "every_gain"),
    Column("whole, %", "whole"),
    Column("less `tokens`", "whole_gain"),
    Column(f"TMA R@1 among {SIZE}, %", "tma", 1, 100),
)


def stages_of(data: str, base: int, more: int) -> dict[str, Any]:
    """Tokens, the GPT that all go on from, and each arm for each seed; the rest is the model's own."""

    def gpt(lr: float, warmup: int, steps: int, seed: int, loss: object, **start: str) -> dict[str, Any]:
        net = {"layers": 4, "dim": 192, "heads": 6, "ff": 768, "dropout": 0.1, "attention_dropout": 0.0}
        optim = {"lr": lr, "warmup_steps": warmup, "schedule": "cosine", "weight_decay": 0.01}
        every = {"checkpoint_every": 250, "validate_every": steps}
        length = {"steps": steps, "batch_size": BATCH, "seed": seed, **every}
        own = {"net": net, "loss": loss, "optim": optim, "train": length}
        return {"kind": "gpt", "inputs": {"data": data, **start}, **own}

    stages = {kind: {"kind": kind, "inputs": {"data": data}} for kind in ("text", "tokens")}
    stages["base"] = gpt(1.0e-3, 200, base, 7, ARMS["tokens"])
    for seed in SEEDS:
        for arm, loss in ARMS.items():
            stages[f"{arm}_{seed}"] = gpt(2.0e-4, 50, more, seed, loss, start="base")
    return stages


def figures(counts: Counts) -> NDArray[np.float64]:
    """`every` and `whole`, in percent."""
    right, asked, whole = counts.reshape(-1, 3).mean(0)
    return 100 * np.array([right / asked, whole])


def gains(arm: Counts, tokens: Counts) -> list[str]:
    """Differences of both figures with their intervals; counts have seeds first."""
    rng = np.random.default_rng(0)
    (seeds, clips) = arm.shape[:2]
    drawn = []
    for _ in range(DRAWS):
        some = np.ix_(rng.integers(seeds, size=seeds), rng.integers(clips, size=clips))
        drawn.append(figures(arm[some]) - figures(tokens[some]))
    ends = np.percentile(drawn, [2.5, 97.5], axis=0)
    each = np.transpose([figures(a) - figures(b) for a, b in zip(arm, tokens, strict=True)])
    halves = [estimate(differences).interval for differences in each]
    rows = zip(figures(arm) - figures(tokens), *ends, halves, strict=True)
    return [f"{found:+.1f} ({low:+.1f} to {high:+.1f}; ± {half:.1f})" for found, low, high, half in rows]


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("data", type=Path, help="folder of the stage of clips")
    parser.add_argument("work", type=Path)
    parser.add_argument("--base", type=int, default=12_000, help="steps of the GPT that all go on from")
    parser.add_argument("--more", type=int, default=1_500, help="steps of each continuation")
    args = arguments(parser)
    stages = stages_of(str(args.data.resolve()), args.base, args.more)
    finished = finished_stages(train(args.work / "run", stages, seed=7, start="synthetic"))
    cache = StageCache()
    inputs = finished["base"].inputs
    data = cache.get(inputs["data"])
    judge = Judge(cache.get(inputs["tma"]))
    dataset = data.split("val")
    chosen = np.random.default_rng(0).permutation(len(dataset))[:CLIPS]
    truths = [truth_of(dataset, index) for index in chosen.tolist()]
    text = judge.texts(truths)

    def judged(motions: Sequence[Joints]) -> dict[str, Any]:
        """Return what a motion for each clip has right, and TMA's recall."""
        layout = judge.motions.layout
        columns = layout.part(judge.motions.part)
        latent = embed_motions(judge.motions, [encode(canonicalize(j), layout)[:, columns] for j in motions])
        hits = [recalls(LatentRow(text, latent, latent, seed, SIZE))["t2m_r1"] for seed in range(10)]
        found = [
            [*agrees(truth.truth or {}, joints, None, data.layout.fps).values()]
            for truth, joints in zip(truths, motions, strict=True)
        ]
        return {"counts": [[sum(one), len(one), int(all(one))] for one in found], "tma": float(np.mean(hits))}

    def made(stage: str) -> dict[str, Any]:
        motions = perform(Bundle([finished[stage]], cache), truths, seed=0, sampling=SAMPLING)
        return judged([motion.joints for motion in motions])

    def row(title: str, found: Sequence[dict[str, Any]], **more: Any) -> Record:
        every, whole = np.transpose([figures(np.array(one["counts"], float)) for one in found]).tolist()
        cells = {"every": every, "whole": whole, "tma": [one["tma"] for one in found]}
        return {"title": title, "cells": cells, **more}

    steps = f"{args.base:,} and {args.more:,} more"
    facts = {"split": "val", "clips": len(truths), "batch": BATCH, "steps": steps}
    rows = []
    counts = {}
    for arm in ARMS:
        names = [f"{arm}_{seed}" for seed in SEEDS]
        found = [kept(args.work / f"{name}.json", partial(made, name)) for name in names]
        counts[arm] = np.array([one["counts"] for one in found], float)
        rows.append(row(arm, found, seeds=list(SEEDS), protocol=facts))
        if arm != "tokens":
            both = gains(counts[arm], counts["tokens"])
            rows[-1]["cells"] |= {"every_gain": both[0], "whole_gain": both[1]}
    rows.append(row("recorded", [judged([truth.joints for truth in truths])]))
    for by, look_up in {"labels": by_nearest_labels, "caption": by_nearest_caption}.items():
        near = kept(
            args.work / f"nearest_{by}.json",
            lambda look_up=look_up: judged([one.joints for one in look_up(data.split("train"), truths)]),
        )
        rows.append(row(f"nearest training {by}", [near]))
    report("L_align", COLUMNS, rows, args.record)


if __name__ == "__main__":
    main()
