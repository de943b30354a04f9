"""Run folders written by hand: a recipe, records of finished stages, figures. No stage is run."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from motionloom.pipeline.evaluation.versions import EVALUATE, EVALUATE_DANCES

FILES = {"evaluate": ("metrics.json", EVALUATE), "evaluate_dances": ("dances.json", EVALUATE_DANCES)}


def write_run(run: Path, stages: Mapping[str, Mapping[str, Any]]) -> Path:
    """A run of `stages`: name -> kind, config, inputs (role -> stage), figures, version; in this order.

    A stage with `finished: False` stands in the recipe alone.
    """
    run.mkdir(parents=True, exist_ok=True)
    recipe = {name: {"kind": stage["kind"]} for name, stage in stages.items()}
    (run / "recipe.yaml").write_text(yaml.safe_dump({"name": run.name, "stages": recipe}, sort_keys=False))
    for name, stage in stages.items():
        if not stage.get("finished", True):
            continue
        folder = run / "stages" / name
        folder.mkdir(parents=True)
        file, version = FILES.get(stage["kind"], ("", 1))
        inputs = {
            role: {"stage": source, "fingerprint": f"of-{source}"}
            for role, source in stage.get("inputs", {}).items()
        }
        record = {
            "stage": name,
            "kind": stage["kind"],
            "version": stage.get("version", version),
            "fingerprint": f"of-{name}",
            "seed": 0,
            "config": stage.get("config", {}),
            "inputs": inputs,
        }
        (folder / "artifact.json").write_text(json.dumps(record))
        if file:
            (folder / file).write_text(json.dumps(stage.get("figures", {})))
    return run


def errors(mpjpe: float, *, hands: bool = True) -> dict[str, float]:
    """Errors of a reconstruction as `evaluate` writes them."""
    parts = ("", "_body", "_hand") if hands else ("",)
    out = {}
    for at, part in enumerate(parts):
        for number, metric in enumerate(("mpjpe", "pa_mpjpe", "accel")):
            value = mpjpe / (1 + at) / (1 + number)
            out |= {
                f"{metric}{part}": value,
                f"{metric}{part}_mean_pose": 200.0,
                f"{metric}{part}_nearest_train_clip": 50.0,
            }
    return out


def reconstruction(mpjpe: float, *, clips: int = 40, hands: bool = True) -> dict[str, Any]:
    """`metrics.json` of a tokenizer alone."""
    return {
        "split": "test",
        "clips": clips,
        "reconstructed_clips": clips,
        "bits_per_second": 100.0,
        "reconstruction_mm": errors(mpjpe, hands=hands),
    }


def of(mean: float, half: float = 0.0) -> dict[str, float]:
    """An interval as JSON has it."""
    return {"mean": mean, "half_width": half}


def by_text(
    fid: float, m2t: float, *, generators: list[str], judge: str = "a", size: int = 32
) -> dict[str, Any]:
    """`metrics.json` of motions made for captions."""
    return {
        "split": "test",
        "clips": 40,
        "retrieval": {
            "among": 40,
            "clips": 40,
            "size": size,
            "chance": {f"r{k}": k / size for k in (1, 2, 3)},
            "real": {f"m2t_r{k}": of(0.9) for k in (1, 2, 3)} | {"matching_score": of(0.5), "top-1": of(0.4)},
            "generated": {f"m2t_r{k}": of(m2t, 0.01) for k in (1, 2, 3)}
            | {"matching_score": of(0.8), "top-1": of(0.25), "top-5": of(0.5)},
        },
        "distribution": {
            "clips": 40,
            "training_clips": 40,
            "rows": {
                "generated": {"fid": of(fid, 0.2), "diversity": of(1.0), "multimodality": of(0.3)},
                "recorded": {"diversity": of(1.2)},
                "training": {"fid": of(0.1), "diversity": of(1.1)},
                "mean_pose": {"fid": of(9.0), "diversity": of(0.0)},
            },
        },
        "protocol": {
            "repeats": 2,
            "lengths": "free",
            "generators": generators,
            "evaluator": {"stage": "tma", "sha256": judge},
        },
    }
