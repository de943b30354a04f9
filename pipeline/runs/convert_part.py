"""One part of a recipe's conversion, made in the run folder before the stage itself is run there.

    python -m motionloom.pipeline.runs.convert_part RECIPE OUT STAGE STEP COUNT [SETTING ...]

is what each of COUNT tasks of a SLURM array runs (`launch_plan.py`). STEP is `features` or `shards`; SLURM's
variable says which part this is. The stage, run after all parts, finds their shards, makes what is missing
and writes index and manifest.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from motionloom.datasets.convert.common.conversion import run_conversion
from motionloom.datasets.convert.registry import prepare
from motionloom.datasets.schema import UserError
from motionloom.datasets.shards.options import Part
from motionloom.pipeline.runs.execute import begin
from motionloom.pipeline.runs.plan import PlannedStage, Started, make_plan
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.stages.data.convert import ConvertStage
from motionloom.pipeline.store.data import SHARDS
from motionloom.pipeline.store.run_folder import stage_folder

INDEX, CPUS = "SLURM_ARRAY_TASK_ID", "SLURM_CPUS_PER_TASK"
"""Variables in which SLURM says which part a task is, and how many processes it may start."""


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
    conversion = prepare(stage.config, out=folder / SHARDS, workers=workers)
    if part.step == "features" and conversion.features is None:
        return "this source has no features step"
    made = run_conversion(conversion, folder / SHARDS, workers=workers, progress=False, part=part)
    return f"{len(made.shards)} shards, {sum(shard.samples for shard in made.shards)} clips"


def _begun(folder: Path, row: PlannedStage) -> bool:
    """Whether the folder is this stage's, unfinished; as the plan of the run decides it."""
    started = Started.find(folder)
    return (
        not (folder / "artifact.json").exists()
        and started is not None
        and (started.fingerprint == row.fingerprint)
    )


def main(arguments: Sequence[str]) -> int:
    """Make the part that the environment names; exit code 2 for a user's mistake, as `motionloom` has it."""
    recipe, out, name, step, count = arguments[:5]
    try:
        if INDEX not in os.environ:
            raise UserError(f"{INDEX} does not say which part to make: start this as an array of jobs")
        index, workers = int(os.environ[INDEX]), int(os.environ.get(CPUS, 1))
        part = Part(index, int(count), "features" if step == "features" else "shards")
        said = make_part(recipe, Path(out), name, part, overrides=arguments[5:], workers=workers)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        return 2
    print(f"{name}: {step} {index + 1} of {count}: {said}", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
