"""Judges of motion by their latents: TMA, and an evaluator that no generator was trained with."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from motionloom.pipeline.evaluation.latent_metrics import Latents
from motionloom.pipeline.evaluation.truth import Truth
from motionloom.pipeline.store.evaluator import LoadedEvaluator
from motionloom.pipeline.store.networks import LoadedTma, MotionJudge, embed_motions


@dataclass(frozen=True)
class Judge:
    """Embeds captions and motions in one space; a judge of faces embeds expressions and their captions."""

    motions: MotionJudge
    texts: Callable[[Sequence[Truth]], Tensor]
    """Latents [n, Z] of the captions of n clips."""

    @staticmethod
    def tma(tma: LoadedTma) -> Judge:
        """TMA reads captions by the text stage that it was trained with; that of another run encodes anew
        what its own data did not say.
        """
        return Judge(tma, lambda truths: tma.embed_captions([t.caption for t in truths], tma.given["text"]))

    @staticmethod
    def evaluator(loaded: LoadedEvaluator) -> Judge:
        """An evaluator reads captions, or their tags, as it was trained to, and refuses others."""
        return Judge(
            loaded,
            lambda truths: loaded.embed_captions([t.caption for t in truths], [t.tokens for t in truths]),
        )

    @staticmethod
    def faces(tma: LoadedTma) -> Judge:
        return Judge(
            tma, lambda truths: tma.embed_captions([t.face_caption for t in truths], tma.given["text"].cache)
        )

    def read(self, truth: Truth) -> NDArray[np.float32]:
        """The features of a clip that are judged: of body and hands, or its expression."""
        if self.motions.part != "face":
            return truth.features
        if truth.face is None:
            raise ValueError(f"clip '{truth.id}' has no face to be judged")
        return truth.face

    def recorded(self, truths: Sequence[Truth]) -> Tensor:
        """Latents [n, Z] of what was recorded."""
        return embed_motions(self.motions, [self.read(t) for t in truths], [t.present for t in truths])

    def latents(
        self,
        truths: Sequence[Truth],
        generated: Sequence[Tensor],
        others: Sequence[Truth],
        nearest: Mapping[str, Sequence[Truth]],
    ) -> Latents:
        """Latents of n clips, of what was made for their captions, of `others` and of the mean pose.

        Args:
            truths: The clips.
            made: Latents [n, Z] of motions for their captions, once a repeat.
            others: Training clips.
            nearest: Row -> the training clip that it finds for each caption.
        """
        judge = self.motions
        mean = judge.stats.mean[judge.layout.part(judge.part)].astype("float32")
        return Latents(
            text=self.texts(truths),
            real=self.recorded(truths),
            made=generated,
            others=self.recorded(others),
            still=embed_motions(judge, [np.tile(mean, (len(t.features), 1)) for t in truths]),
            nearest={row: self.recorded(clips) for row, clips in nearest.items()},
        )
