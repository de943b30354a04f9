"""UDE's own ingredients at a size where they can work, each beside what this program does instead.

    python benchmarks/ude_ingredients.py CLIPS WORK
    python benchmarks/ude_ingredients.py CLIPS WORK --adversarial --record ude_adversarial

CLIPS holds real captioned clips (BVH archives, `captions.jsonl`, `joint_map.json`); synthetic dances are
made. One recipe of the stages in `ude_ingredients.yaml` is written into WORK and run there: data, judge, then
an arm of every question for every seed. Killed and started again it goes on where it was; `--seeds` and
`--until` take a part. Its figures are those of its stages' `metrics.json` (`benchmarks/results.py`).

- codebook: learnt by gradient from the paper's start, from data, and by moving averages;
- decoder: DMD (160 wide, 133 columns) that predicts the noise and the motion; the tokenizer's own;
- GPT and GRU; z and none, with the likeliest tokens.

`--adversarial` asks the question of L_adv in a run of its own, on the captioned clips alone: its weights from
the first step on, likeliest and drawn tokens, by figures and by geometry. What has finished is printed.
`--decoders` asks what DMD predicts once more, at the paper's size: recorded test clips are decoded from their
own tokens.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from bench import HERE, Column, arguments, command_line, kept, report, train
from caption_check import CAPTIONS, obeyed
from numpy.typing import NDArray
from results import logged

from motionloom.datasets.motion.features.joints import joints_of
from motionloom.models.diffusion.sampling import decode_motions
from motionloom.models.diffusion.schedule import Sampler
from motionloom.models.layers.seeds import sample_seeds
from motionloom.models.metrics.reconstruction import mpjpe
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import CompletedStage, StageCache
from motionloom.pipeline.evaluation.figures import FILE_NAME, MODEL, NEAREST_WORDS, RECORDED, FigureFile
from motionloom.pipeline.evaluation.movement import all_features, distances
from motionloom.pipeline.evaluation.reference_baselines import NearestClip
from motionloom.pipeline.evaluation.truth import Truth, truth_at
from motionloom.pipeline.inference.bundle import Bundle

Joints = NDArray[np.float64]
QUESTIONS = ("codebooks", "decoders", "tokens_of_seed_7", "tokens", "gru")
ADVERSARIAL = {"adv0": 0.0, "adv01": 0.1, "adv1": 1.0}
"""Weights of L_adv: none, the public code's, the paper's."""
WAYS = {
    "likeliest tokens": ("greedy", SamplingConfig(temperature=0.0)),
    "drawn": ("drawn", SamplingConfig(temperature=1.0, top_p=1.0)),
}
DECODED = 120
"""Test clips whose tokens are decoded."""
SAMPLERS: dict[Sampler, int] = {"dpm++": 20, "ddpm": 100}
DECODER_COLUMNS = (Column("MPJPE, mm", "mpjpe"), Column("FID_k", "movement.fid_k"))
DRAWS = 20
"""Motions of each caption whose geometry is checked."""
COLUMNS = (
    Column("cross-entropy", "log:train/tokens_ce", 2),
    Column("critic is right, %", "log:train/critic_accuracy", 0, 100),
    Column("Top-1 among {candidates}, %", "tma.top-1", 1, 100),
    Column("FID_k", "movement.fid_k"),
    Column("FID_m", "movement.fid_m"),
    Column("does what is said, %", "geometry", 0, 100),
)


def stages_of(question: str, clips: Path, seed: int = 7, **values: object) -> dict[str, Any]:
    """The stages of a question for one seed, and the other values of its placeholders."""
    text = (HERE / "ude_ingredients.yaml").read_text(encoding="utf-8")
    for name, value in {"CLIPS": clips.resolve(), "SEED": seed, "STEPS": 0, **values}.items():
        text = text.replace(name, str(value))
    found: dict[str, Any] = yaml.safe_load(text)[question]
    return found


def adversarial(args: argparse.Namespace) -> None:
    """Train and measure the arms of L_adv, and print those that have finished."""
    stages = stages_of("captions", args.clips)
    for seed in args.seeds:
        for arm, weight in ADVERSARIAL.items():
            values = {"ARM": arm, "WEIGHT": weight, "STEPS": args.steps}
            stages |= stages_of("adversarial", args.clips, seed, **values)
    run = train(args.work / "adversarial", stages, until=args.until, seed=7)
    finished = finished_stages(run)
    rows = []
    for title, (way, sampling) in WAYS.items():
        for arm, weight in ADVERSARIAL.items():
            names = {seed: f"{way}_{arm}_{seed}" for seed in args.seeds}
            done = {seed: finished[n] for seed, n in names.items() if f"text_{n}" in finished}
            rows.append(row_of(args, run, f"{title}, weight {weight:g}", done, sampling))
    first = FigureFile.read(run / "stages" / f"text_{names[args.seeds[0]]}" / FILE_NAME)
    for title, row in {"recorded": RECORDED, "nearest training caption": NEAREST_WORDS}.items():
        found = {column.figure: first.of(column.figure, row) for column in COLUMNS}
        rows.append({"title": title, "cells": {k: [one.value] for k, one in found.items() if one}})
    for row in rows:
        figure = first.of("tma.top-1", MODEL)
        row["candidates"] = {} if figure is None else {"tma.top-1": figure.protocol["candidates"]}
    report(f"L_adv from the first of {args.steps} steps on", COLUMNS, rows, args.record)


def decoders(args: argparse.Namespace) -> None:
    """Train diffusion decoders of the paper's size, and measure what they make of recorded clips' tokens."""
    stages = stages_of("captions", args.clips)
    for seed in args.seeds:
        stages |= stages_of("paper_decoders", args.clips, seed, STEPS=args.steps)
    finished = finished_stages(train(args.work / "decoders", stages, until=args.until, seed=7))
    cache = StageCache()
    tokenizer = cache.get(finished["ema_7"])
    data = cache.get(finished["data"])
    dataset = data.split("test")
    nearest = NearestClip(data.split("train"))
    chosen = np.random.default_rng(0).permutation(len(dataset))[:DECODED]
    truths = [truth_at(dataset, k, min(int(dataset.frames[k]), 160) // 4 * 4) for k in chosen.tolist()]
    codes = tokenizer.encode([truth.features for truth in truths])

    def measured(stage: str, sampler: Sampler, steps: int) -> dict[str, float]:
        net = cache.get(finished[stage]).net
        seeds = sample_seeds(0, DECODED)
        made = decode_motions(net, codes, seeds=seeds, sampler=sampler, steps=steps)
        return decoder_figures(
            [joints_of(tokenizer.of_coordinates(x), tokenizer.layout) for x in made], truths
        )

    rows = []
    for kind, title in {"epsilon": "noise", "sample": "motion"}.items():
        for sampler, steps in SAMPLERS.items():
            found = []
            for name in (f"{kind}_{seed}" for seed in args.seeds):
                call = partial(measured, name, sampler, steps)
                found.append(kept(args.work / f"{name}-{sampler}.json", call))
            cells = {key: [one[key] for one in found] for key in found[0]}
            protocol = {"split": "test", "clips": DECODED, "steps": args.steps, "batch": 64}
            row = {"title": f"predicts {title}, {sampler} in {steps} steps", "cells": cells}
            rows.append({**row, "seeds": args.seeds, "protocol": protocol})
    own = tokenizer.decode(codes.codes, codes.groups.tolist())
    others = {
        "the tokenizer's own decoder": [joints_of(x, tokenizer.layout) for x in own],
        "nearest training clip": [joints for _, joints in nearest.motions(truths)],
    }
    for title, joints in others.items():
        cells = {key: [value] for key, value in decoder_figures(joints, truths).items()}
        rows.append({"title": title, "cells": cells})
    report("DMD of the paper's size", DECODER_COLUMNS, rows, args.record)


def decoder_figures(made: list[Joints], truths: Sequence[Truth]) -> dict[str, float]:
    """How near decoded motions are to the recorded ones, each and in distribution."""
    recorded = [truth.joints for truth in truths]
    pairs = zip(made, recorded, strict=True)
    errors = [mpjpe(torch.as_tensor(a), torch.as_tensor(b)).mean().item() for a, b in pairs]
    features = [all_features(motions, 20.0) for motions in (recorded, made)]
    return {"mpjpe": float(np.mean(errors))} | distances(*features)


def row_of(
    args: argparse.Namespace, run: Path, title: str, done: dict[int, CompletedStage], sampling: SamplingConfig
) -> dict[str, Any]:
    """One arm: a value for each seed that has finished."""
    cells: dict[str, list[float]] = {}
    for stage in done.values():
        values = kept(args.work / f"{stage.name}.json", lambda stage=stage: measured(run, stage, sampling))
        for figure, value in values.items():
            cells.setdefault(figure, []).append(value)
    protocol = {"split": "test", "steps": args.steps, "repeats": 1}
    return {"title": title, "cells": cells, "seeds": list(done), "protocol": protocol}


def measured(run: Path, stage: CompletedStage, sampling: SamplingConfig) -> dict[str, float]:
    """The figures of a generator: of its evaluation, of its training's end, and of geometry."""
    found = FigureFile.read(run / "stages" / f"text_{stage.name}" / FILE_NAME)
    arm, seed = stage.inputs["utt"].name.rsplit("_", 1)
    out: dict[str, float] = {}
    for column in COLUMNS:
        figure = found.of(column.figure, MODEL)
        value = logged(run, arm, int(seed), column) if figure is None else figure.value
        if value is not None:
            out[column.figure] = value
    right = obeyed(Bundle([stage], StageCache()), DRAWS, sampling)
    return out | {"geometry": sum(right.values()) / (DRAWS * len(CAPTIONS))}


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("clips", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[7, 8, 9])
    parser.add_argument("--until", help="stages, with commas between them")
    parser.add_argument("--adversarial", action="store_true", help="the question of L_adv")
    parser.add_argument("--decoders", action="store_true", help="the question of DMD at the paper's size")
    parser.add_argument("--steps", type=int, default=4000, help="of the arms of L_adv, and of these decoders")
    args = arguments(parser)
    if args.adversarial or args.decoders:
        return adversarial(args) if args.adversarial else decoders(args)
    stages = stages_of("base", args.clips)
    for question in QUESTIONS:
        for seed in args.seeds:
            if not question.endswith("_7") or seed == 7:
                stages |= stages_of(question, args.clips, seed)
    train(args.work / "run", stages, until=args.until, seed=7)


if __name__ == "__main__":
    main()
