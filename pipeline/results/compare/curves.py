"""Training curves of several runs over the same axes, from their `metrics.jsonl`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from motionloom.pipeline.results.compare.runs import ComparedRun, stage_names

FIRST = ("loss", "recon", "contrastive", "ce", "accuracy")
"""What a name may begin with, or end in behind the name of a stream, that is drawn before the others."""
OPEN = 4
"""Charts of a stage that are not folded away."""


@dataclass(frozen=True)
class RunCurve:
    """A figure of one run's training or validation, with the steps it was logged at."""

    run: ComparedRun
    split: str
    """"train" or "val"."""
    steps: tuple[float, ...]
    values: tuple[float, ...]


@dataclass(frozen=True)
class CurveChart:
    """One chart: a figure of a stage, of every run that has logged it."""

    stage: str
    figure: str
    curves: tuple[RunCurve, ...]
    open: bool
    """Among the first of its stage."""


def curve_charts(runs: Sequence[ComparedRun]) -> list[CurveChart]:
    """Charts of every stage that any run has a log of, the most telling first."""
    out: list[CurveChart] = []
    for stage in stage_names(runs):
        logs = [(run, run.logs.get(stage, [])) for run in runs]
        keys = {key.partition("/")[2] for _, rows in logs for row in rows for key in row if "/" in key}
        for number, figure in enumerate(sorted(keys, key=_place)):
            curves = tuple(curve for run, rows in logs for curve in _curves(run, rows, figure))
            out.append(CurveChart(stage, figure, curves, number < OPEN))
    return out


def _place(figure: str) -> tuple[int, str]:
    for number, name in enumerate(FIRST):
        if figure == name or figure.startswith(f"{name}_") or figure.endswith(f"_{name}"):
            return number, figure
    return len(FIRST), figure


def _curves(run: ComparedRun, rows: Sequence[dict[str, float]], figure: str) -> list[RunCurve]:
    out = []
    for split in ("train", "val"):
        key = f"{split}/{figure}"
        points = [(row["step"], row[key]) for row in rows if key in row]
        if points:
            steps, values = zip(*points, strict=True)
            out.append(RunCurve(run, split, steps, values))
    return out
