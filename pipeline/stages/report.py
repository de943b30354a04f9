"""Report stage: one self-contained page with motions to watch, figures, curves and codebooks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from pydantic import Field

from motionloom.datasets.motion.features import decode
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.showing import Bars, FigureTable, Showing
from motionloom.pipeline.contract.stage import (
    GENERATOR,
    SHOWING,
    Every,
    Finished,
    StageConfig,
    StageContext,
    StageKind,
)
from motionloom.pipeline.evaluation.example_clips import ExampleClip, example_clips, perform
from motionloom.pipeline.evaluation.truth import reconstruct_truth
from motionloom.pipeline.inference.bundle import Bundle, GeneratedMotion, joint_layout
from motionloom.pipeline.render.charts import Line
from motionloom.pipeline.render.face import synthetic_face_controls
from motionloom.pipeline.render.page import Page
from motionloom.pipeline.render.viewer import ViewerMotion
from motionloom.pipeline.stages.training import read_metrics


class ReportConfig(StageConfig):
    """What the page shows."""

    count: int = Field(6, ge=1, le=24)
    """Held-out clips shown as truth, reconstruction and generation."""
    sampling: SamplingConfig = SamplingConfig()


class ReportStage(StageKind):
    """The page to watch. What stages have to show, they say themselves."""

    name = "report"
    summary = "the page to watch"
    config = ReportConfig
    takes = ("data", "tokenizer?", "face_tokenizer?", Every("generators", GENERATOR), Every("shown", SHOWING))
    version = 3  # curves and figures of all stages that have some

    def gives(self, config: Any) -> frozenset[str]:
        """A page."""
        return frozenset({"page"})

    def run(self, context: StageContext) -> None:
        """Write `report.html`."""
        bundle = Bundle(context.every("generators"), context.shelf)
        dataset = context.given["data"].held_out(prefer="test")
        clips = example_clips(dataset, context.config.count, bundle.generator.modalities)
        generated = perform(bundle, clips, seed=context.seed, sampling=context.config.sampling)
        # The recipe's name, not the folder's: equal runs write equal pages wherever they lie.
        page = Page(
            f"motionloom: {context.recipe}",
            f"{len(dataset)} clips of the {dataset.split} split were never trained on",
        )
        page.add_heading("Watch")
        page.add_viewer(
            _motions(context, clips, generated),
            "Each row is one clip: as it was recorded, what the tokenizer keeps of it, and a motion that "
            "the model made from its words or its music alone. Drag to orbit, wheel to zoom, space to play.",
        )
        stages = context.every("shown")
        shown = [(stage, stage.kind.show(stage, context.shelf.given(stage.inputs))) for stage in stages]
        _draw(page, "Figures on held-out clips", shown, FigureTable)
        _curves(page, stages)
        _draw(page, "Codebooks", shown, Bars)
        page.write(context.folder / "report.html")


def _motions(
    context: StageContext, clips: Sequence[ExampleClip], generated: list[GeneratedMotion]
) -> list[ViewerMotion]:
    tokenizer, face_tokenizer = context.given.get("tokenizer"), context.given.get("face_tokenizer")
    layout = joint_layout(context.given["data"].layout)
    parents, out = layout.skeleton.parents, []
    for number, (clip, made) in enumerate(zip(clips, generated, strict=True), start=1):
        group, truth, words = f"{number}", clip.truth, clip.title
        if truth.face_caption != truth.caption:
            words = f"{words} (face: {truth.face_caption})"
        face = None if truth.face is None else synthetic_face_controls(truth.face)
        rows = [("recorded", truth.joints, face)]
        if tokenizer is not None:
            again = face
            if truth.face is not None and face_tokenizer is not None:
                again = synthetic_face_controls(face_tokenizer.reconstruct(truth.face))
            rows.append(("reconstruction", decode(reconstruct_truth(tokenizer, truth), layout), again))
        controls = None if made.face is None else synthetic_face_controls(made.face)
        rows.append(("generated", made.joints, controls))
        for label, joints, controls in rows:
            out.append(
                ViewerMotion(joints, layout.fps, parents, label, words, group, controls, sound=clip.sound)
            )
    return out


def _draw(
    page: Page,
    heading: str,
    shown: Sequence[tuple[Finished, list[Showing]]],
    kind: type[FigureTable] | type[Bars],
) -> None:
    """What the stages have to show of one kind, under a heading of its own."""
    things = [thing for _, found in shown for thing in found if isinstance(thing, kind)]
    if things:
        page.add_heading(heading)
    for thing in things:
        if isinstance(thing, FigureTable):
            page.add_table(list(thing.columns), [list(row) for row in thing.rows], thing.title)
        elif isinstance(thing, Bars):
            page.add_bars(np.asarray(thing.values), thing.title, x_label=thing.x_label, y_label=thing.y_label)


def _curves(page: Page, stages: Sequence[Finished]) -> None:
    page.add_heading("Training")
    for stage in stages:
        rows = read_metrics(stage.folder)
        keys = sorted({k.partition("/")[2] for row in rows for k in row if "/" in k})
        for curve in stage.kind.curves(stage.config):
            lines = [line for key in keys if key.startswith(curve.prefix) for line in _lines(rows, key)]
            if lines:
                page.add_plot(lines, f"{stage.name}: {curve.title or curve.prefix}")


def _lines(rows: list[dict[str, float]], key: str) -> list[Line]:
    out = []
    for kind, dashed in (("train", False), ("val", True)):
        points = [(row["step"], row[f"{kind}/{key}"]) for row in rows if f"{kind}/{key}" in row]
        if points:
            steps, values = zip(*points, strict=True)
            out.append(Line(f"{key} ({kind})", steps, values, dashed))
    return out
