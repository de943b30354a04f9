"""Branching: a training of a recipe goes on from a kept checkpoint of an earlier one, with other settings.

`run --only STAGE --from-checkpoint STEP` looks for the checkpoint in the run folder itself, else in that of
the recipe file, else in runs/NAME. What it branched from becomes a setting of the stage (`train.branch`), so
its fingerprint, its artifact and the run's recipe say so, and the run goes on after a kill like any other.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from motionloom.datasets.base.files import sha256_of
from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.stage import Shelf, Stage
from motionloom.pipeline.launch.process import process_rank, srun_tasks
from motionloom.pipeline.runs.beginning import aside_of
from motionloom.pipeline.runs.graph import PlannedStage, Selection, make_plan, selected, stage_inputs
from motionloom.pipeline.runs.recipe import Recipe
from motionloom.pipeline.runs.take_over import take_over, to_take_over
from motionloom.pipeline.stages.train_config import BranchPoint, TrainConfig, TrainedStageConfig
from motionloom.pipeline.store.artifact import Artifact
from motionloom.pipeline.store.background import step_of
from motionloom.pipeline.store.run_folder import stage_folder
from motionloom.pipeline.store.yaml import read_yaml


@dataclass(frozen=True)
class Branch:
    """A stage of a recipe and the checkpoint it is to begin with."""

    stage: str
    point: BranchPoint
    source: Path | None
    """None: the file has gone since this branch was begun."""

    @property
    def run(self) -> Path | None:
        """The run that the checkpoint belongs to."""
        return None if self.source is None else self.source.resolve().parents[3]

    def applied(self, recipe: Recipe) -> Recipe:
        """The recipe with the branch among the stage's settings."""
        stage = recipe.stage(self.stage)
        train = stage.config.train.model_copy(update={"branch": self.point})
        config = stage.config.model_copy(update={"train": train})
        stages = tuple(replace(one, config=config) if one is stage else one for one in recipe.stages)
        return replace(recipe, stages=stages)

    def planned(self, plan: Sequence[PlannedStage], run: Path, *, replaces: bool) -> list[PlannedStage]:
        """The plan with the checkpoint that the stage begins with; refuses to replace a training unasked."""
        return [self._begun(row, run, replaces) if row.stage.name == self.stage else row for row in plan]

    def _begun(self, row: PlannedStage, run: Path, replaces: bool) -> PlannedStage:
        if row.action != "run":
            return row
        if self.source is None:
            raise UserError(
                f"--from-checkpoint {self.point.step}: the checkpoint that stage {self.stage} began with is "
                f"gone and its settings have changed since; name another checkpoint"
            )
        if stage_folder(run, self.stage).exists() and not replaces:
            raise UserError(
                f"{run}: holds a training of stage {self.stage}, which a branch here would replace with its "
                f"checkpoints; -o NEW keeps both, --replace begins it here"
            )
        reason = f"branches off at step {self.point.step} of {self.source}"
        return replace(row, reason=reason, start=self.source)


def find_branch(recipe: Recipe, file: str | Path, run: Path, select: Selection, wanted: str) -> Branch:
    """The branch that `--from-checkpoint wanted` asks for: a step, or the path of a checkpoint."""
    asked = f"--from-checkpoint {wanted}"
    if select.only is None:
        raise UserError(f"{asked} branches off one training: name its stage with --only")
    stage = recipe.stage(select.only, "--only")
    if not isinstance(stage.config, TrainedStageConfig):
        raise UserError(f"{asked}: stage {stage.name} trains nothing")
    train: TrainConfig = stage.config.train
    if wanted.isdecimal():
        step, source = int(wanted), _kept(recipe, file, run, stage, int(wanted))
    else:
        source = Path(wanted)
        found = step_of(source)
        if found is None or not source.is_file():
            raise UserError(f"{asked}: neither a step nor a checkpoint (…/checkpoints/step=XXXXXXXX.ckpt)")
        step = found
    if step >= train.steps:
        raise UserError(
            f"{asked}: stage {stage.name} has train.steps {train.steps}; set more, like "
            f"--set {stage.name}.train.steps={2 * step}"
        )
    begun = _begun_point(run, stage)
    if source is None or (begun is not None and begun.step == step and source.parents[3] == run):
        assert begun is not None  # `_kept` has found it
        return Branch(stage.name, begun, source)
    return Branch(stage.name, BranchPoint(step=step, sha256=sha256_of(source)), source)


