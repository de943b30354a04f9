"""Clips and what was made for their captions in the latents of a judge: TMA, or an evaluator."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from torch import Tensor

from motionloom.pipeline.evaluation.figures import MotionJudge, embed_motions
from motionloom.pipeline.evaluation.text_motion import Latents
from motionloom.pipeline.evaluation.truth import Truth
from motionloom.pipeline.inference.bundle import GeneratedMotion
from motionloom.pipeline.store.evaluator import LoadedEvaluator
from motionloom.pipeline.store.networks import LoadedTma


def texts_by_tma(tma: LoadedTma, truths: Sequence[Truth]) -> Tensor:
    """Latents [n, Z] of the captions, by the text stage that the model was trained with."""
    return tma.embed_captions([t.caption for t in truths], tma.given["text"].cache)


def texts_by_evaluator(evaluator: LoadedEvaluator, truths: Sequence[Truth]) -> Tensor:
    """Latents [n, Z] of the captions, which the evaluator must know."""
    return evaluator.embed_captions([t.caption for t in truths], [t.tokens for t in truths])


def judged(
    judge: MotionJudge,
    text: Tensor,
    truths: Sequence[Truth],
    generated: Sequence[Sequence[GeneratedMotion]],
    others: Sequence[Truth],
) -> Latents:
    """Latents of n clips, of the motions made for their captions, of `others` and of the mean pose.

    Args:
        judge: What embeds motions.
        text: Its latents of the captions of `truths`, [n, Z].
        truths: The clips.
        generated: Motions of their captions, once a repeat.
        others: Training clips.
    """
    mean = judge.stats.mean[judge.layout.part(judge.part)].astype("float32")
    return Latents(
        text=text,
        real=embed_motions(judge, [t.features for t in truths], [t.present for t in truths]),
        made=[embed_motions(judge, [g.features for g in motions]) for motions in generated],
        others=embed_motions(judge, [t.features for t in others], [t.present for t in others]),
        still=embed_motions(judge, [np.tile(mean, (len(t.features), 1)) for t in truths]),
    )
