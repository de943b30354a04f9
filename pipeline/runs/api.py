"""The Python API behind the commands: run a recipe, evaluate, report, export.

Without a console they speak on standard output.
"""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Collection, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import atomic_path
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import CompletedStage, Stage, StageCache
from motionloom.pipeline.contract.units import WORK
from motionloom.pipeline.launch.console import make_console, say
from motionloom.pipeline.launch.hardware import choose_device
from motionloom.pipeline.launch.process import beside, process_rank, take_place
from motionloom.pipeline.launch.team import Team
from motionloom.pipeline.runs.dry_run import explain_replacements, plan_table, replaced_stages, say_estimate
from motionloom.pipeline.runs.execute import context_of, execute, facts_of, perform
from motionloom.pipeline.runs.plan import Selection, doubts, make_plan, require_fit, selected
from motionloom.pipeline.runs.recipe import Recipe, load_recipe
from motionloom.pipeline.runs.snapshot import run_at
from motionloom.pipeline.store.artifact import require_consistent, require_unchanged
from motionloom.pipeline.store.files import new_folder, remove_tree, require_file_place, require_folder
from motionloom.pipeline.store.run_folder import hint_at, owner_of, require_own, require_run, stage_folder
from motionloom.pipeline.store.run_state import RunState, run_state


def run_recipe(
    recipe: str | Path,
    out: Path | str | None = None,
    *,
    overrides: Sequence[str] = (),
    select: Selection | None = None,
    go_on: Collection[str] = (),
    dry_run: bool = False,
    sizes: bool = False,
    replace: bool = False,
    verify: bool = False,
    mirror: str | None = None,
    console: Console | None = None,
) -> Path:
    """Run what is not finished; returns the run folder. With `dry_run` only the plan is printed, with `sizes`
    too what its trainings take (some seconds each the first time, then remembered).

    With `verify` all files of finished stages are compared with their checksums first. What `mirror` has of
    the run is fetched before, and what is made is put there (`mirror.py`).

    Without `replace`, a run that would replace work that took long (`dry_run.py`), or that would write into
    the folder of another recipe's run, is refused. Trainings in `go_on` go on from their newest checkpoints
    although what they compute has changed (rate, batch, loss weights).
    """
    console = console or make_console()
    loaded = load_recipe(recipe, overrides)
    take_place(loaded.hardware.nodes)
    console.quiet = console.quiet or process_rank() > 0
    run = Path(out or Path("runs") / loaded.name)
    if verify:
        count = sum(require_unchanged(stage_folder(run, stage.name), again=True) for stage in loaded.stages)
        say(console, f"{run}: {count} files have the sha256 that their stages noted")
    dry_run = dry_run or sizes
    chosen = selected(loaded, select or Selection())
    copies = None
    if mirror is not None and not dry_run:
        from motionloom.pipeline.runs.mirror import Mirror

        hardware = loaded.hardware
        # Machines with disks of their own meet before they plan, so that all have what the plan looks at.
        team = Team.start(hardware) if hardware.nodes > 1 else None
        copies = Mirror(mirror, run, console, team, hardware.resolved_devices())
        copies.fetch(sorted(chosen))
    try:
        plan = make_plan(loaded, run, select, go_on)
    except UserError:
        if dry_run:
            say_estimate(loaded, console, measure=sizes)  # it needs no data, the plan looks at them
            console.print(plan_table(loaded))
        raise
    todo = [row for row in plan if row.action in {"run", "resume"}]
    if dry_run:
        require_fit((row.stage for row in todo), loaded.hardware)  # before the estimate, which takes seconds
        say_estimate(loaded, console, run, todo, measure=sizes)
        console.print(plan_table(loaded, plan))
        for doubt in doubts(loaded, run, (row.stage for row in todo)):
            say(console, doubt, "yellow")
    replaced = replaced_stages(run, plan)
    refusal = None if replace else explain_replacements(run, loaded.name, replaced)
    if refusal is not None and not dry_run:
        raise UserError(refusal)
    if refusal is not None:
        console.print(f"[yellow]without --replace this is refused. {escape(refusal)}[/]", soft_wrap=True)
    elif replace and replaced:
        console.print(f"[yellow]replaces stages: {', '.join(stage.stage for stage in replaced)}[/]")
    if dry_run:
        say(console, f"{len(todo)} of {len(plan)} stages would run in {run}")
        return run
    if todo:
        message = (
            f"{loaded.name} in {run}: {len(todo)} of {len(plan)} stages to run "
            f"on {loaded.hardware.describe()}"
        )
    elif len(chosen) < len(plan):
        message = f"{run}: the selected stages are finished ({len(chosen)} of {len(plan)}), nothing to do"
    else:
        message = f"{run}: all {len(plan)} stages are finished, nothing to do"
    say(console, message)
    with copies or nullcontext():
        for row in plan:
            if row.action == "skip" and copies is not None:
                copies.send(row.stage.name)
        if todo or beside() > 1:  # one that has another recipe may think that nothing is to do
            execute(loaded, run, plan, console, copies)
    for row in plan:
        page = stage_folder(run, row.stage.name) / "report.html"
        # Not the page of an earlier run with other settings.
        if "page" in row.stage.kind.gives(row.stage.config) and row.action != "leave" and page.is_file():
            say(console, f"watch it: {page.resolve()}")
    return run


