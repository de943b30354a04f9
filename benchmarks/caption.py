"""A captioner on the tokens of a finished run, beside captions that need none: trained, measured, recorded.

    python benchmarks/caption.py captions_real RUN WORK [--steps 1000]
    python benchmarks/results.py

RUN has stages data, text, tma, tokenizer and tokens. WORK/run becomes a run of two more; the record of this
name is made of its figures, on the test split.
"""

from __future__ import annotations

from pathlib import Path

from bench import Column, arguments, command_line, report, train

from motionloom.pipeline.evaluation.figures import (
    COMMON_CAPTION,
    FILE_NAME,
    MODEL,
    NEAREST,
    OWN_CAPTION,
    FigureFile,
)

TITLES = {
    "captions_real": "Captions of recorded clips, people's words",
    "captions_synthetic": "Captions of synthetic clips",
}
COLUMNS = (
    Column("BLEU-1, %", "captions.bleu-1", 1, 100),
    Column("BLEU-4, %", "captions.bleu-4", 1, 100),
    Column("ROUGE-L, %", "captions.rouge-l", 1, 100),
    Column("CIDEr-D, %", "captions.cider-d", 0, 100),
    Column("BERTScore F1, %", "captions.bert", 1, 100),
    Column("TMA finds its clip among 32, %", "captions.R-precision-1", 0, 100),
)
ROWS = {
    "generated": MODEL,
    "nearest training clip's": NEAREST,
    "the most frequent": COMMON_CAPTION,
    "another person's, by the rest": OWN_CAPTION,
}


def stages(run: Path, steps: int) -> dict[str, object]:
    """Both stages, on the stages of a finished run."""

    def inputs(*roles: str) -> dict[str, str]:
        return {role: str(run.resolve() / "stages" / role) for role in roles}

    net = {"layers": 2, "dim": 128, "heads": 4, "ff": 512, "attention_dropout": 0.0, "max_words": 25}
    return {
        "captioner": {
            "kind": "captioner",
            "inputs": inputs("data", "tokenizer", "tokens"),
            "net": net,
            "optim": {"lr": 1e-3, "schedule": "cosine", "warmup_steps": 50},
            "train": {"steps": steps, "batch_size": 32, "checkpoint_every": 250, "validate_every": 250},
        },
        "evaluate_captions": {
            "kind": "evaluate_captions",
            "inputs": {"captioner": "captioner", **inputs("data", "text", "tma")},
        },
    }


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("name", choices=TITLES)
    parser.add_argument("run", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--steps", type=int, default=1000)
    args = arguments(parser)
    run = train(args.work / "run", stages(args.run, args.steps), seed=1)
    found = FigureFile.read(run / "stages/evaluate_captions" / FILE_NAME)
    rows = []
    for title, row in ROWS.items():
        figures = {column.figure: found.of(column.figure, row) for column in COLUMNS}
        cells = {name: [figure.value] for name, figure in figures.items() if figure is not None}
        if cells:
            protocol = {name: found.figures[0].protocol[name] for name in ("split", "clips")}
            rows.append({"title": title, "cells": cells, "seeds": [1] * (row == MODEL), "protocol": protocol})
    report(TITLES[args.name], COLUMNS, rows, args.name)


if __name__ == "__main__":
    main()
