"""Finished stages of another run with the same fingerprint, taken over into a run that has not made them.

What they made is linked, not copied, where the file system can: outputs are only ever replaced as whole
files. The rest (checkpoints, logs, notes) is copied, so that each run can go on without touching the other.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from pathlib import Path

from motionloom.datasets.schema import UserError
from motionloom.pipeline.runs.graph import PlannedStage
from motionloom.pipeline.store.artifact import Artifact
from motionloom.pipeline.store.files import remove_tree
from motionloom.pipeline.store.run_folder import stage_folder


def take_over(plan: Sequence[PlannedStage], run: Path, others: Sequence[Path]) -> dict[str, Path]:
    """Stages that `run` would begin and another run has finished; the runs they were taken from, by name."""
    taken = {}
    for name, source in to_take_over(plan, run, others).items():
        try:
            _copy(stage_folder(source, name), stage_folder(run, name))
        except OSError:  # made anew there, or here by another process, at this moment
            continue
        taken[name] = source
    return taken


def to_take_over(plan: Sequence[PlannedStage], run: Path, others: Sequence[Path]) -> dict[str, Path]:
    """As `take_over`, and nothing is done yet."""
    found = {}
    for row in plan:
        name = row.stage.name
        if row.action != "run" or row.asked or stage_folder(run, name).exists():
            continue
        source = next((other for other in others if _holds(stage_folder(other, name), row.fingerprint)), None)
        if source is not None:
            found[name] = source
    return found


def _holds(folder: Path, fingerprint: str) -> bool:
    try:
        artifact = Artifact.find(folder)
    except UserError:
        return False
    return artifact is not None and artifact.fingerprint == fingerprint and artifact.missing(folder) is None


def _copy(source: Path, target: Path) -> None:
    """Whole or not at all: a kill midway leaves a folder that no run looks at."""
    artifact = Artifact.load_json(source / "artifact.json")
    half = target.with_name(f".{target.name}.taken")
    remove_tree(half)
    for path in sorted(source.rglob("*")):
        if not path.is_file():
            continue
        copy = half / path.relative_to(source)
        copy.parent.mkdir(parents=True, exist_ok=True)
        if path.relative_to(source).as_posix() in artifact.outputs:
            _link(path, copy)
        else:
            shutil.copy2(path, copy)
    half.rename(target)


def _link(path: Path, copy: Path) -> None:
    try:
        os.link(path, copy)
    except OSError:  # another file system, or one without links
        shutil.copy2(path, copy)
