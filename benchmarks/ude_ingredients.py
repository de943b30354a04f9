"""UDE's own ingredients at a size where they can work, each beside what this program does instead.

    python benchmarks/ude_ingredients.py CLIPS WORK

CLIPS holds real captioned clips (BVH archives, `captions.jsonl`, `joint_map.json`); synthetic dances are
made. One recipe is written into WORK and run there: data, judge, then an arm of every question for every
seed. Killed and started again it goes on where it was; `--seeds` and `--until` take a part. Its figures are
those of its stages' `metrics.json` (`benchmarks/results.py`).

- codebook: learnt by gradient from the paper's start, from data, and by moving averages;
- decoder: DMD (160 wide, 133 columns) that predicts the noise and the motion; the tokenizer's own;
- GPT and GRU; z and none, with the likeliest tokens.

`--adversarial` asks the question of L_adv in a run of its own, on the captioned clips alone: weights 0, 0.1
and 1 from the first of 4,000 steps of 8 on, likeliest and drawn tokens, by figures and by geometry.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from bench import Column, arguments, command_line, kept, report, train
from caption_check import obeyed
from results import logged

from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import CompletedStage, StageCache
from motionloom.pipeline.evaluation.figures import FILE_NAME, MODEL, FigureFile
from motionloom.pipeline.inference.bundle import Bundle

Stages = dict[str, dict[str, Any]]

CODEBOOKS: Stages = {
    "ema": {"quantizer": "ema", "decay": 0.97, "reset_below": 0.1},
    "gradient": {"quantizer": "gradient"},
    "gradient_data": {"quantizer": "gradient", "start": "data"},
}
ADVERSARIAL = {"adv0": 0.0, "adv01": 0.1, "adv1": 1.0}
"""Weights of L_adv: none, the public code's, the paper's."""
SHARED = 7
"""Seed of the tokenizer and of the GPT that arms share."""
EVERY = {"checkpoint_every": 200, "validate_every": 400}
GREEDY = {"temperature": 0.0}
COLUMNS = (
    Column("cross-entropy", "log:train/tokens_ce", 2),
    Column("right tokens, %", "log:train/tokens_accuracy_code", 0, 100),
    Column("critic is right, %", "log:train/critic_accuracy", 0, 100),
    Column("Top-1 among 61, %", "tma.top-1", 1, 100),
    Column("FID_k", "movement.fid_k"),
    Column("FID_m", "movement.fid_m"),
    Column("does what is said, %", "geometry", 0, 100),
)
"""Of the question of L_adv; geometry is that of nine captions, twenty motions of each."""


def trained(steps: int, batch: int, lr: float, seed: int, warmup: int = 50) -> dict[str, Any]:
    """Adam, as all of UDE is trained by (4.2)."""
    return {
        "optim": {"optimizer": "adam", "lr": lr, "warmup_steps": warmup, "schedule": "cosine"},
        "train": {"steps": steps, "batch_size": batch, "seed": seed, **EVERY},
    }


def base(clips: Path) -> Stages:
    """The stages that all arms share: the data, the judge, and the tokenizer of the first seed."""
    dances = {"songs": 150, "song_seconds": 12.0, "conditions": {"audio": 1.0, "both": 0.0}}
    return {
        "clips": {
            "kind": "bvh", "source": str(clips), "joint_map": str(clips / "joint_map.json"), "fps": 20,
            "captions": str(clips / "captions.jsonl"), "licence": "CC-BY-NC-4.0",
        },
        "dances": {
            "kind": "synth", "layout": "body133", "clips": 600, "fps": 20, "min_seconds": 4.0,
            "max_seconds": 6.0,
            "test_fraction": 0.15, "val_fraction": 0.05, "actions": ["dance"], "dances": dances,
        },
        "data": {"kind": "mix", "inputs": {"data": ["clips", "dances"]}},
        "stats": {"kind": "stats"},
        "text": {"kind": "text"},
        "audio": {"kind": "audio"},
        "tma": {
            "kind": "tma",
            "net": {"latent": 128, "ff": 256, "layers": 2, "heads": 4, "attention_dropout": 0.0,
                    "frame_stride": 4},
            "optim": {"lr": 5.0e-4, "warmup_steps": 50, "schedule": "cosine"},
            "train": {"steps": 400, "batch_size": 64, **EVERY},
        },
    }  # fmt: skip


def codebook_arms(seed: int) -> Stages:
    """Tokenizers, measured on what they reconstruct."""
    out: Stages = {}
    for name, how in CODEBOOKS.items():
        net = {"part": "body", "width": 128, "depth": 1, "code_dim": 64, "num_codes": 512, **how}
        out[f"{name}_{seed}"] = {"kind": "mq", "net": net, **trained(1000, 32, 1.0e-3, seed)}
        out[f"codes_{name}_{seed}"] = evaluation([], f"{name}_{seed}", None)
    return out


def decoder_arms(seed: int) -> Stages:
    """Diffusion decoders of one tokenizer."""
    return {
        f"{predicts}_{seed}": {
            "kind": "dmd",
            "inputs": {"tokenizer": f"ema_{SHARED}"},
            "net": {"dim": 160, "ff": 320, "encoder_layers": 2, "decoder_layers": 3, "heads": 5,
                    "dropout": 0.0, "attention_dropout": 0.0, "schedule": {"predicts": predicts}},
            "window": 64,
            **trained(800, 16, 1.0e-3, seed),
        }
        for predicts in ("epsilon", "sample")
    }  # fmt: skip


def token_model(
    seed: int, steps: int, net: dict[str, Any], loss: dict[str, Any], batch: int = 16
) -> dict[str, Any]:
    """MATE and a small UTT, with the music of its frames beside each token [ours]."""
    return {
        "kind": "utt",
        "inputs": {"tokenizer": f"ema_{SHARED}"},
        "net": {"layers": 3, "dim": 128, "heads": 4, "ff": 512, "block_size": 48, "z_dim": 16,
                "attention_dropout": 0.0, "frame_condition": True, **net},
        "mate": {"dim": 128, "layers": 2, "heads": 4, "ff": 256, "attention_dropout": 0.0, "stride": 4},
        "loss": loss,
        **trained(steps, batch, 1.0e-3, seed),
    }  # fmt: skip


def engine(
    name: str, utt: str, dmd: str | None, inject_z: bool, sampling: dict[str, Any], repeats: int,
    music: bool = False,
) -> Stages:  # fmt: skip
    """A generator and its figures for captions, and for music."""
    made = {"kind": "ude", "inputs": {"utt": utt, "dmd": dmd}, "inject_z": inject_z}
    more = {"sampling": sampling, "repeats": repeats}
    dances = {"kind": "evaluate_dances", "inputs": {"generators": [name]}, "clips": 60, "shuffles": 2, **more}
    out = {name: made, f"text_{name}": evaluation([name], None, "tma") | more}
    return out | ({f"music_{name}": dances} if music else {})


def evaluation(generators: list[str], tokenizer: str | None, judge: str | None) -> dict[str, Any]:
    inputs = {"generators": generators, "tokenizer": tokenizer, "tma": judge}
    return {"kind": "evaluate", "inputs": inputs, "clips": 120, "repeats": 1}


def loss_of(weight: float = 0.0) -> dict[str, Any]:
    """The loss of a token model."""
    if not weight:
        return {"adversarial": {"weight": 0.0}}
    adam = {"optimizer": "adam", "lr": 2.0e-4, "betas": [0.5, 0.99]}
    return {
        "adversarial": {"weight": weight},
        "discriminator": {"dim": 64, "ff": 128, "heads": 4},
        "discriminator_optim": adam,
    }


def token_arms(seed: int) -> Stages:
    """One GPT without z, decoded by each decoder, and with z."""
    gpt, first = f"gpt_{SHARED}", seed == SHARED
    out: Stages = {}
    if first:
        out |= {gpt: token_model(seed, 500, {}, loss_of())} | engine(
            f"greedy_{seed}", gpt, None, False, GREEDY, 1, music=True
        )
    for predicts in ("epsilon", "sample"):
        dmd = f"{predicts}_{seed}"
        out |= engine(f"greedy_{dmd}", gpt, dmd, False, GREEDY, 3, music=first)
    return out | (engine(f"greedy_z_{seed}", gpt, None, True, GREEDY, 3) if first else {})


def gru_arms(seed: int) -> Stages:
    gru = f"gru_{seed}"
    out: Stages = {gru: token_model(seed, 500, {"kind": "gru"}, loss_of())}
    return out | engine(f"greedy_gru_{seed}", gru, None, False, GREEDY, 1, music=True)


QUESTIONS = ((codebook_arms,), (decoder_arms,), (token_arms,), (gru_arms,))
"""In the order in which they are asked; of the last every seed answers all."""


def adversarial(args: argparse.Namespace) -> None:
    """Train, measure and print the arms of L_adv, each beside the same arm without."""
    shared = base(args.clips.resolve())
    tokenizer, judge = f"ema_{SHARED}", {**shared["tma"], "loss": {"threshold": 0.999}}
    judge["net"] |= {"ff": 384}
    judge["optim"] |= {"lr": 4.0e-4, "warmup_steps": 100}
    judge["train"] = {
        "steps": 600,
        "batch_size": 64,
        "seed": SHARED,
        "checkpoint_every": 200,
        "validate_every": 600,
    }
    stages = {"data": shared["clips"], "stats": shared["stats"], "text": shared["text"], "tma": judge}
    stages[tokenizer] = codebook_arms(SHARED)[tokenizer]
    ways = {"likeliest tokens": ("greedy", GREEDY), "drawn": ("drawn", {"temperature": 1.0, "top_p": 1.0})}
    for seed in args.seeds:
        for name, weight in ADVERSARIAL.items():
            arm = f"{name}_{seed}"
            stages[arm] = token_model(seed, args.steps, {"frame_condition": False}, loss_of(weight), 8)
            stages[arm] |= {"modalities": ["text"]}
            for short, sampling in ways.values():
                stages |= engine(f"{short}_{arm}", arm, None, True, sampling, 1)
                stages[f"text_{short}_{arm}"] |= {"clips": None}
    run = train(args.work / "adversarial", stages, until=args.until, seed=7)
    if args.until:
        return
    finished = finished_stages(run)
    rows = []
    for title, (short, sampling) in ways.items():
        for name, weight in ADVERSARIAL.items():
            cells: dict[str, list[float]] = {}
            for seed in args.seeds:
                stage = finished[f"{short}_{name}_{seed}"]
                found = kept(
                    args.work / f"{stage.name}.json",
                    lambda stage=stage, sampling=sampling: measured(run, stage, sampling),
                )
                for figure, value in found.items():
                    cells.setdefault(figure, []).append(value)
            protocol = {"split": "test", "steps": args.steps, "modalities": "text"}
            rows.append({"title": f"{title}, weight {weight:g}", "cells": cells, "seeds": args.seeds,
                         "protocol": protocol})  # fmt: skip
    report(f"L_adv from the first of {args.steps} steps on", COLUMNS, rows, args.record)


def measured(run: Path, stage: CompletedStage, sampling: dict[str, Any]) -> dict[str, float]:
    """The figures of a generator: of its evaluation, of its training's end, and of geometry."""
    found = FigureFile.read(run / "stages" / f"text_{stage.name}" / FILE_NAME)
    values = {column.figure: found.of(column.figure, MODEL) for column in COLUMNS}
    arm, seed = stage.inputs["utt"].name.rsplit("_", 1)
    logs = {column.figure: logged(run, arm, int(seed), column) for column in COLUMNS}
    bundle = Bundle([stage], StageCache())
    right = obeyed(bundle, 20, SamplingConfig.of(sampling))
    out = {name: value for name, value in logs.items() if value is not None}
    out |= {name: figure.value for name, figure in values.items() if figure is not None}
    return out | {"geometry": sum(right.values()) / (20 * len(right))}


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("clips", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[7, 8, 9])
    parser.add_argument("--until", help="stages, with commas between them")
    parser.add_argument("--adversarial", action="store_true", help="the question of L_adv")
    parser.add_argument("--steps", type=int, default=4000, help="of the arms of L_adv")
    args = arguments(parser)
    if args.adversarial:
        return adversarial(args)
    stages = base(args.clips.resolve())
    for together in QUESTIONS:
        for seed in args.seeds:
            for question in together:
                stages |= question(seed)
    train(args.work / "run", stages, until=args.until, seed=7)


if __name__ == "__main__":
    main()
