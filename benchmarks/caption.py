"""A captioner on the tokens of a finished run, beside captions that need none: trained, measured, recorded.

    python benchmarks/caption.py captions_real RUN WORK [--steps 1000] [--set captioner.net.dim=192]
    python benchmarks/results.py

RUN has stages data, text, tma, tokenizer and tokens. WORK/run becomes a run of two more; the record of this
name is made of its figures, on the test split.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import results

from motionloom.pipeline.evaluation.figures import (
    COMMON_CAPTION,
    FILE_NAME,
    MODEL,
    NEAREST,
    OWN_CAPTION,
    FigureFile,
)
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.store.yaml import dump_yaml

TITLES = {
    "captions_real": "Captions of recorded clips, people's words",
    "captions_synthetic": "Captions of synthetic clips",
}
COLUMNS = (
    results.Column("BLEU-1, %", "captions.bleu-1", 1, 100),
    results.Column("BLEU-4, %", "captions.bleu-4", 1, 100),
    results.Column("ROUGE-L, %", "captions.rouge-l", 1, 100),
    results.Column("CIDEr-D, %", "captions.cider-d", 0, 100),
    results.Column("BERTScore F1, %", "captions.bert", 1, 100),
    results.Column("TMA finds its clip among 32, %", "captions.R-precision-1", 0, 100),
    results.Column("claims that hold, %", "captions.claims_hold", 0, 100),
)
ROWS = {
    "generated": MODEL,
    "nearest training clip's": NEAREST,
    "the most frequent": COMMON_CAPTION,
    "another person's, by the rest": OWN_CAPTION,
}


def recipe(name: str, run: Path, steps: int) -> dict[str, object]:
    """Both stages, on the stages of a finished run."""

    def inputs(*roles: str) -> dict[str, str]:
        return {role: str(run.resolve() / "stages" / role) for role in roles}

    net = {"layers": 2, "dim": 128, "heads": 4, "ff": 512, "attention_dropout": 0.0, "max_words": 25}
    train = {"steps": steps, "batch_size": 32, "checkpoint_every": 250, "validate_every": 250}
    return {
        "name": name.replace("_", "-"),
        "seed": 1,
        "hardware": {"accelerator": "cpu", "threads": 1},
        "stages": {
            "captioner": {
                "kind": "captioner",
                "inputs": inputs("data", "tokenizer", "tokens"),
                "net": net,
                "optim": {"lr": 1e-3, "schedule": "cosine", "warmup_steps": 50},
                "train": train,
            },
            "evaluate_captions": {
                "kind": "evaluate_captions",
                "inputs": {"captioner": "captioner", **inputs("data", "text", "tma")},
            },
        },
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("name", choices=TITLES)
    parser.add_argument("run", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--set", action="append", default=[])
    args = parser.parse_args()
    args.work.mkdir(parents=True, exist_ok=True)
    path = args.work / "captions.yaml"
    path.write_text(dump_yaml(recipe(args.name, args.run, args.steps)))
    run_recipe(path, args.work / "run", overrides=args.set)
    found = FigureFile.read(args.work / "run/stages/evaluate_captions" / FILE_NAME)
    rows = []
    for title, row in ROWS.items():
        figures = {column.figure: found.of(column.figure, row) for column in COLUMNS}
        cells = {name: [figure.value] for name, figure in figures.items() if figure is not None}
        if cells:
            protocol = {name: found.figures[0].protocol[name] for name in ("split", "clips")}
            rows.append({"title": title, "cells": cells, "seeds": [1] * (row == MODEL), "protocol": protocol})
    steps = f"--steps {args.steps}"
    results.COMMANDS[args.name] = f"python benchmarks/caption.py {args.name} RUN WORK {steps}"
    results.write(args.name, TITLES[args.name], [column._asdict() for column in COLUMNS], rows)
    print(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
