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
import json
from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
import yaml
from rich.console import Console
from rich.table import Table

from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.synth.generate import SynthConfig, synthesize
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.stage import StageCache
from motionloom.pipeline.evaluation.reconstruction import reconstruction_errors
from motionloom.pipeline.evaluation.truth import truth_of
from motionloom.pipeline.runs.api import run_recipe

matplotlib.use("Agg")

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
COLUMNS = {"mpjpe": "MPJPE", "mpjpe_body": "body", "mpjpe_hand": "hands", "pose": "pose", "world": "world"}


HANDED = ("h2vq", "separate")
"""Stage kinds that need hands."""


def recipe(work: Path, kind: str, net: dict, seed: int, args: argparse.Namespace) -> Path:
    """The recipe file of one run; data, statistics and windows are the same for all."""
    train = {"steps": args.steps, "batch_size": 16, "checkpoint_every": 200, "validate_every": 0}
    stages = {
        "data": {"kind": "shards", "path": str(args.shards.resolve()), "verify": False},
        "stats": {"kind": "stats", "group": args.features == "paper"},
        "tokenizer": {
            "kind": kind,
            "net": {**COMMON, **net, **(PAPER if args.features == "paper" else {})},
            "optim": {"lr": 2.0e-3, "warmup_steps": 30, "schedule": "cosine"},
            "train": train,
        },
    }
    path = work / "recipe.yaml"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml.safe_dump({"name": "order", "seed": seed, "stages": stages}))
    return path


def measure(run: Path, clips: int) -> dict[str, float]:
    """Figures of one finished run, kept beside it."""
    kept = run / "figures.json"
    if kept.is_file():
        return dict(json.loads(kept.read_text()))
    stages, stage_cache = finished_stages(run), StageCache()
    tokenizer, data = stage_cache.get(stages["tokenizer"]), stage_cache.get(stages["data"])
    test = data.split("test")
    truths = [truth_of(test, i) for i in range(min(clips, len(test)))]
    figures = reconstruction_errors(tokenizer, data.split("train"), truths)
    figures["bits"] = tokenizer.net.bits_per_second
    kept.write_text(json.dumps(figures))
    return figures


def show(results: dict[str, list[dict[str, float]]], console: Console) -> None:
    table = Table(
        "tokenizer", "bit/s", *COLUMNS.values(), title="test clips, mm, mean ± deviation over seeds"
    )
    for title, rows in results.items():
        cells = [_spread([row[key] for row in rows if key in row]) for key in COLUMNS]
        table.add_row(title, f"{rows[0]['bits']:.0f}", *cells)
    first = next(iter(results.values()))[0]
    for name, suffix in (("nearest training clip", "_nearest_train_clip"), ("mean pose", "_mean_pose")):
        table.add_row(
            name, "", *(_spread([first[k + suffix]] if k + suffix in first else []) for k in COLUMNS)
        )
    console.print(table)


def _spread(values: Sequence[float]) -> str:
    if not values:
        return ""
    deviation = f" ± {np.std(values, ddof=1):.1f}" if len(values) > 1 else ""
    return f"{np.mean(values):.1f}{deviation}"


def draw(results: dict[str, list[dict[str, float]]], path: Path) -> None:
    """Every seed as a dot, so that the order can be judged against the spread."""
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, len(COLUMNS), figsize=(12, 3), sharey=True, layout="constrained")
    for panel, (key, title) in zip(panels, COLUMNS.items(), strict=True):
        for row, (_name, figures) in enumerate(results.items()):
            values = [f[key] for f in figures if key in f]
            panel.plot(values, [row] * len(values), "o", alpha=0.7, color="C0")
        panel.set_title(f"{title}, mm")
        panel.set_yticks(range(len(results)), list(results))
        panel.grid(axis="x", alpha=0.3)
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("work", type=Path)
    parser.add_argument("--shards", type=Path, help="whole-body shards; default: synthetic clips")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=1600)
    parser.add_argument("--features", choices=("ours", "paper"), default="ours")
    parser.add_argument("--nets", nargs="*", choices=list(NETS), default=list(NETS))
    parser.add_argument("--made", type=int, default=2000, help="synthetic clips to make")
    parser.add_argument("--clips", type=int, default=100, help="test clips at most")
    args = parser.parse_args()
    if args.shards is None:
        args.shards = args.work / "shards"
        fields = {"clips": args.made, "fps": 20, "min_seconds": 2.0, "max_seconds": 5.0, "seed": 7}
        synthesize(SynthConfig.parse(fields, "synthetic clips"), args.shards, workers=2)
    console = Console()
    handed = ShardDataset.open(args.shards, "train").layout.has_part("hand")
    results: dict[str, list[dict[str, float]]] = {}
    for seed in range(args.seeds):
        for title in args.nets:
            kind, net = NETS[title]
            if not handed and kind in HANDED:
                continue
            net = net if handed else {**net, "part": "body", "finger_gain": 0.0}
            run = args.work / args.features / f"{title.replace(' ', '-').replace(',', '')}-{seed}"
            run_recipe(recipe(run, kind, net, seed, args), run, console=console)
            results.setdefault(title, []).append(measure(run, args.clips))
        show(results, console)
    place = args.work / args.features
    draw(results, place / "order.png")
    (place / "order.json").write_text(json.dumps(results, indent=1))
    console.print(f"{place / 'order.json'}, {place / 'order.png'}")


if __name__ == "__main__":
    main()
