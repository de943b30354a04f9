"""One part of a recipe's conversion, made in the run folder before the stage itself is run there.

    python -m motionloom.pipeline.cluster.convert_part RECIPE OUT STAGE STEP COUNT [SETTING ...]

is what each of COUNT tasks of a SLURM array or pods of an Indexed Job runs (`plan.py`). STEP is `features` or
`shards`. Which part it is says the engine's own variable. The stage, run after all parts, finds their shards,
makes what is missing and writes index and manifest.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

from motionloom.datasets.convert.common.conversion import run_conversion
from motionloom.datasets.convert.table import converter_named
from motionloom.datasets.schema import UserError
from motionloom.datasets.shards.options import Part
from motionloom.pipeline.launch.convert_job import Step
from motionloom.pipeline.runs.graph import PlannedStage, begin, make_plan
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.stages.convert import ConvertStage
from motionloom.pipeline.store.data import SHARDS
from motionloom.pipeline.store.run_folder import stage_folder

INDEX_VARIABLES = ("SLURM_ARRAY_TASK_ID", "JOB_COMPLETION_INDEX")
"""Where SLURM and Kubernetes say which part a process is."""

WORKERS_VARIABLES = ("SLURM_CPUS_PER_TASK", "MOTIONLOOM_WORKERS")
"""How many processes a part may start."""


def make_part(
    recipe: str | Path,
    run: Path,
    name: str,
    part: Part,
    *,
    overrides: Sequence[str] = (),
    workers: int = 1,
    patience_seconds: float = 1800.0,
    poll_seconds: float = 5.0,
) -> str:
    """Make a part of the stage `name`; returns one line about it.

    Part 0 alone clears the stage's folder, where it holds something else; the others wait for that.
    """
    loaded = load_recipe(recipe, overrides)
    stage = loaded.stage(name)
    if not isinstance(stage.kind, ConvertStage):
        raise UserError(f"stage '{name}' is of kind {stage.kind.name}: only conversions are made in parts")
    row = next(row for row in make_plan(loaded, run) if row.stage.name == name)
    if row.action == "skip":
        return "finished already"
    folder = stage_folder(run, name)
    if row.action == "run" and part.index == 0:
        begin(run, row)
    deadline = time.monotonic() + patience_seconds
    while not _begun(folder, row):
        if time.monotonic() > deadline:
            raise UserError(
                f"{folder}: part 0 has not begun the stage in {patience_seconds / 60:g} minutes; start the "
                f"parts again, part 0 among the first"
            )
        time.sleep(poll_seconds)
    conversion = converter_named(stage.kind.name).prepare(stage.config, out=folder / SHARDS, workers=workers)
    if part.step == "features" and conversion.features is None:
        return "this source has no features step"
    made = run_conversion(conversion, folder / SHARDS, workers=workers, progress=False, part=part)
    return f"{len(made.shards)} shards, {sum(shard.samples for shard in made.shards)} clips"


def _begun(folder: Path, row: PlannedStage) -> bool:
    """Whether the folder is this stage's, unfinished; as the plan of the run decides it."""
    started = folder / "started.json"
    if (folder / "artifact.json").exists() or not started.is_file():
        return False
    return bool(json.loads(started.read_text())["fingerprint"] == row.fingerprint)


def _number(environment: Mapping[str, str], names: Sequence[str], default: int | None = None) -> int:
    for name in names:
        if name in environment:
            return int(environment[name])
    if default is None:
        raise UserError(
            f"which part to make is in none of {', '.join(names)}: start this as an array of jobs"
        )
    return default


def main(arguments: Sequence[str]) -> int:
    """Make the part that the environment names; exit code 2 for a user's mistake, as `motionloom` has it."""
    recipe, out, name, step, count = arguments[:5]
    try:
        index = _number(os.environ, INDEX_VARIABLES)
        workers = _number(os.environ, WORKERS_VARIABLES, default=1)
        part = Part(index, int(count), cast(Step, step))  # type: ignore[arg-type]
        said = make_part(recipe, Path(out), name, part, overrides=arguments[5:], workers=workers)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        return 2
    print(f"{name}: {step} {index + 1} of {count}: {said}", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