def _stages_again(
    folder: Path,
    what: str,
    target: Path,
    console: Console,
    changes: Mapping[str, object],
    device: str = "auto",
    share: bool = False,
    state: RunState | None = None,
) -> Path:
    """Run the stages of a run that give `what` again, into the folder `target`.

    The first one writes there, of those of the kind of its name if there are some; the others into folders of
    their names within. On `device`: auto is what the recipe's hardware says, and with `share` in as many
    processes.
    With `state` they get those of their inputs that are finished, else all must be.
    """
    require_run(folder)
    require_own(folder)
    recipe = load_recipe(folder / "recipe.yaml")
    take_place(recipe.hardware.nodes)
    facts = {**facts_of(recipe, folder, ()), **changes}
    team = Team.start(recipe.hardware, facts) if share and device == "auto" else Team()
    stage_cache = StageCache(recipe.hardware.device() if device == "auto" else choose_device(device))
    stages = [s for s in recipe.stages if what in s.kind.gives(s.config)]
    if not stages:
        raise UserError(f"{folder}: its recipe has no {target.name} stage; add one and run it again")
    stages.sort(key=lambda s: s.kind.name != target.name)
    wanted = {name: value for name, value in changes.items() if value is not None}
    for number, stage in enumerate(stages):
        out = target / stage.name if number else target
        applied = {name: value for name, value in wanted.items() if name in stage.kind.config.model_fields}
        config = stage.kind.config.parse({**stage.config.dump(), **applied}, target.name)
        inputs = _inputs_again(folder, recipe, stage, state)
        if team.leads:
            out.mkdir(parents=True, exist_ok=True)
            remove_tree(out / WORK)  # of an evaluation that was killed, maybe with other settings
        context = context_of(recipe, folder, stage, out, console, team, stage_cache)
        again = None if state is None else folder
        context = dataclasses.replace(context, config=config, inputs=inputs, again=again)
        perform(stage.kind, context, team, folder)
    return target


def _inputs_again(
    folder: Path, recipe: Recipe, stage: Stage, state: RunState | None
) -> dict[str, CompletedStage]:
    """The inputs of a stage; with `state` those that are finished, with all that they were made from."""
    stages = {**recipe.outside, **finished_stages(folder)}
    inputs = {role: stages[name] for role, name in stage.inputs.items() if name in stages}
    if state is None:
        missing = [
            f"{folder}: stage '{name}' (role {role}) is not finished; run the recipe first{hint_at(folder)}"
            for role, name in stage.inputs.items()
            if role not in inputs
        ]
        if missing:
            raise UserError(missing[0])
    else:
        lacking = {
            one.folder
            for one in state.stages
            if not one.usable or (one.artifact is not None and one.artifact.missing(one.folder) is not None)
        }
        inputs = {
            role: source
            for role, source in inputs.items()
            if lacking.isdisjoint(above.folder for above in (source, *source.upstream()))
        }
    for source in inputs.values():
        require_consistent(owner_of(source.folder), [source.folder.name])
    return inputs


