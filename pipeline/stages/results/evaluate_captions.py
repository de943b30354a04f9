"""Evaluation of a captioner on the test split, beside captions that need none."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from motionloom.datasets.base.progress import Meter
from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.pipeline.contract.showing import FigureTable, Showing
from motionloom.pipeline.contract.stage import (
    CAPTIONER,
    SHOWING,
    CompletedStage,
    Inputs,
    StageConfig,
    StageContext,
    StageKind,
    register,
)
from motionloom.pipeline.evaluation.captions import CaptionedClips, caption_figures, trivial_captions
from motionloom.pipeline.evaluation.figures import (
    FILE_NAME,
    MODEL,
    OWN_CAPTION,
    FigureFile,
    facts,
    figure_tables,
    print_tables,
)
from motionloom.pipeline.evaluation.truth import Truth, digest_of, spread, truth_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

_AT_ONCE = 32


class EvaluateCaptionsConfig(StageConfig):
    """How much is measured."""

    clips: int | None = Field(400, ge=1)
    """At most this many clips of the test split; null takes all."""
    size: int = Field(32, ge=2)
    """Motions among which TMA finds a caption's own."""


class EvaluateCaptionsStage(StageKind[EvaluateCaptionsConfig]):
    """Sentences of a captioner about the test split."""

    name = "evaluate_captions"
    summary = "figures of captions"
    config = EvaluateCaptionsConfig
    offers = frozenset({"figures", SHOWING})
    takes = ("data", "text", "captioner", "tma?")

    def run(self, context: StageContext) -> None:
        """Write `metrics.json` and print it as a table."""
        config, given = context.config, context.given
        captioner = context.stage_cache.captioner(context.inputs[CAPTIONER])
        dataset = given["data"].held_out(prefer="test")
        count = len(dataset) if config.clips is None else config.clips
        chosen = [(clip, truth_of(dataset, clip)) for clip in spread(dataset, count)]
        chosen = [(clip, truth) for clip, truth in chosen if len(truth.features) >= captioner.min_frames]
        truths = [truth for _, truth in chosen]
        about = [[caption.text for caption in dataset.texts(clip)] for clip, _ in chosen]
        clips = CaptionedClips(
            truths, about, dataset.layout.fps, given["text"], given.get("tma"), config.size, context.seed
        )
        said = []
        with Meter("captions", len(truths), console=context.console) as meter:
            for start in range(0, len(truths), _AT_ONCE):
                some = truths[start : start + _AT_ONCE]
                motions = [_read(truth, dataset.layout, captioner.part) for truth in some]
                made = captioner.caption(motions, 1, [truth.present for truth in some])
                said += [sentences[0].text for sentences in made]
                meter.advance(len(some))
        rows = {MODEL: clips.measured(said)}
        if all(len(own) > 1 for own in about):
            rows[OWN_CAPTION] = clips.measured([own[0] for own in about], [own[1:] for own in about])
        for row, captions in trivial_captions(given["data"].split("train"), clips).items():
            rows[row] = clips.measured(captions)
        judged = None if clips.tma is None else context.inputs["tma"].name
        protocol = facts(
            {
                **{"split": dataset.split, "clips": len(truths), "clips_sha256": digest_of(truths)},
                **{"size": config.size, "judge": judged, "text": context.inputs["text"].name},
            }
        )
        figures = caption_figures(rows, protocol)
        who = {"stage": context.name, "made_by": {CAPTIONER: context.inputs[CAPTIONER].name}}
        FigureFile(self.name, tuple(figures), who).write(context.folder / FILE_NAME)
        print_tables(figures, context.console)

    def show(self, stage: CompletedStage, given: Inputs) -> list[Showing]:
        """The table."""
        found = FigureFile.read(stage.folder / FILE_NAME)
        return [FigureTable(*table) for table in figure_tables(found.figures)]


def _read(truth: Truth, layout: MotionLayout, part: Part) -> NDArray[np.float32]:
    """The columns [T, C] of a part of a clip."""
    whole = np.zeros((len(truth.features), layout.dim), dtype=np.float32)
    whole[:, layout.part("bodyhand")] = truth.features
    if truth.face is not None:
        whole[:, layout.slice("face")] = truth.face
    return whole[:, layout.part(part)]


register(EvaluateCaptionsStage())
