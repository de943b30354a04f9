"""How the report draws what stages have to show: tables, curves, bodies, matrices, motions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.contract.showing import Bars, FigureTable, JointMap, Matrix, Showing
from motionloom.pipeline.contract.stage import Finished
from motionloom.pipeline.evaluation.details import Clips
from motionloom.pipeline.render.body_map import body_map
from motionloom.pipeline.render.charts import Line
from motionloom.pipeline.render.labels import curve_label, joint_label
from motionloom.pipeline.render.page import Page
from motionloom.pipeline.store.run_state import RunState
from motionloom.pipeline.store.training_log import CRASHES, read_flight, read_training_log

_ORDER: tuple[tuple[str, type[Showing]], ...] = (
    ("Figures on held-out clips", FigureTable),
    ("Where on the body", JointMap),
    ("What is taken for what", Matrix),
    ("Worst and best", Clips),
)


def draw_showings(page: Page, shown: Sequence[Showing]) -> None:
    """Each kind of thing under a heading of its own."""
    for heading, kind in _ORDER:
        draw_kind(page, heading, [thing for thing in shown if isinstance(thing, kind)])


def draw_bars(page: Page, shown: Sequence[Showing]) -> None:
    """Codebooks."""
    draw_kind(page, "Codebooks", [thing for thing in shown if isinstance(thing, Bars)])


def draw_kind(page: Page, heading: str, things: Sequence[Showing]) -> None:
    """What stages show of one kind; nothing where there is none."""
    if things:
        page.add_heading(heading)
    folded = [thing for thing in things if isinstance(thing, Matrix) and thing.more]
    for thing in things:
        if thing not in folded:
            _draw(page, thing)
    if folded:
        with page.folded("The other attributes of captions"):
            for thing in folded:
                _draw(page, thing)


def _draw(page: Page, thing: Showing) -> None:
    if isinstance(thing, FigureTable):
        page.add_table(list(thing.columns), [list(row) for row in thing.rows], thing.title, pinned=True)
    elif isinstance(thing, Bars):
        page.add_bars(np.asarray(thing.values), thing.title, x_label=thing.x_label, y_label=thing.y_label)
    elif isinstance(thing, JointMap):
        _joints(page, thing)
    elif isinstance(thing, Matrix):
        page.add_matrix(thing.rows, thing.columns, thing.counts, thing.title, thing.corner)
    elif isinstance(thing, Clips):
        page.add_subheading(thing.title)
        page.add_viewer(thing.motions, thing.note)


def _joints(page: Page, thing: JointMap) -> None:
    skeleton = Skeleton.named(thing.skeleton)
    errors = [0.0 if error is None else error for error in thing.errors]
    page.add_drawing(body_map(skeleton, errors, thing.hands, thing.title), thing.title)
    wrists: list[float | None] = [None] * len(skeleton)
    if thing.hands:
        wrists[BODY_JOINTS:] = thing.hands
    rows = [
        [joint_label(joint), error, wrist]
        for joint, error, wrist in zip(skeleton.joints, thing.errors, wrists, strict=True)
    ]
    rows.sort(key=lambda row: -(row[1] if isinstance(row[1], float) else -1.0))
    page.add_folded("The error of every joint", ["joint", "mm, from the root", "mm, from the wrist"], rows)


def draw_curves(page: Page, stages: Sequence[Finished]) -> None:
    """The curves of trainings, finished or going on, that the kinds of stages find worth drawing."""
    page.add_heading("Training")
    for stage in stages:
        rows = read_training_log(stage.folder)
        keys = sorted({k.partition("/")[2] for row in rows for k in row if "/" in k})
        for curve in stage.kind.curves(stage.config):
            lines = [line for key in keys if key.startswith(curve.prefix) for line in _lines(rows, key)]
            if lines:
                page.add_plot(lines, f"{stage.name}: {curve.title or curve_label(curve.prefix)}")


def _lines(rows: list[dict[str, float]], key: str) -> list[Line]:
    out = []
    for kind, dashed in (("train", False), ("val", True)):
        points = [(row["step"], row[f"{kind}/{key}"]) for row in rows if f"{kind}/{key}" in row]
        if points:
            steps, values = zip(*points, strict=True)
            out.append(Line(f"{curve_label(key)} ({kind})", steps, values, dashed))
    return out


# What the flight recorders noted: it holds times, so a page made within a run does not have it.

Rows = Sequence[Mapping[str, float]]
_MOST = 8
"""Lines in one chart: as many as there are colours."""


def draw_flights(page: Page, state: RunState) -> None:
    """Speed, waits and step times of every training."""
    flights = {stage.name: read_flight(stage.folder) for stage in state.stages}
    flights = {name: ranks for name, ranks in flights.items() if ranks}
    if not flights:
        return
    page.add_heading("How the trainings ran")
    page.add_text(
        "As the flight recorders saw it: a row every 10 steps, of long trainings fewer in the past."
    )
    columns = ["training", "samples/s", "waited for data, %", "for checkpoints, %", "for other ranks, %"]
    table = [[name, *_waits(ranks)] for name, ranks in flights.items()]
    page.add_table(columns, table, "Speed and waits, means of the rows and ranks", digits=1, pinned=True)
    crashed = [
        f"{stage.name}: {bundle}"
        for stage in state.stages
        for bundle in sorted((stage.folder / CRASHES).glob("*"))
    ]
    if crashed:
        page.add_text("Batches and tracebacks of what went wrong:")
        page.add_list(crashed)
    with page.folded("Step times"):
        for name, ranks in flights.items():
            page.add_plot(_times(ranks), f"{name}: seconds a step", y_label="s", log_y=True)


def _waits(ranks: Mapping[int, Rows]) -> list[float | str | None]:
    rows = [row for own in ranks.values() for row in own]
    shares = [[row.get(f"waited/{cause}", 0.0) for row in rows] for cause in ("data", "checkpoints", "ranks")]
    speed = _mean([row["samples_per_second"] for row in rows if "samples_per_second" in row])
    return [speed, *(100 * _mean(share) for share in shares)]


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else 0.0


def _times(ranks: Mapping[int, Rows]) -> list[Line]:
    out = []
    for rank, rows in list(ranks.items())[: _MOST // 2]:
        steps = [row["step"] for row in rows]
        whose = f", rank {rank}" if len(ranks) > 1 else ""
        out.append(Line(f"median{whose}", steps, [row["step_seconds"] for row in rows]))
        out.append(Line(f"95 %{whose}", steps, [row["step_seconds_p95"] for row in rows], dashed=True))
    return out