def evaluate_run(
    folder: Path | str,
    *,
    at: str | None = None,
    clips: int | None = None,
    repeats: int | None = None,
    device: str = "auto",
    share: bool = False,
    console: Console | None = None,
) -> Path:
    """Figures of a finished run by all its stages that make some; returns the folder RUN/evaluate.

    With `at` trainings that are not finished are taken from a checkpoint (`snapshot.run_at`), this process
    alone measures, and the folder is RUN/at/NAME/evaluate.

    With `share` all processes of the recipe's hardware take part, as in `run_recipe`, which start by the
    command that started this one; else this process alone.
    """
    folder = Path(folder)
    console = console or make_console()
    changes = {"clips": clips, "repeats": repeats}
    with run_at(folder, at) as run:
        out = _beside(folder, run) / "evaluate"
        share = share and at is None
        return _stages_again(run, "figures", out, console, changes, device, share)


def _beside(folder: Path, run: Path) -> Path:
    """Where results of `run` go, which is the run in `folder` or a snapshot of it."""
    require_own(folder)
    return folder if run == folder else folder / "at" / run.name


def report_run(
    folder: Path | str,
    out: Path | str | None,
    *,
    at: str | None = None,
    device: str = "auto",
    console: Console | None = None,
) -> Path:
    """The page of a run; returns its path. Of an unfinished run: what there is, and what is missing.

    With `at` it shows what the trainings make at a checkpoint (`snapshot.run_at`), and lies in RUN/at.
    """
    folder = Path(folder)
    out = None if out is None else Path(out)
    console = console or make_console()
    if out is not None:
        require_file_place(out, ".html")
    with run_at(folder, at) as run:
        state = run_state(run)
        made = _beside(folder, run) / "report"
        page = _stages_again(run, "page", made, console, {}, device, state=state) / "report.html"
    if missing := [stage for stage in state.unfinished if stage.kind != "report"]:
        console.print(f"not finished: {', '.join(f'{stage.name} ({stage.say()})' for stage in missing)}")
    if out is not None:
        with atomic_path(out) as whole:
            shutil.copyfile(page, whole)
        page = out
    say(console, page.resolve())
    return page


def export_run(
    folder: Path | str,
    out: Path | str,
    *,
    at: str | None = None,
    half: bool = False,
    sampling: SamplingConfig | Mapping[str, object] | None = None,
    console: Console | None = None,
) -> Path:
    """Copy what generation needs into one folder; with `half`, weights in half precision.

    `sampling` are fields of `SamplingConfig` that motions of this model are drawn with where nobody says
    otherwise. With `at` trainings that are not finished are taken from a checkpoint (`snapshot.run_at`);
    their artifacts say the step.
    """
    folder = Path(folder)
    out = Path(out)
    from motionloom.pipeline.inference.exported import write_bundle

    console = console or make_console()
    require_folder(out)
    if out.exists() and any(out.iterdir()):
        raise UserError(f"{out}: exists and is not empty; choose a new folder with --out")
    with run_at(folder, at) as run, new_folder(out.absolute()) as whole:
        terms = write_bundle(run, whole, half=half, sampling=SamplingConfig.of(sampling))
    size = sum(p.stat().st_size for p in out.rglob("*") if p.is_file()) / 2**20
    say(console, f'{out}: {size:.1f} MiB; use it: motionloom generate {out} "a person waves"')
    listed = ", ".join(terms.licences) or "none stated"
    say(
        console,
        f"licence of this model: {terms.licence}, the strictest of its data ({listed}); its README.md has "
        f"the credits that it asks for ({len(terms.credits)})",
    )
    return out
