"""Run folders written by hand: a recipe, records of finished stages, figures. No stage is run."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from motionloom.pipeline.evaluation.figures import (
    CHANCE,
    FILE_NAME,
    NEAREST,
    RECORDED,
    STILL,
    TRAINING,
    Fact,
    Figure,
    FigureFile,
)


def write_run(run: Path, stages: Mapping[str, Mapping[str, Any]]) -> Path:
    """A run of `stages`: name -> kind, config, inputs (role -> stage), figures; in this order.

    A stage with `finished: False` stands in the recipe alone.
    """
    run.mkdir(parents=True, exist_ok=True)
    entries = {name: {"kind": stage["kind"], **stage.get("config", {})} for name, stage in stages.items()}
    recipe = {"name": run.name, "stages": entries}
    (run / "recipe.yaml").write_text(yaml.safe_dump(recipe, sort_keys=False))
    for name, stage in stages.items():
        if not stage.get("finished", True):
            continue
        folder = run / "stages" / name
        folder.mkdir(parents=True)
        inputs = {
            role: {"stage": source, "fingerprint": f"of-{source}"}
            for role, source in stage.get("inputs", {}).items()
        }
        record = {
            "stage": name, "kind": stage["kind"], "version": 1, "fingerprint": f"of-{name}", "seed": 0,
            "config": stage.get("config", {}), "inputs": inputs,
        }  # fmt: skip
        (folder / "artifact.json").write_text(json.dumps(record))
        if "figures" in stage:
            stage["figures"].write(folder / FILE_NAME)
    return run


def figure(
    name: str,
    value: float,
    interval: float | None = None,
    *,
    row: str = "",
    protocol: Mapping[str, Fact] | None = None,
    group: str = "",
    better: Any = "",
    unit: str = "",
) -> Figure:
    """A figure in a group of its own family: what stands before the first dot of its name."""
    group, title = group or name.split(".")[0], name.rpartition(".")[2]
    return Figure(name, value, interval, unit, better, row, protocol or {}, group, title)


def reconstruction(mpjpe: float, *, clips: int = 40, hands: bool = True) -> FigureFile:
    """Figures of a tokenizer alone."""
    protocol: dict[str, Fact] = {"split": "test", "clips": clips, "clips_sha256": f"{clips} clips"}
    out = [figure("reconstruction.bits_per_second", 100.0, protocol=protocol)]
    for at, part in enumerate(("", "_body", "_hand") if hands else ("", "_body")):
        for number, metric in enumerate(("mpjpe", "pa_mpjpe", "accel")):
            value = mpjpe / ((1 + at) if hands else 1) / (1 + number)
            for row, error in (("", value), (NEAREST, 50.0), (STILL, 200.0)):
                name = f"reconstruction.{metric}{part}"
                out.append(figure(name, error, row=row, protocol=protocol, better="lower", unit="mm"))
    return FigureFile("evaluate", tuple(out), {"stage": "evaluate", "split": "test"})


def by_text(
    fid: float, m2t: float, *, generator: str, judge: str = "a", size: int = 32, **protocol: Fact
) -> FigureFile:
    """Figures of motions made for captions, judged by TMA."""
    facts: dict[str, Fact] = {
        "split": "test", "clips": 40, "clips_sha256": "40 clips", "lengths": "free", "repeats": 2,
        "sampling.temperature": 1.0, "judge": judge, **protocol,
    }  # fmt: skip
    ranked = facts | {"candidates": size}
    out = [
        figure(f"tma.m2t_r{k}", value, half, row=row, protocol=ranked, group="precision", better="higher")
        for k in (1, 2, 3)
        for row, value, half in (("", m2t, 0.01), (RECORDED, 0.9, None), (CHANCE, k / size, None))
    ]
    for name, value in (("top-1", 0.25), ("top-5", 0.5)):
        out.append(figure(f"tma.{name}", value, protocol=facts | {"candidates": 40}, group="choice"))
    for name, row, value, half in (
        ("fid", "", fid, 0.2), ("fid", TRAINING, 0.1, None), ("fid", STILL, 9.0, None),
        ("diversity", "", 1.0, None), ("diversity", RECORDED, 1.2, None), ("multimodality", "", 0.3, None),
    ):  # fmt: skip
        better = "lower" if name == "fid" else ""
        out.append(figure(f"tma.{name}", value, half, row=row, protocol=facts, group="spread", better=better))
    about = {
        "stage": "evaluate",
        "split": "test",
        "made_by": {"generator": generator},
        "judges": {"tma": {"stage": "tma", "sha256": judge}},
    }
    return FigureFile("evaluate", tuple(out), about)
