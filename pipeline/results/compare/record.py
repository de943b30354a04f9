"""The comparison as plain JSON, for programs."""

from __future__ import annotations

import math
from collections.abc import Sequence

from motionloom.pipeline.evaluation.figures import Figure
from motionloom.pipeline.results.compare.curves import CurveChart
from motionloom.pipeline.results.compare.runs import ABSENT, ComparedRun, StageDifferences
from motionloom.pipeline.results.compare.tables import ComparedTable


def comparison_record(
    runs: Sequence[ComparedRun],
    differences: Sequence[StageDifferences],
    charts: Sequence[CurveChart],
    tables: Sequence[ComparedTable],
) -> dict[str, object]:
    """Runs, settings that differ, ends of curves, and figures with who is best; logs have whole curves."""
    return {
        "runs": [_run(run) for run in runs],
        "settings": [
            {
                "stage": stage.stage or None,
                "missing": list(stage.missing),
                "differences": {
                    one.key: {
                        run.label: value
                        for run, value in zip(runs, one.values, strict=True)
                        if value is not ABSENT
                    }
                    for one in stage.differences
                },
            }
            for stage in differences
        ],
        "curves": [
            {
                "stage": chart.stage,
                "figure": chart.figure,
                "run": curve.run.label,
                "split": curve.split,
                "points": len(curve.values),
                "last_step": curve.steps[-1],
                "last": _finite(curve.values[-1]),
                "lowest": _finite(min(curve.values)),
                "highest": _finite(max(curve.values)),
            }
            for chart in charts
            for curve in chart.curves
        ],
        "tables": [_table(table) for table in tables],
    }


def _run(run: ComparedRun) -> dict[str, object]:
    state = run.state
    return {
        "name": run.label,
        "folder": str(state.folder.resolve()),
        "recipe": state.recipe,
        "seed": state.seed,
        "figures": {stage: str(path.resolve()) for stage, path in run.files.items()},
        "stages": [
            {
                "name": stage.name,
                "kind": stage.kind,
                "state": stage.progress,
                "step": stage.step,
                "steps": stage.steps,
                "seconds": stage.seconds,
            }
            for stage in state.stages
        ],
    }


def _table(table: ComparedTable) -> dict[str, object]:
    return {
        "title": table.title,
        "stage": table.stage,
        "columns": [_column(column) for column in table.columns],
        "runs": [
            {
                "run": row.run.label,
                "measured_as": row.protocol,
                "figures": {name: _figure(figure) for name, figure in row.figures.items()},
                "best": {name: "sure" if sure else "within intervals" for name, sure in row.best.items()},
            }
            for row in table.rows
        ],
        "references": [
            {
                "title": row.title,
                "runs": list(row.runs) or None,
                "figures": {name: _figure(figure) for name, figure in row.figures.items()},
            }
            for row in table.references
        ],
        "difference": table.difference or None,
        "missing": list(table.missing),
    }


def _column(column: Figure) -> dict[str, object]:
    return {
        "name": column.name,
        "title": column.title,
        "unit": column.unit or None,
        "better": column.better or None,
    }


def _figure(figure: Figure) -> dict[str, object]:
    return {"value": figure.value, "interval": figure.interval, "over": figure.over or None}


def _finite(value: float) -> float | None:
    """JSON has no number for what a diverged training logs."""
    return value if math.isfinite(value) else None
