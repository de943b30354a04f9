"""Evaluation of a captioner on the test split, beside captions that need none."""

from __future__ import annotations

from pydantic import Field

from motionloom.datasets.base.progress import Meter
from motionloom.pipeline.baselines.tm2t.caption_figures import (
    CaptionedClips,
    caption_figures,
    trivial_captions,
)
from motionloom.pipeline.contract.stage import CAPTIONER, StageConfig, StageContext, register
from motionloom.pipeline.evaluation.figures import MODEL, OWN_CAPTION, FigureFile, facts
from motionloom.pipeline.evaluation.truth import digest_of, spread, truth_of
from motionloom.pipeline.stages.results.evaluation import Evaluation, EvaluationStage

_AT_ONCE = 32


class EvaluateCaptionsConfig(StageConfig):
    """Extent of the measurement."""

    clips: int | None = Field(400, ge=1)
    """At most this many clips of the test split; null takes all."""
    size: int = Field(32, ge=2)
    """Motions among which TMA finds a caption's own."""


class EvaluateCaptionsStage(EvaluationStage):
    """Sentences of a captioner about the test split."""

    name = "evaluate_captions"
    summary = "figures of captions"
    config = EvaluateCaptionsConfig
    shares = False
    takes = ("data", "text", "captioner", "tma?")

    def evaluation(self, context: StageContext) -> _CaptionEvaluation:
        return _CaptionEvaluation(context)


class _CaptionEvaluation(Evaluation):
    """The sentences of one process."""

    def measured(self) -> FigureFile:
        """Figures of the captioner's sentences, of another person's and of captions that need none."""
        context = self.context
        config = self.config
        given = self.context.given
        dataset = self.dataset
        captioner = context.stage_cache.captioner(context.inputs[CAPTIONER])
        chosen = [(clip, truth_of(dataset, clip)) for clip in spread(dataset, config.clips)]
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
                layout = dataset.layout
                motions = [truth.columns(layout)[:, layout.part(captioner.part)] for truth in some]
                made = captioner.caption(motions, 1, [truth.present for truth in some])
                said += [sentences[0].text for sentences in made]
                meter.advance(len(some))
        rows = {MODEL: clips.measured(said)}
        if all(len(own) > 1 for own in about):
            rows[OWN_CAPTION] = clips.measured([own[0] for own in about], [own[1:] for own in about])
        for row, captions in trivial_captions(self.train, clips).items():
            rows[row] = clips.measured(captions)
        judged = None if clips.tma is None else context.inputs["tma"].name
        protocol = facts(
            {
                **{"split": dataset.split, "clips": len(truths), "clips_sha256": digest_of(truths)},
                **{"size": config.size, "judge": judged, "text": context.inputs["text"].name},
            }
        )
        who = {"stage": context.name, "made_by": {CAPTIONER: context.inputs[CAPTIONER].name}}
        return FigureFile("evaluate_captions", tuple(caption_figures(rows, protocol)), who)


register(EvaluateCaptionsStage())
