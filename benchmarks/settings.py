"""The settings of `humantomato-learning` beside the paper's plain ones, L_align in both forms, over seeds.

    python benchmarks/settings.py WORK [--seeds 0 1 2]

Two chains of tokenizer (H2VQ), TMA, tokens and GPT are trained for every seed on the same synthetic clips,
with the same widths and steps. `paper`: published features with deviations averaged over each kind of column,
squared error, no velocity term, no gains. `ours`: deviations of each column, smooth L1, a velocity term,
fingers read as they bend (`finger_gain`), the root's columns enlarged. From each chain's GPT three go on for
as many steps: on the tokens alone, with L_align as published (on what is predicted after the truth) and with
L_align on the motions that the model samples.

Judged by what no GPT was trained with: geometry of the joints (synth/measure.py), held-out combinations
apart, and one evaluator of Guo et al. that is trained once, in the published features, with a seed of its
own. Killed and started again it goes on where it was.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from learning import Shares, judge, test_truths
from rich.console import Console
from rich.table import Table

from motionloom.datasets.motion.features.joints import joints_of
from motionloom.models.metrics.distributions import fid
from motionloom.models.metrics.retrieval import matching_score, r_precision
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import StageCache
from motionloom.pipeline.evaluation.judges import Judge
from motionloom.pipeline.evaluation.reconstruction import reconstruction_errors
from motionloom.pipeline.evaluation.truth import Truth, reconstruct_truth
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.runs.resolve import find_recipe
from motionloom.pipeline.store.networks import embed_motions

FORMS: dict[str, dict[str, Any]] = {
    "tokens alone": {"align_weight": 0.0},
    "L_align on predictions": {"align_on": "predictions", "align_weight": 0.1},
    "L_align on samples": {"align_on": "samples", "align_weight": 2.0, "threshold": None},
}
"""How the last steps of a GPT are trained."""
SETTINGS: dict[str, dict[str, Any]] = {
    "paper": {
        "stats": {"group": True},
        "tokenizer": {"recon": "l2", "velocity_weight": 0.0, "root_gain": 1.0, "finger_gain": 0.0},
        "tma": {"finger_gain": 0.0},
    },
    "ours": {
        "stats": {},
        "tokenizer": {"recon": "smooth_l1", "velocity_weight": 0.5, "root_gain": 5.0, "finger_gain": 4.0},
        "tma": {"finger_gain": 4.0},
    },
}
SIZE = 32
COLUMNS = {
    "held out: every": 1.0,
    "held out: whole": 1.0,
    "other: every": 1.0,
    "other: whole": 1.0,
    "top-1": 1.0,
    "matching": 0.0,
    "FID": 0.0,
}
"""Column -> 1 for a share, shown in percent."""


def slug(form: str) -> str:
    return "gpt_" + form.replace(" ", "_").lower()


def trained(steps: int, batch: int, lr: float, *, warmup: int = 100, **extra: Any) -> dict[str, Any]:
    return {
        "optim": {"lr": lr, "warmup_steps": warmup, "schedule": "cosine", **extra},
        "train": {"steps": steps, "batch_size": batch, "checkpoint_every": 250, "validate_every": 0},
    }


def base_recipe(args: argparse.Namespace) -> dict[str, Any]:
    """The clips of the learning recipe, fewer, and the judge."""
    held = yaml.safe_load(find_recipe("humantomato-learning").read_text())["stages"]
    return {
        "name": "settings-base",
        "seed": 1234,
        "stages": {
            "data": {**held["data"], "clips": args.clips},
            "stats": {"kind": "stats"},
            "text": {"kind": "text"},
            "evaluator": {
                **held["evaluator"],
                "movement_steps": args.judge * 2 // 5,
                "train": {**held["evaluator"]["train"], "steps": args.judge},
            },
        },
    }


def chain_recipe(shards: Path, setting: str, seed: int, args: argparse.Namespace) -> dict[str, Any]:
    """One chain: from the same shards to three GPTs."""
    kinds = SETTINGS[setting]
    gpt = {"layers": 4, "dim": 192, "heads": 6, "ff": 768, "dropout": 0.05, "attention_dropout": 0.0}
    latent = {"latent": 128, "ff": 512, "layers": 2, "heads": 4, "dropout": 0.1, "attention_dropout": 0.0}
    codes = {"num_codes": 512, "decay": 0.97, "alpha": 0.25, "reset_below": 0.05}
    stages: dict[str, Any] = {
        "data": {"kind": "shards", "path": str(shards.resolve()), "verify": False},
        "stats": {"kind": "stats", **kinds["stats"]},
        "text": {"kind": "text"},
        "tma": {
            "kind": "tma",
            "net": {**latent, "frame_stride": 4, **kinds["tma"]},
            **trained(args.tma, 64, 5.0e-4),
        },
        "tokenizer": {
            "kind": "h2vq",
            "net": {"width": 96, "depth": 2, "code_dim": 96, **codes, **kinds["tokenizer"]},
            **trained(args.tokenizer, 16, 2.0e-3, warmup=30),
        },
        "tokens": {"kind": "tokens"},
        "gpt_start": {
            "kind": "gpt",
            "net": {**gpt, "block_size": 150},
            "loss": {"align_weight": 0.0},
            **trained(args.gpt, 16, 1.0e-3, weight_decay=0.01),
        },
    }
    for form, loss in FORMS.items():
        stages[slug(form)] = {
            "kind": "gpt",
            "inputs": {"start": "gpt_start"},
            "net": {**gpt, "block_size": 150},
            "loss": loss,
            **trained(args.last, 16, 2.0e-4, warmup=50, weight_decay=0.01),
        }
    return {"name": f"settings-{setting}", "seed": seed, "stages": stages}


def run(recipe: dict[str, Any], folder: Path, console: Console) -> None:
    path = folder.parent / f"{folder.name}.yaml"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml.safe_dump(recipe, sort_keys=False))
    run_recipe(path, folder, console=console)


def flat(shares: Shares) -> dict[str, float]:
    return {f"{kind}: {name}": value for kind, row in shares.items() for name, value in row.items()}


def measure(folder: Path, base: Path, truths: list[Truth], sampling: SamplingConfig) -> dict[str, Any]:
    """Figures of one chain, kept beside it: of its tokenizer and of each of its GPTs."""
    kept = folder / "figures.json"
    if kept.is_file():
        return dict(json.loads(kept.read_text()))
    stages, stage_cache = finished_stages(folder), StageCache()
    found = StageCache().get(finished_stages(base)["evaluator"])
    text, real = (
        Judge.evaluator(found).texts(truths),
        embed_motions(found, [t.features for t in truths], [t.present for t in truths]),
    )
    hold_out = [dict(c) for c in finished_stages(base)["data"].config.hold_out]
    tokenizer, data = stage_cache.get(stages["tokenizer"]), stage_cache.get(stages["data"])
    layout, fps = tokenizer.layout, tokenizer.layout.fps

    def judged(motions: list[Any], shares: Shares) -> dict[str, float]:
        latent = embed_motions(found, motions)
        return flat(shares) | {
            "top-1": float(r_precision(text, latent, batch=SIZE, seed=0)[0]),
            "matching": float(matching_score(text, latent, batch=SIZE, seed=0)),
            "FID": float(fid(real, latent)),
        }

    rebuilt = [reconstruct_truth(tokenizer, truth) for truth in truths]
    order = np.random.default_rng(0).permutation(len(truths))
    others = [truths[k] for k in order]
    rows = {
        "recorded": judged(
            [t.features for t in truths], judge(truths, ((t.joints, None) for t in truths), fps, hold_out)
        ),
        "another clip's motion": judged(
            [t.features for t in others], judge(truths, ((t.joints, None) for t in others), fps, hold_out)
        ),
        "tokenizer alone": judged(
            rebuilt, judge(truths, ((joints_of(x, layout), None) for x in rebuilt), fps, hold_out)
        ),
    }
    captions = [truth.caption for truth in truths]
    for form in FORMS:
        made = Bundle([stages[slug(form)]], stage_cache).generate(captions, sampling=sampling)
        rows[form] = judged(
            [m.features for m in made], judge(truths, ((m.joints, None) for m in made), fps, hold_out)
        )
    errors = reconstruction_errors(tokenizer, data.split("train"), truths[:100])
    figures = {"rows": rows, "reconstruction": {k: errors[k] for k in ("mpjpe", "mpjpe_body", "mpjpe_hand")}}
    kept.write_text(json.dumps(figures, indent=1))
    return figures


def spread(values: list[float], share: float) -> str:
    scaled = np.array(values) * (100.0 if share else 1.0)
    deviation = f" ± {scaled.std(ddof=1):.1f}" if len(scaled) > 1 else ""
    return (
        f"{scaled.mean():.1f}{deviation}"
        if share
        else f"{scaled.mean():.2f}" + (f" ± {scaled.std(ddof=1):.2f}" if len(scaled) > 1 else "")
    )


def show(results: dict[str, list[dict[str, Any]]], console: Console) -> None:
    table = Table("settings", "what", *COLUMNS, title="test clips; mean ± deviation over seeds")
    for setting, runs in results.items():
        for what in runs[0]["rows"]:
            cells = [spread([r["rows"][what][name] for r in runs], share) for name, share in COLUMNS.items()]
            table.add_row(setting, what, *cells)
    console.print(table)
    table = Table("settings", "MPJPE", "body", "hands", title="reconstruction, mm")
    for setting, runs in results.items():
        keys = runs[0]["reconstruction"]
        table.add_row(setting, *(spread([r["reconstruction"][key] for r in runs], 0.0) for key in keys))
    console.print(table)
    for setting, runs in results.items():
        for form in list(FORMS)[1:]:
            gains = [
                r["rows"][form]["held out: every"] - r["rows"]["tokens alone"]["held out: every"]
                for r in runs
            ]
            console.print(f"{setting}: {form} against tokens alone, held out: every: {spread(gains, 1.0)}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("work", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--clips", type=int, default=5000, help="synthetic clips to make")
    parser.add_argument("--tested", type=int, default=400, help="test clips to generate for")
    parser.add_argument("--judge", type=int, default=2500, help="steps of the evaluator")
    parser.add_argument("--tokenizer", type=int, default=4000, help="steps of a tokenizer")
    parser.add_argument("--tma", type=int, default=600, help="steps of a TMA")
    parser.add_argument("--gpt", type=int, default=1800, help="steps of a GPT on tokens")
    parser.add_argument("--last", type=int, default=150, help="steps of a GPT in each form")
    parser.add_argument("--top-p", type=float, default=0.9)
    parser.add_argument("--cfg-scale", type=float, default=1.5, help="classifier-free guidance")
    args = parser.parse_args()
    console, base = Console(), args.work / "base"
    run(base_recipe(args), base, console)
    shards = finished_stages(base)["data"].folder / "shards"
    truths = test_truths(base)
    truths = [truths[k] for k in np.random.default_rng(0).permutation(len(truths))[: args.tested]]
    sampling = SamplingConfig(top_p=args.top_p, cfg_scale=args.cfg_scale)
    results: dict[str, list[dict[str, Any]]] = {}
    for seed in args.seeds:
        for setting in SETTINGS:
            folder = args.work / f"{setting}-{seed}"
            run(chain_recipe(shards, setting, seed, args), folder, console)
            results.setdefault(setting, []).append(measure(folder, base, truths, sampling))
        show(results, console)
        (args.work / "settings.json").write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
