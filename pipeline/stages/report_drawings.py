"""How the report draws what stages have to show: tables, curves, bodies, matrices, motions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.contract.showing import Bars, Clips, FigureTable, JointMap, Matrix, Showing
from motionloom.pipeline.contract.stage import Finished
from motionloom.pipeline.render.body_map import body_map
from motionloom.pipeline.render.charts import Line
from motionloom.pipeline.render.joint_names import joint_label
from motionloom.pipeline.render.labels import curve_label
from motionloom.pipeline.render.page import Page
from motionloom.pipeline.store.training_log import read_training_log

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
