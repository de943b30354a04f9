"""Report stage: one self-contained page with motions to watch, figures, curves and codebooks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from pydantic import Field

from motionloom.datasets.motion.features import face_of
from motionloom.datasets.motion.joints import joints_of
from motionloom.datasets.schema import UserError
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.models.tokenizer.base import GROUP_FRAMES
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
from motionloom.pipeline.evaluation.dances import dances_of, with_music
from motionloom.pipeline.evaluation.truth import (
    Truth,
    has_caption,
    reconstruct_all,
    spread,
    truth_at,
    truth_of,
)
from motionloom.pipeline.inference.bundle import GeneratedMotion
from motionloom.pipeline.inference.driven import bundle_driven_by
from motionloom.pipeline.render.charts import Line
from motionloom.pipeline.render.face import synthetic_face_controls
from motionloom.pipeline.render.page import Page
from motionloom.pipeline.render.score import Score
from motionloom.pipeline.render.viewer import ViewerMotion
from motionloom.pipeline.stages.training import read_metrics


class ReportConfig(StageConfig):
    """What the page shows."""

    count: int = Field(6, ge=0, le=24)
    """Held-out clips with captions shown as truth, reconstruction and generation."""
    dances: int = Field(4, ge=0, le=24)
    """Held-out clips with music shown likewise, different songs first."""
    dance_seconds: float = Field(20.0, ge=1)
    """Longer dances are cut to this."""
    sampling: SamplingConfig = SamplingConfig()


class ReportStage(StageKind):
    """The page to watch. What stages have to show, they say themselves."""

    name = "report"
    summary = "the page to watch"
    config = ReportConfig
    takes = (
        "data",
        "tokenizer?",
        "face_tokenizer?: tokenizer",
        Every("generators", GENERATOR),
        Every("shown", SHOWING),
    )
    version = 4  # dances

    def gives(self, config: Any) -> frozenset[str]:
        """A page."""
        return frozenset({"page"})

    def run(self, context: StageContext) -> None:
        """Write `report.html`."""
        dataset = context.given["data"].held_out(prefer="test")
        said, danced = _captioned(context, dataset), _danced(context, dataset)
        if not said and not danced:
            raise UserError(
                f"{dataset.where}: no clip of split '{dataset.split}' has a caption or its sound to be "
                f"shown; raise count or dances of stage '{context.name}' if they are 0"
            )
        # The recipe's name, not the folder's: equal runs write equal pages wherever they lie.
        page = Page(
            f"motionloom: {context.recipe}",
            f"{len(dataset)} clips of the {dataset.split} split were never trained on",
        )
        page.add_heading("Watch")
        use = "Drag to orbit, wheel to zoom, space to play."
        if said:
            page.add_viewer(
                said,
                "Each row is one caption: the recorded clip, what the tokenizer keeps of it, and a motion "
                f"that the model made from the words alone. {use}",
            )
        if danced:
            page.add_heading("Dances")
            page.add_viewer(
                danced,
                "Each row is one piece of music: the recorded dance, what the tokenizer keeps of it, and a "
                "dance that the model made from the music alone, in time with the sound; ticks are the "
                f"music's beats. {use}",
            )
        stages = context.every("shown")
        shown = [(stage, stage.kind.show(stage, context.shelf.given(stage.inputs))) for stage in stages]
        _draw(page, "Figures on held-out clips", shown, FigureTable)
        _curves(page, stages)
        _draw(page, "Codebooks", shown, Bars)
        page.write(context.folder / "report.html")


def _captioned(context: StageContext, dataset: ClipDataset) -> list[ViewerMotion]:
    """Clips with captions, and motions made from them where a generator is conditioned on text."""
    config: ReportConfig = context.config
    chosen = spread(dataset, config.count) if config.count and has_caption(dataset).any() else []
    if not chosen:
        return []
    truths = [truth_of(dataset, i) for i in chosen]
    bundle = bundle_driven_by("text", context.every("generators"), context.shelf)
    generated: Sequence[GeneratedMotion | None] = [None] * len(truths)
    if bundle is not None:
        generated = bundle.generate(
            [t.caption for t in truths],
            face_captions=[t.face_caption for t in truths],
            seed=context.seed,
            sampling=config.sampling,
        )
    return _motions(context, truths, generated)


def _danced(context: StageContext, dataset: ClipDataset) -> list[ViewerMotion]:
    """Clips with music, and dances made from it where a generator is conditioned on music."""
    config: ReportConfig = context.config
    if not config.dances or not with_music(dataset).any():
        return []
    bundle = bundle_driven_by("audio", context.every("generators"), context.shelf)
    unit, longest = GROUP_FRAMES, config.dance_seconds
    if bundle is not None:
        unit, longest = math.lcm(unit, bundle.generator.unit_frames), min(longest, bundle.max_seconds)
    clips = dances_of(dataset, config.dances, unit=unit, seconds=longest)
    made: Sequence[GeneratedMotion | None] = [None] * len(clips)
    if bundle is not None and clips:
        made = bundle.generate(
            sounds=[clip.sound for clip in clips],
            music=[clip.music for clip in clips],
            seconds=[clip.seconds for clip in clips],
            seed=context.seed,
            sampling=config.sampling,
        )
    out = []
    for number, (clip, motion) in enumerate(zip(clips, made, strict=True), start=1):
        truth = truth_at(dataset, clip.index, len(clip.joints))
        words, group = f"dance to {clip.title}", f"dance {number}"
        out += _rows(context, truth, motion, words, group, clip.score())
    return out


def _motions(
    context: StageContext, truths: list[Truth], generated: Sequence[GeneratedMotion | None]
) -> list[ViewerMotion]:
    out = []
    for number, (truth, made) in enumerate(zip(truths, generated, strict=True), start=1):
        same = truth.face_caption == truth.caption
        words = truth.caption if same else f"{truth.caption} (face: {truth.face_caption})"
        out += _rows(context, truth, made, words, f"{number}", Score())
    return out


def _rows(
    context: StageContext,
    truth: Truth,
    made: GeneratedMotion | None,
    words: str,
    group: str,
    score: Score,
) -> list[ViewerMotion]:
    """A clip, what the tokenizer keeps of it, and what was made instead."""
    tokenizer, face_tokenizer = context.given.get("tokenizer"), context.given.get("face_tokenizer")
    layout = context.given["data"].layout
    face = None if truth.face is None else synthetic_face_controls(truth.face)
    rows = [("recorded", truth.joints, face)]
    if tokenizer is not None:
        again, kept = face, reconstruct_all(tokenizer, truth)
        if truth.face is not None and face_tokenizer is not None:
            again = synthetic_face_controls(face_tokenizer.reconstruct(truth.face))
        elif truth.face is not None and np.isin(layout.part("face"), tokenizer.columns).all():
            again = synthetic_face_controls(face_of(kept, layout))
        rows.append(("reconstruction", joints_of(kept, layout), again))
    if made is not None:
        controls = None if made.face is None else synthetic_face_controls(made.face)
        rows.append(("generated", made.joints, controls))
    return [
        ViewerMotion(
            joints,
            layout.fps,
            layout.skeleton.parents,
            label,
            words,
            group,
            controls,
            sound=score.sound,
            beats=score.beats,
            segments=score.segments,
        )
        for label, joints, controls in rows
    ]


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
