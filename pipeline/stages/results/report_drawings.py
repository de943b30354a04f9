"""How the report draws what stages have to show: tables, curves, codebooks, motions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from motionloom.pipeline.contract.showing import Bars, FigureTable, Showing
from motionloom.pipeline.contract.stage import Finished
from motionloom.pipeline.evaluation.cases import Clips
from motionloom.pipeline.render.charts import log_lines
from motionloom.pipeline.render.labels import curve_label
from motionloom.pipeline.render.page import Page
from motionloom.pipeline.store.run_state import RunState
from motionloom.pipeline.store.training_log import CRASHES, read_flight, read_training_log


def draw_showings(page: Page, heading: str, kind: type[Showing], shown: Sequence[Showing]) -> None:
    """What stages show of one kind, under a heading; nothing where there is none."""
    things = [thing for thing in shown if isinstance(thing, kind)]
    if things:
        page.add_heading(heading)
    for thing in things:
        if isinstance(thing, FigureTable):
            page.add_table(list(thing.columns), [list(row) for row in thing.rows], thing.title, pinned=True)
        elif isinstance(thing, Clips):
            page.add_subheading(thing.title)
            page.add_viewer(thing.motions, thing.note)
        elif isinstance(thing, Bars):
            uses, ends = {thing.y_label: thing.values}, (0, len(thing.values))
            page.add_histogram(uses, ends, thing.title, thing.x_label, thing.y_label)


def draw_curves(page: Page, stages: Sequence[Finished]) -> None:
    """The curves of trainings, finished or going on, that the kinds of stages find worth drawing."""
    page.add_heading("Training")
    for stage in stages:
        rows = read_training_log(stage.folder)
        keys = sorted({k.partition("/")[2] for row in rows for k in row if "/" in k})
        for curve in stage.kind.curves:
            lines = [
                line
                for key in keys
                if key.startswith(curve.prefix)
                for line in log_lines(rows, key, curve_label(key))
            ]
            if lines:
                page.add_plot(lines, f"{stage.name}: {curve.title or curve_label(curve.prefix)}")


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
    crashed = [
        f"{stage.name}: {bundle}"
        for stage in state.stages
        for bundle in sorted((stage.folder / CRASHES).glob("*"))
    ]
    if crashed:
        page.add_text("Batches and tracebacks of what went wrong:")
        page.add_list(crashed)


def _waits(ranks: Mapping[int, Rows]) -> list[float | str | None]:
    rows = [row for own in ranks.values() for row in own]
    shares = [[row.get(f"waited/{cause}", 0.0) for row in rows] for cause in ("data", "checkpoints", "ranks")]
    speeds = [
        _mean([row[name] for row in rows if name in row]) for name in ("samples_per_second", "step_seconds")
    ]
    return [*speeds, *(100 * _mean(share) for share in shares)]


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else 0.0