def _kept(recipe: Recipe, file: str | Path, run: Path, stage: Stage, step: int) -> Path | None:
    """The checkpoint of a step; None where the branch was begun with one that has gone since."""
    own, places = Path(file).parent, [run]
    if (own / "stages").is_dir():
        places.append(own)
    places.append(Path("runs") / recipe.name)
    seen: dict[Path, list[int]] = {}
    for place in places:
        folder = stage_folder(place, stage.name)
        files = [*(folder / "checkpoints").glob("*.ckpt"), *aside_of(folder).glob("*.ckpt")]
        kept = {found: path for path in files if (found := step_of(path)) is not None}
        if step in kept:
            return kept[step]
        if kept:
            seen.setdefault(place, sorted(kept))
    begun = _begun_point(run, stage)
    if begun is not None and begun.step == step:
        return None
    if not seen:
        looked = ", ".join(str(stage_folder(place, stage.name)) for place in dict.fromkeys(places))
        raise UserError(f"--from-checkpoint {step}: no checkpoints of stage {stage.name} in {looked}")
    said = "; ".join(f"{place} has {', '.join(map(str, steps))}" for place, steps in seen.items())
    raise UserError(
        f"--from-checkpoint {step}: stage {stage.name} has no checkpoint of that step: {said}; "
        f"train.keep_every keeps more of them"
    )


def _begun_point(run: Path, stage: Stage) -> BranchPoint | None:
    """What the stage of this run has branched off from, finished or not."""
    folder = stage_folder(run, stage.name)
    artifact = Artifact.find(folder)
    if artifact is not None:
        settings = artifact.config
    elif (folder / "started.json").is_file() and (run / "recipe.yaml").is_file():
        settings = (read_yaml(run / "recipe.yaml").get("stages") or {}).get(stage.name) or {}
    else:
        return None
    found = (settings.get("train") or {}).get("branch")
    return None if found is None else BranchPoint.parse(found, f"{folder}: train.branch")


def bring_inputs(recipe: Recipe, run: Path, branch: Branch, console: Console, *, dry_run: bool) -> list[str]:
    """Take over what the stage reads from the run of the checkpoint, where this run has not made it.

    In a dry run nothing is done; the names of what would be taken over are returned.
    """
    source = branch.run
    if source is None or source == run.resolve():
        return []
    needed = selected(recipe, Selection(until=branch.stage)) - {branch.stage}
    plan = [row for row in make_plan(recipe, run) if row.stage.name in needed]
    found = to_take_over(plan, run, [source])
    if not found or dry_run:
        return list(found)
    if "RANK" in os.environ or srun_tasks() > 1:
        raise UserError(
            f"{run}: lacks {', '.join(found)}, and a launcher has started several processes, which would all "
            f"take them over; run the same with --until {','.join(found)} first"
        )
    if process_rank() == 0:
        taken = take_over(plan, run, [source])
        console.print(f"taken over from {escape(str(source))}: {', '.join(taken)}", soft_wrap=True)
    return []


def require_same_network(recipe: Recipe, run: Path, branch: Branch) -> None:
    """Refuse, while all is as it was, a checkpoint of another network than the settings make."""
    from motionloom.pipeline.flight.branch import require_branch
    from motionloom.pipeline.stages.trained import TrainedStage

    stage = recipe.stage(branch.stage)
    if branch.source is None or not isinstance(stage.kind, TrainedStage):
        return
    given = Shelf().given(stage_inputs(recipe, run, stage))
    net = stage.kind.network(stage.kind.facts(stage.config, given), given)
    module = stage.kind.module(stage.config, net, given, seed=0)
    require_branch(stage.name, branch.point.step, stage.config.train.steps, branch.source, module)
