"""TMA with the filter of negatives and without, over seeds (HumanTOMATO section 3.5, TMR's filter).

    python benchmarks/negative_filter.py RUN WORK [--seeds 3] [--steps 600]

RUN is a run with synthetic shards. Every TMA is trained by the same recipe on the same clips; only the
threshold of the filter differs. Recall is measured as in `learning.py`, among 32 test clips that all do
something different, and the cosine of opposite captions beside it: captions of opposite motions are as alike
for the sentence encoder as two wordings of one motion, so a filter may hide what it should not. Killed and
started again it goes on where it was.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from pathlib import Path

import numpy as np
import yaml
from learning import retrieval, similarities, test_truths
from rich.console import Console
from rich.table import Table

from motionloom.pipeline.evaluation.truth import Truth
from motionloom.pipeline.runs.api import run_recipe

THRESHOLDS = {"tma_85": 0.85, "tma_95": 0.95, "tma_none": None}
"""Stage -> cosine above which two captions are not negatives; None keeps all negatives."""
COLUMNS = {
    "t2m/R@1": "text to motion R@1",
    "t2m/R@3": "R@3",
    "m2t/R@1": "motion to text R@1",
    "m2t/R@3": "R@3",
}


def recipe(folder: Path, shards: Path, seed: int, steps: int) -> Path:
    """The recipe file of one seed."""
    stages: dict[str, dict] = {
        "data": {"kind": "shards", "path": str(shards.resolve()), "verify": False},
        "stats": {"kind": "stats"},
        "text": {"kind": "text"},
    }
    for name, threshold in THRESHOLDS.items():
        stages[name] = {
            "kind": "tma",
            "net": {
                "latent": 128,
                "ff": 256,
                "layers": 2,
                "heads": 4,
                "attention_dropout": 0.0,
                "frame_stride": 4,
                "finger_gain": 4.0,
            },
            "loss": {"threshold": threshold},
            "optim": {"lr": 5.0e-4, "warmup_steps": 50, "schedule": "cosine"},
            "train": {"steps": steps, "batch_size": 64, "checkpoint_every": 100, "validate_every": 0},
        }
    path = folder / "recipe.yaml"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml.safe_dump({"name": "filter", "seed": seed, "stages": stages}))
    return path


def measure(run: Path, stage: str, truths: list[Truth], draws: int) -> dict[str, float]:
    """Recalls of one TMA and the mean cosine of opposite captions, kept beside it."""
    kept = run / f"{stage}.json"
    if not kept.is_file():
        figures = retrieval(run, stage, truths, draws)
        figures["opposites"] = float(np.mean([row[3] for row in similarities(run, stage)]))
        kept.write_text(json.dumps(figures))
    return dict(json.loads(kept.read_text()))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--draws", type=int, default=200)
    args = parser.parse_args()
    console, results = Console(), defaultdict(list)
    for seed in range(args.seeds):
        folder = args.work / str(seed)
        run_recipe(recipe(folder, args.run / "stages/data/shards", seed, args.steps), folder, console=console)
        truths = test_truths(folder)
        for stage in THRESHOLDS:
            results[stage].append(measure(folder, stage, truths, args.draws))
    table = Table("filter above", *COLUMNS.values(), "cosine of opposites")
    for stage, rows in results.items():
        cells = [_spread([row[key] for row in rows]) for key in (*COLUMNS, "opposites")]
        table.add_row("no filter" if stage == "tma_none" else str(THRESHOLDS[stage]), *cells)
    console.print(table)
    (args.work / "filter.json").write_text(json.dumps(results, indent=1))


def _spread(values: list[float]) -> str:
    deviation = f" ± {np.std(values, ddof=1):.3f}" if len(values) > 1 else ""
    return f"{np.mean(values):.3f}{deviation}"


if __name__ == "__main__":
    main()
