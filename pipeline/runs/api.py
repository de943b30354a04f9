"""The Python API behind the commands: run a recipe, evaluate, report, export.

Without a console they speak on standard output.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from motionloom.datasets.base.files import atomic_path
from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.lookup import finished_stages, preview_of
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import Finished, Shelf, Stage, StageContext
from motionloom.pipeline.contract.units import WORK
from motionloom.pipeline.launch.console import make_console
from motionloom.pipeline.launch.hardware import choose_device
from motionloom.pipeline.launch.team import Team
from motionloom.pipeline.runs.branch import bring_inputs, find_branch, require_same_network
from motionloom.pipeline.runs.graph import (
    Selection,
    execute,
    make_plan,
    plan_table,
    require_fit,
    selected,
    stage_inputs,
)
from motionloom.pipeline.runs.perform import perform
from motionloom.pipeline.runs.recipe import Recipe, load_recipe
from motionloom.pipeline.runs.replace import replaced_stages, require_asked, say_replaced, started_trainings
from motionloom.pipeline.store.artifact import require_consistent
from motionloom.pipeline.store.files import new_folder, remove_tree, require_file_place, require_folder
from motionloom.pipeline.store.outside import owner_of
from motionloom.pipeline.store.run_folder import require_run, stage_folder
from motionloom.pipeline.store.run_state import RunState, StageState, run_state


def run_recipe(
    recipe: str | Path,
    out: Path | None = None,
    *,
    overrides: Sequence[str] = (),
    select: Selection | None = None,
    dry_run: bool = False,
    replace: bool = False,
    from_checkpoint: str | None = None,
    profile: int = 0,
    console: Console | None = None,
) -> Path:
    """Run what is not finished; returns the run folder. With `dry_run` only the plan is printed.

    `from_checkpoint` (a step, or a checkpoint's path) has the stage `select.only` branch off (`branch.py`);
    `profile` steps of each training are profiled.

    Without `replace` a run is refused that would make anew what is finished and took long (`replace.py`), or
    that goes on in the folder of another recipe's run.
    """
    console = console or make_console()
    loaded = load_recipe(recipe, [*overrides, f"hardware.profile={profile}"] if profile else overrides)
    run, branch = out or Path("runs") / loaded.name, None
    if from_checkpoint is not None:
        branch = find_branch(loaded, recipe, run, select or Selection(), from_checkpoint)
        loaded = branch.applied(loaded)
        if waiting := bring_inputs(loaded, run, branch, console, dry_run=dry_run):
            console.print(
                f"{', '.join(waiting)} would be taken over from {branch.run}, then {branch.stage} would "
                f"branch off at step {branch.point.step}",
                soft_wrap=True,
            )
            return run
    try:
        plan = make_plan(loaded, run, select)
    except UserError:
        if dry_run:
            _say_estimate(loaded, console)  # it needs no data, the plan looks at them
        raise
    if branch is not None:
        plan = branch.planned(plan, run, replaces=replace or dry_run)
    todo = [row for row in plan if row.action in {"run", "resume"}]
    if branch is not None and any(row.start for row in todo):
        require_same_network(loaded, run, branch)
    if dry_run:
        _say_estimate(loaded, console, [row.stage for row in todo])
        console.print(plan_table(loaded, plan))
        require_fit(todo, loaded.hardware)
    replaced = replaced_stages(run, plan)
    if not replace and dry_run:
        said = say_replaced(run, loaded.name, replaced)
        if said is not None:
            console.print(f"[yellow]without --replace this is refused. {escape(said)}[/]", soft_wrap=True)
    elif not replace:
        require_asked(run, loaded.name, replaced)
    elif replaced:
        console.print(f"[yellow]replaces finished stages: {', '.join(stage.stage for stage in replaced)}[/]")
    if started := started_trainings(run, plan):
        console.print(f"[yellow]replaces unfinished trainings: {', '.join(started)}[/]")
    if dry_run:
        console.print(f"{len(todo)} of {len(plan)} stages would run in {run}", markup=False)
        return run
    chosen = selected(loaded, select or Selection())
    if not todo and len(chosen) < len(plan):
        console.print(
            f"{run}: the selected stages are finished ({len(chosen)} of {len(plan)}), nothing to do",
            markup=False,
        )
    elif not todo:
        console.print(f"{run}: all {len(plan)} stages are finished, nothing to do", markup=False)
    else:
        console.print(
            f"{loaded.name} in {run}: {len(todo)} of {len(plan)} stages to run "
            f"on {loaded.hardware.describe()}",
            markup=False,
        )
    if todo or not (run / "recipe.yaml").is_file():  # all may have been taken over from another run
        execute(loaded, run, plan, console)
    for row in plan:
        page = stage_folder(run, row.stage.name) / "report.html"
        # Not the page of an earlier run with other settings.
        if "page" in row.stage.kind.gives(row.stage.config) and row.action != "leave" and page.is_file():
            console.print(f"watch it: {page.resolve()}", markup=False, soft_wrap=True)
    return run


def _say_estimate(recipe: Recipe, console: Console, todo: Sequence[Stage] | None = None) -> None:
    """What the trainings of the stages `todo` (None = all) would take, where the recipe says enough."""
    from motionloom.pipeline.runs.estimate import estimate, estimate_table

    todo = recipe.stages if todo is None else todo
    if not any(stage.kind.trains for stage in todo):
        return
    stages = {stage.name: stage for stage in recipe.stages}
    for stage in recipe.stages:
        if "data" not in stage.kind.gives(stage.config):
            continue
        try:
            preview_of(stage, {**stages, **recipe.outside})
        except UserError as error:
            console.print(str(error), markup=False)
            return
    console.print(estimate_table(estimate(recipe, {stage.name for stage in todo})))


def _stages_again(
    folder: Path,
    what: str,
    target: str,
    console: Console,
    changes: dict[str, Any],
    device: str = "auto",
    share: bool = False,
    state: RunState | None = None,
) -> Path:
    """Run the stages of a run that give `what` again, into folder `target` of the run.

    The first one writes there, of those of kind `target` if there are some; the others into folders of their
    names within. On `device`: auto is what the recipe's hardware says, and with `share` in as many processes.
    With `state` they get those of their inputs that are finished, else all must be.
    """
    recipe = _recipe_of(folder)
    team = Team.start(recipe.hardware) if share and device == "auto" else Team()
    shelf = Shelf(recipe.hardware.device() if device == "auto" else choose_device(device))
    stages = [s for s in recipe.stages if what in s.kind.gives(s.config)]
    if not stages:
        raise UserError(f"{folder}: its recipe has no {target} stage; add one and run it again")
    stages.sort(key=lambda s: s.kind.name != target)
    for number, stage in enumerate(stages):
        out = folder / target / stage.name if number else folder / target
        _stage_again(folder, recipe, stage, out, target, changes, shelf, console, team, state)
    team.part()
    return folder / target


def _stage_again(
    folder: Path,
    recipe: Recipe,
    stage: Stage,
    out: Path,
    target: str,
    changes: dict[str, Any],
    shelf: Shelf,
    console: Console,
    team: Team,
    state: RunState | None,
) -> None:
    given = {name: value for name, value in changes.items() if value is not None}
    config = stage.kind.config.parse({**stage.config.dump(), **given}, target)
    inputs = stage_inputs(recipe, folder, stage)
    for (name, _), said in recipe.gone.items():
        if name == stage.name and state is None:
            raise UserError(said)
    if state is not None:
        inputs = _finished_inputs(folder, inputs, state)
    for role, source in inputs.items():
        if not source.outside and not (source.folder / "artifact.json").is_file():
            raise UserError(
                f"{folder}: stage '{source.name}' (role {role}) is not finished; run the recipe first"
            )
    for source in inputs.values():
        require_consistent(owner_of(source.folder), [source.folder.name])
    if team.leads:
        out.mkdir(exist_ok=True)
        remove_tree(out / WORK)  # of an evaluation that was killed, maybe with other settings
    context = StageContext(
        name=stage.name,
        recipe=recipe.name,
        config=config,
        folder=out,
        inputs=inputs,
        seed=recipe.seed_of(stage),
        hardware=recipe.hardware,
        console=console,
        shelf=shelf,
        rank=team.rank,
        world=team.world,
        again=state,
    )
    perform(stage.kind, context, team, folder)


def _finished_inputs(folder: Path, inputs: dict[str, Finished], state: RunState) -> dict[str, Finished]:
    """Those of a stage's inputs that are finished, with all that they were made from."""
    whole = {stage.name for stage in state.stages if stage.usable and not _gone(stage)}
    finished = finished_stages(folder) if whole else {}

    def there(stage: Finished) -> bool:
        own = [one.name for one in (stage, *stage.upstream()) if not one.outside]
        return whole.issuperset(own)

    now = {role: source if source.outside else finished.get(source.name) for role, source in inputs.items()}
    return {role: source for role, source in now.items() if source is not None and there(source)}


def _gone(stage: StageState) -> bool:
    """Whether an output of a finished stage is not there any more."""
    return stage.artifact is not None and stage.artifact.missing(stage.folder) is not None


def evaluate_run(
    folder: Path,
    *,
    clips: int | None = None,
    repeats: int | None = None,
    device: str = "auto",
    share: bool = False,
    console: Console | None = None,
) -> Path:
    """Figures of a finished run by all its stages that make some; returns the folder RUN/evaluate.

    With `share` all processes of the recipe's hardware take part, as in `run_recipe`, which start by the
    command that started this one; else this process alone.
    """
    console = console or make_console()
    changes = {"clips": clips, "repeats": repeats}
    return _stages_again(folder, "figures", "evaluate", console, changes, device, share)


def report_run(
    folder: Path, out: Path | None, *, device: str = "auto", console: Console | None = None
) -> Path:
    """The page of a run; returns its path. Of an unfinished run: what there is, and what is missing."""
    console = console or make_console()
    if out is not None:
        require_file_place(out)
    state = run_state(folder)
    page = _stages_again(folder, "page", "report", console, {}, device, state=state) / "report.html"
    if missing := [stage for stage in state.unfinished if stage.kind != "report"]:
        console.print(f"not finished: {', '.join(f'{stage.name} ({stage.say()})' for stage in missing)}")
    if out is not None:
        with atomic_path(out) as whole:
            shutil.copyfile(page, whole)
        page = out
    console.print(str(page.resolve()), markup=False, soft_wrap=True)
    return page


def export_run(
    folder: Path,
    out: Path,
    *,
    half: bool = False,
    sampling: dict[str, Any] | None = None,
    console: Console | None = None,
) -> Path:
    """Copy what generation needs into one folder; with `half`, weights in half precision.

    `sampling` are fields of `SamplingConfig` that motions of this model are drawn with where nobody says
    otherwise.
    """
    from motionloom.pipeline.inference.pretrained import write_bundle

    console = console or make_console()
    drawing = SamplingConfig.parse(sampling or {}, "sampling")
    require_folder(out)
    if out.exists() and any(out.iterdir()):
        raise UserError(f"{out}: exists and is not empty; choose a new folder with --out")
    with new_folder(out.absolute()) as whole:
        write_bundle(folder, whole, half=half, sampling=drawing)
    size = sum(p.stat().st_size for p in out.rglob("*") if p.is_file()) / 2**20
    console.print(
        f'{out}: {size:.1f} MiB; use it: motionloom generate {out} "a person waves"',
        markup=False,
        soft_wrap=True,
    )
    return out


def _recipe_of(folder: Path) -> Recipe:
    require_run(folder)
    return load_recipe(folder / "recipe.yaml", strict=False)
