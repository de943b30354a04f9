"""Report stage: one self-contained page with motions to watch, figures, curves and codebooks.

Of an unfinished run it shows what there is, and says what is missing (`StageContext.again`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from pydantic import Field

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.features.codec import face_of
from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.models.tokenizer.base import GROUP_FRAMES
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.showing import Bars
from motionloom.pipeline.contract.stage import (
    GENERATOR,
    SHOWING,
    CompletedStage,
    Every,
    StageConfig,
    StageContext,
    StageKind,
    register,
    stage_kind,
)
from motionloom.pipeline.evaluation.dances import dance_to, dances_of, seed_frames, with_music
from motionloom.pipeline.evaluation.truth import Truth, perform, reconstruct_all, spread_truths, truth_at
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.files.display_figure import shown
from motionloom.pipeline.inference.motion import GeneratedMotion
from motionloom.pipeline.render.body.face import synthetic_face_controls
from motionloom.pipeline.render.page import Page
from motionloom.pipeline.render.sound import Score
from motionloom.pipeline.render.viewer import ViewerMotion
from motionloom.pipeline.stages.results.evaluation import bundle_driven_by
from motionloom.pipeline.stages.results.report_parts import (
    add_run_facts,
    draw_curves,
    draw_evaluations,
    draw_flights,
    draw_showings,
    say_missing,
)
from motionloom.pipeline.store.run_state import RunState, run_state


class ReportConfig(StageConfig):
    """Contents of the page."""

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
    offers = frozenset({"page"})
    takes = (
        "data",
        "tokenizer?",
        "face_tokenizer?: tokenizer",
        Every("generators", GENERATOR),
        Every("shown", SHOWING),
    )
    version = 6  # where it errs

    def run(self, context: StageContext) -> None:
        """Write `report.html`; of an unfinished run, what there is of it."""
        state = None if context.again is None else run_state(context.again)
        partial = state is not None and bool(state.unfinished)
        said = []
        danced = []
        subtitle = "of a run that has not finished its data"
        if "data" in context.inputs:
            dataset = context.given["data"].held_out(prefer="test")
            subtitle = f"{len(dataset)} clips of the {dataset.split} split were never trained on"
            said = _captioned(context, dataset)
            danced = _danced(context, dataset)
            if not said and not danced and not partial:
                raise UserError(
                    f"{dataset.where}: no clip of split '{dataset.split}' has a caption or its sound to be "
                    f"shown; raise count or dances of stage '{context.name}' if they are 0"
                )
        # The recipe's name, not the folder's: equal runs write equal pages wherever they lie.
        page = Page(f"Report of {context.recipe}", subtitle)
        if state is not None:
            say_missing(page, state)
        _watch(page, context, said, danced)
        stages = context.every("shown")
        shown = [
            thing
            for stage in stages
            for thing in stage.kind.show(stage, context.stage_cache.given(stage.inputs))
        ]
        draw_evaluations(page, shown)
        draw_curves(page, stages if state is None else _logged(stages, state), flights=state is not None)
        draw_showings(page, "Codebooks", shown, Bars)
        if state is not None:
            draw_flights(page, state)
        add_run_facts(page, context, state)
        page.write(context.folder / "report.html")


def _watch(page: Page, context: StageContext, said: list[ViewerMotion], danced: list[ViewerMotion]) -> None:
    """The motions of held-out clips; the words say what each row has."""
    use = "Drag to orbit, wheel to zoom, space to play."
    for motions, heading, row, whole, made in (
        (said, "Watch", "caption", "clip", "a motion that the model made from the words alone"),
        (
            danced,
            "Dances",
            "piece of music",
            "dance",
            "a dance that the model made from the music alone, in time with the sound; ticks are the "
            "music's beats",
        ),
    ):
        if not motions:
            continue
        there = {motion.label for motion in motions}
        words = [f"the recorded {whole}"]
        if "reconstruction" in there:
            words.append("what the tokenizer keeps of it")
        if "generated" in there:
            words.append(made)
        listed = words[0] if len(words) == 1 else ", ".join(words[:-1]) + f", and {words[-1]}"
        page.add_heading(heading)
        page.add_viewer(motions, f"Each row is one {row}: {listed}. {use}")


def _logged(stages: Sequence[CompletedStage], state: RunState) -> list[CompletedStage]:
    """The stages with curves: those that are finished, and trainings that are not, in the recipe's order."""
    out = {stage.name: stage for stage in stages if not stage.outside}
    for stage in state.unfinished:
        kind = stage_kind(stage.kind, f"{state.folder / 'recipe.yaml'}: stages.{stage.name}")
        if stage.step:
            config = kind.config.parse(dict(stage.settings), f"{stage.folder}: settings")
            out[stage.name] = CompletedStage(stage.name, kind, config, stage.folder, {})
    return [out[stage.name] for stage in state.stages if stage.name in out] + [s for s in stages if s.outside]


