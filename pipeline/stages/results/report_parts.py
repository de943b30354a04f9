"""Parts of the report: what stages have to show, how the trainings ran, and what was run on which data.

A page made within a run names no times and no machine, since equal runs write equal pages; one made by
`motionloom report` does.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import fmean

from motionloom.datasets.base.json_doors import parse_json
from motionloom.datasets.base.progress import duration
from motionloom.datasets.motion.npz import NpzFile
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.contract.showing import Bars, Confusions, FigureTable, JointErrors, Showing
from motionloom.pipeline.contract.stage import CompletedStage, StageContext, stage_kind
from motionloom.pipeline.render.charts import curve_label, log_lines, own_lines
from motionloom.pipeline.render.page import Page
from motionloom.pipeline.render.viewer import Clips, ViewerMotion
from motionloom.pipeline.store.artifact import Terms
from motionloom.pipeline.store.data import Data
from motionloom.pipeline.store.run_state import RunState
from motionloom.pipeline.store.training_log import (
    SAMPLE_FIGURES,
    SAMPLES,
    read_flight,
    read_rows,
    read_starts,
    read_training_log,
    rise_of_loss,
)
from motionloom.pipeline.store.yaml import flatten, setting_text

SPLITS = ("train", "val", "test")


def draw_evaluations(page: Page, shown: Sequence[Showing]) -> None:
    """What evaluations have to show: tables, then where the model errs."""
    draw_showings(page, "Figures on held-out clips", shown, FigureTable)
    draw_showings(page, "Where it errs", shown, JointErrors, Confusions, Clips)


def draw_showings(page: Page, heading: str, shown: Sequence[Showing], *kinds: type[Showing]) -> None:
    """Draw what is of these kinds under a heading, kind by kind; nothing where there is none."""
    things = [thing for kind in kinds for thing in shown if isinstance(thing, kind)]
    if things:
        page.add_heading(heading)
    for thing in things:
        if isinstance(thing, FigureTable):
            page.add_table(list(thing.columns), [list(row) for row in thing.rows], thing.title, pinned=True)
        elif isinstance(thing, JointErrors):
            page.add_joint_errors(thing.errors, thing.skeleton, thing.title)
        elif isinstance(thing, Confusions):
            page.add_matrix(thing.counts, thing.title)
        elif isinstance(thing, Clips):
            page.add_subheading(thing.title).add_viewer(thing.motions)
        elif isinstance(thing, Bars):
            uses = {thing.y_label: thing.values}
            ends = (0, len(thing.values))
            page.add_histogram(uses, ends, thing.title, thing.x_label, thing.y_label)


_FLOWN = {
    "lr": "learning rate",
    "grad_norm": "norm of the gradients",
    "frames_per_second": "frames a second",
    "tokens_per_second": "tokens a second",
}


def draw_curves(page: Page, stages: Sequence[CompletedStage], *, flights: bool = False) -> None:
    """Curves of trainings, finished or running; with `flights` also what equal runs do not share: rate, norms
    of gradients and speed, where the training went on after a kill, and what was drawn meanwhile.
    """
    page.add_heading("Training")
    for stage in stages:
        rows = read_training_log(stage.folder)
        starts = read_starts(stage.folder) if flights else []
        marks = [step for step, _ in starts]
        page.add_plot(log_lines(rows, "loss", "loss"), f"{stage.name}: loss", marks)
        keys = sorted({k.partition("/")[2] for row in rows for k in row if "/" in k} - {"loss"})
        for curve in stage.kind.curves:
            named = [key for key in keys if key.startswith(curve.prefix)]
            lines = [line for key in named for line in log_lines(rows, key, curve_label(key))]
            page.add_plot(lines, f"{stage.name}: {curve.title or curve_label(curve.prefix)}", marks)
        if flights:
            flown = read_flight(stage.folder).get(0, [])
            for figure, title in _FLOWN.items():
                page.add_plot(own_lines(flown, figure), f"{stage.name}: {title}", marks)
            for step, reached in starts:
                page.add_text(f"{stage.name} was ended at step {reached} or later, and went on from {step}.")
        if risen := rise_of_loss(rows):
            page.add_text(f"{stage.name}: {risen}.")
        if flights:
            _draw_samples(page, stage)


def _draw_samples(page: Page, stage: CompletedStage) -> None:
    """The figures of the motions that were drawn during a training (`train.sample_every`), and the newest."""
    folder = stage.folder / SAMPLES
    rows = read_rows(folder / SAMPLE_FIGURES)
    for name in sorted({key.partition("/")[2] for row in rows for key in row if "/" in key}):
        page.add_plot(log_lines(rows, name, "samples", splits=("drawn", "recorded")), f"{stage.name}: {name}")
    step = int(rows[-1]["step"]) if rows else 0
    motions = []
    for path in sorted(folder.glob(f"step={step:08d}/*.npz")):
        with NpzFile(path) as stored:
            facts = parse_json(str(stored.array("metadata")), str(path))
            joints = stored.numbers("joints")
        parents = Skeleton.named(facts["skeleton"]).parents
        motions.append(ViewerMotion(joints, facts["fps"], parents, f"step {step:,}", facts["caption"]))
    if motions:
        page.add_viewer(motions, f"{stage.name}: motions for captions or music of held-out clips.")


# What the flight recorders noted: it holds times, so a page made within a run does not have it.

Rows = Sequence[Mapping[str, float]]


def draw_flights(page: Page, state: RunState) -> None:
    """Speed, waits and step times of every training."""
    flights = {stage.name: read_flight(stage.folder) for stage in state.stages}
    flights = {name: ranks for name, ranks in flights.items() if ranks}
    if not flights:
        return
    page.add_heading("How the trainings ran")
    page.add_text("As the flight recorders saw it, a row every 10 steps.")
    columns = ["training", "samples/s", "s a step", "waited for data, %", "for checkpoints, %"]
    columns += ["for other ranks, %"]
    table = [[name, *_waits(ranks)] for name, ranks in flights.items()]
    page.add_table(columns, table, "Speed and waits, means of the rows and ranks", digits=2, pinned=True)


def _waits(ranks: Mapping[int, Rows]) -> list[float | str | None]:
    rows = [row for own in ranks.values() for row in own]
    waits = (100 * _mean(rows, f"waited/{cause}") for cause in ("data", "checkpoints", "ranks"))
    return [_mean(rows, "samples_per_second"), _mean(rows, "step_seconds"), *waits]


def _mean(rows: Rows, name: str) -> float:
    values = [row[name] for row in rows if name in row]
    return fmean(values) if values else 0.0


# What was run.


def say_missing(page: Page, state: RunState) -> None:
    """Return a note on the parts that the run does not have yet, if any."""
    lines = [f"{stage.name}: {stage.say()}" for stage in state.unfinished if stage.kind != "report"]
    if not lines:
        return
    page.add_heading("Still missing")
    page.add_text(
        f"{len(lines)} of {len(state.stages)} stages are not there, so this page shows less than that of a "
        f"finished run. Go on with: motionloom run {state.folder / 'recipe.yaml'} -o {state.folder}"
    )
    page.add_list(lines)


def add_run_facts(page: Page, context: StageContext, state: RunState | None) -> None:
    """Stages, sizes of the data, settings."""
    page.add_heading("What was run")
    if state is None:
        _stages_of_recipe(page, context)
    else:
        _stages_of_run(page, state)
    if "data" in context.inputs:
        _data(page, context.given["data"])
    if credits := Terms.of(stage.folder for stage in context.inputs.values()).credits:
        page.add_subheading("Credits").add_list(credits)
    with page.folded("Settings of every stage"):
        for name, kind, settings in _settings(context, state):
            rows = [[key, setting_text(value)] for key, value in flatten(settings).items()]
            page.add_table(["setting", "value"], rows, f"{name} ({kind})")


def _stages_of_recipe(page: Page, context: StageContext) -> None:
    rows = []
    for stage in _upstream(context):
        train = getattr(stage.config, "train", None)
        steps = getattr(train, "steps", None)
        rows.append([stage.name, stage.kind.summary, f"{steps:,}" if steps else None])
    page.add_table(["stage", "what it makes", "steps"], rows, f"The stages of this page, seed {context.seed}")
    page.add_text("Times, speed, learning rates and resumes are on the page that motionloom report makes.")


def _stages_of_run(page: Page, state: RunState) -> None:
    known = [stage.seconds for stage in state.stages if stage.seconds is not None]
    noted = list(dict.fromkeys(stage.hardware for stage in state.stages if stage.hardware))
    rows = []
    for stage in state.stages:
        summary = stage_kind(stage.kind, f"{state.folder / 'recipe.yaml'}: stages.{stage.name}").summary
        steps = None if stage.steps is None else f"{stage.steps:,}"
        time = None if stage.seconds is None else duration(stage.seconds)
        rows.append([stage.name, summary, stage.say(), steps, time, stage.hardware or None])
    done = sum(stage.usable for stage in state.stages)
    page.add_facts(
        {
            "recipe": state.recipe,
            "seed": "not said" if state.seed is None else str(state.seed),
            "stages finished": f"{done} of {len(state.stages)}",
            "time of finished stages": duration(sum(known)) if known else "not noted",
            "ran on": "; ".join(noted) or "not noted",
        }
    )
    columns = ["stage", "what it makes", "state", "steps", "time", "ran on"]
    page.add_table(columns, rows, "The stages of the run", pinned=True)


def _data(page: Page, data: Data) -> None:
    rows = []
    for split in SPLITS:
        if split not in data.splits:
            continue
        clips = data.split(split)
        minutes = float(clips.frames.sum()) / clips.layout.fps / 60
        said = int(clips.has("texts.json").sum())
        music = int(clips.has("audio.flac").sum())
        rows.append([split, f"{len(clips):,}", f"{minutes:,.1f}", f"{said:,}", f"{music:,}"])
    layout = data.layout
    page.add_table(
        ["split", "clips", "minutes", "with a caption", "with music"],
        rows,
        f"The data: {layout.num_joints} joints at {layout.fps:g} frames a second, layout {layout.name}",
    )


def _settings(context: StageContext, state: RunState | None) -> Iterator[tuple[str, str, dict[str, object]]]:
    if state is not None:
        for stage in state.stages:
            yield stage.name, stage.kind, dict(stage.settings)
        return
    for finished in _upstream(context):
        yield finished.name, finished.kind.name, finished.config.dump()


def _upstream(context: StageContext) -> list[CompletedStage]:
    """The stages that the page is made from, those that others read first."""
    out: dict[Path, CompletedStage] = {}

    def take(stage: CompletedStage) -> None:
        if stage.folder not in out:
            for above in stage.inputs.values():
                take(above)
            out.setdefault(stage.folder, stage)

    for stage in context.inputs.values():
        take(stage)
    return list(out.values())
