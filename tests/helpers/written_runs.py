"""Run folders written by hand: what `compare` and `report` read, without any training."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml


def interval(mean: float, half: float = 0.0) -> dict[str, float]:
    return {"mean": mean, "half_width": half}


def metrics(mpjpe: float = 50.0, r1: float = 0.5, half: float = 0.01, **protocol: Any) -> dict[str, Any]:
    """A small `metrics.json`; keywords change its protocol."""
    rows = {
        "real": {"t2m_r1": interval(0.9), "matching_score": interval(0.4)},
        "generated": {"t2m_r1": interval(r1, half), "matching_score": interval(0.8)},
        "chance": {"r1": 0.125},
    }
    return {
        "version": 6,
        "split": "test",
        "clips": 40,
        "bits_per_second": 100.0,
        "reconstructed_clips": 40,
        "reconstructed_sha256": "r" * 64,
        "reconstruction_mm": {"mpjpe": mpjpe, "mpjpe_mean_pose": 200.0, "mpjpe_nearest_train_clip": 80.0},
        "retrieval": {"size": 8, "among": 8, **rows},
        "distribution": {"rows": {"generated": {"fid": interval(3.0), "diversity": interval(r1)}}},
        "protocol": {
            "clips_sha256": "c" * 64,
            "caption": "the first",
            "lengths": "free",
            "repeats": 2,
            "seed": 7,
            "sampling": {"temperature": mpjpe},
            "evaluator": {"stage": "tma", "sha256": "e" * 64},
            **protocol,
        },
    }


def log(steps: int, start: float = 1.0) -> list[dict[str, float]]:
    """Rows of a training that learns."""
    rows: list[dict[str, float]] = [
        {"step": step, "train/loss": start / step, "train/extra": 1.0} for step in range(10, steps + 1, 10)
    ]
    return [*rows, {"step": steps, "val/loss": start / steps}]


def write_run(
    folder: Path,
    *,
    seed: int = 7,
    stages: Mapping[str, Mapping[str, Any]] | None = None,
    finished: tuple[str, ...] = ("data", "tokenizer", "evaluate"),
    logs: Mapping[str, list[dict[str, float]]] | None = None,
    figures: dict[str, Any] | None = None,
) -> Path:
    """A run whose stages data, tokenizer and evaluate (or `stages`) have settings, logs and figures."""
    entries = {
        "data": {"kind": "synth", "clips": 40},
        "tokenizer": {"kind": "h2vq", "train": {"steps": 100}, "net": {"width": 8}},
        "evaluate": {"kind": "evaluate", "repeats": 2},
    } | dict(stages or {})
    folder.mkdir(parents=True)
    recipe = {"name": "by-hand", "seed": seed, "hardware": {"devices": 0}, "stages": entries}
    (folder / "recipe.yaml").write_text(yaml.safe_dump(recipe, sort_keys=False))
    names = list(entries)
    for number, name in enumerate(names):
        place = folder / "stages" / name
        entry = {k: v for k, v in entries[name].items() if k not in ("kind", "inputs")}
        if name in (logs or {}):
            place.mkdir(parents=True, exist_ok=True)
            text = "".join(json.dumps(row) + "\n" for row in (logs or {})[name])
            (place / "metrics.jsonl").write_text(text)
            (place / "started.json").write_text(json.dumps({"fingerprint": f"print of {name}"}))
        if name not in finished:
            continue
        place.mkdir(parents=True, exist_ok=True)
        above = names[number - 1] if number else None
        inputs = {above: {"stage": above, "fingerprint": f"print of {above}"}} if above else {}
        artifact = {
            "stage": name,
            "kind": entries[name]["kind"],
            "version": 6,
            "fingerprint": f"print of {name}",
            "seed": seed,
            "config": entry,
            "inputs": inputs,
            "outputs": {},
        }
        (place / "artifact.json").write_text(json.dumps(artifact))
        (place / "timing.json").write_text(json.dumps({"seconds": 61.0, "hardware": "an abacus"}))
        if entries[name]["kind"] == "evaluate" and figures is not None:
            (place / "metrics.json").write_text(json.dumps(figures))
    return folder