def _captioned(context: StageContext, dataset: ClipDataset) -> list[ViewerMotion]:
    """Clips with captions, and motions made from them where a generator is conditioned on text."""
    config: ReportConfig = context.config
    truths = spread_truths(dataset, config.count)
    bundle = _bundle(context, "text") if truths else None
    generated: Sequence[GeneratedMotion | None] = [None] * len(truths)
    if bundle is not None:
        generated = perform(bundle, truths, seed=context.seed, sampling=config.sampling)
    out = []
    for number, (truth, made) in enumerate(zip(truths, generated, strict=True), start=1):
        same = truth.face_caption == truth.caption
        words = truth.caption if same else f"{truth.caption} (face: {truth.face_caption})"
        out += _rows(context, truth, made, words, f"{number}", Score())
    return out


def _bundle(context: StageContext, modality: str) -> Bundle | None:
    """Return its generators; of an unfinished run, None where no generator of the body is complete."""
    makers = context.every("generators")
    unfinished = context.again is not None and run_state(context.again).unfinished
    if unfinished and all(context.stage_cache.generator(maker).part == "face" for maker in makers):
        return None
    return bundle_driven_by(modality, makers, context.stage_cache)


def _danced(context: StageContext, dataset: ClipDataset) -> list[ViewerMotion]:
    """Clips with music, and dances made from it where a generator is conditioned on music."""
    config: ReportConfig = context.config
    if not config.dances or not with_music(dataset).any():
        return []
    bundle = _bundle(context, "audio")
    unit = GROUP_FRAMES
    longest = config.dance_seconds
    if bundle is not None:
        unit = math.lcm(unit, bundle.generator.unit_frames)
        longest = min(longest, bundle.max_seconds)
    clips = dances_of(dataset, config.dances, unit=unit, seconds=longest)
    if bundle is not None:
        clips = [clip for clip in clips if len(clip.joints) > seed_frames(bundle)]
    made: Sequence[GeneratedMotion | None] = [None] * len(clips)
    if bundle is not None and clips:
        made = dance_to(bundle, clips, seed=context.seed, sampling=config.sampling)
    out = []
    for number, (clip, motion) in enumerate(zip(clips, made, strict=True), start=1):
        truth = truth_at(dataset, clip.index, len(clip.joints))
        words = f"dance to {clip.title}"
        group = f"dance {number}"
        out += _rows(context, truth, motion, words, group, clip.score())
    return out


def _rows(
    context: StageContext, truth: Truth, made: GeneratedMotion | None, words: str, group: str, score: Score
) -> list[ViewerMotion]:
    """A clip, what the tokenizer keeps of it, and what was made instead."""
    tokenizer = context.given.get("tokenizer")
    face_tokenizer = context.given.get("face_tokenizer")
    layout = context.given["data"].layout
    face = None if truth.face is None else synthetic_face_controls(truth.face)
    rows = [("recorded", truth.joints, face)]
    if tokenizer is not None:
        again = face
        kept = reconstruct_all(tokenizer, truth)
        if truth.face is not None and face_tokenizer is not None:
            again = synthetic_face_controls(face_tokenizer.reconstruct(truth.face))
        elif truth.face is not None and np.isin(layout.part("face"), tokenizer.columns).all():
            again = synthetic_face_controls(face_of(kept, layout))
        rows.append(("reconstruction", joints_of(kept, layout), again))
    if made is not None:
        controls = None if made.face is None else synthetic_face_controls(made.face)
        rows.append(("generated", shown(made).joints, controls))
    figure = (layout.fps, layout.skeleton.parents)
    return [
        ViewerMotion(joints, *figure, label, words, group, controls, score.sound, score.beats, score.segments)
        for label, joints, controls in rows
    ]


register(ReportStage())
