"""The plan of a run for programs: what `motionloom run --dry-run --json` prints."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from motionloom.pipeline.runs.estimate import estimate
from motionloom.pipeline.runs.graph import PlannedStage, Selection, make_plan, require_fit
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.runs.replace import replaced_stages, started_trainings


def plan_record(
    recipe: str | Path,
    out: Path | None = None,
    *,
    overrides: Sequence[str] = (),
    select: Selection | None = None,
) -> dict[str, Any]:
    """The stages in order, each with what happens to it and why, and what its training takes.

    `replaces` are stages that the run would delete, which it refuses without `--replace`, and trainings that
    it would begin anew. Refuses what the run would refuse.
    """
    loaded = load_recipe(recipe, overrides)
    run = out or Path("runs") / loaded.name
    plan = make_plan(loaded, run, select)
    todo = [row for row in plan if row.action in {"run", "resume"}]
    require_fit(todo, loaded.hardware)
    cards = estimate(loaded, {row.stage.name for row in todo})
    return {
        "recipe": loaded.name,
        "folder": run,
        "hardware": loaded.hardware,
        "stages": [_row(row, cards) for row in plan],
        "replaces": {
            "finished": [one.stage for one in replaced_stages(run, plan)],
            "started": started_trainings(run, plan),
        },
    }


def _row(row: PlannedStage, cards: dict[str, Any]) -> dict[str, Any]:
    stage = row.stage
    return {
        "stage": stage.name,
        "kind": stage.kind.name,
        "action": row.action,
        "reason": row.reason,
        "inputs": stage.inputs,
        "fingerprint": row.fingerprint,
        "training": cards.get(stage.name),
    }
