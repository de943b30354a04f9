"""Judges of motion by their latents: TMA, and an evaluator that no generator was trained with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from motionloom.pipeline.evaluation.latent_metrics import Latents
from motionloom.pipeline.evaluation.truth import Truth
from motionloom.pipeline.store.evaluator import LoadedEvaluator, embed_motions
from motionloom.pipeline.store.networks import LoadedTma


@dataclass(frozen=True)
class Judge:
    """Embeds captions and motions in one space; a judge of faces embeds expressions and their captions."""

    motions: LoadedTma | LoadedEvaluator

    @property
    def of_faces(self) -> bool:
        return self.motions.part == "face"

    def words(self, truths: Sequence[Truth]) -> list[str]:
        """The captions that it reads."""
        return [t.face_caption if self.of_faces else t.caption for t in truths]

    def texts(self, truths: Sequence[Truth]) -> Tensor:
        """Latents [n, Z] of the captions of n clips.

        An evaluator reads captions, or their tags, as it was trained to, and refuses others. TMA reads them
        by the text stage that it was trained with; that of another run encodes anew what its own data did
        not say.
        """
        if isinstance(self.motions, LoadedEvaluator):
            return self.motions.embed_captions(self.words(truths), [t.tokens for t in truths])
        text = self.motions.given["text"]
        return self.motions.embed_captions(self.words(truths), text.cache if self.of_faces else text)

    def judged(self, truths: Sequence[Truth]) -> list[Truth]:
        """The clips that it can judge: those with faces, where it judges faces."""
        return [t for t in truths if not self.of_faces or t.face is not None]

    def read(self, truth: Truth) -> NDArray[np.float32]:
        """The features of a clip that are judged: of body and hands, or its expression."""
        if not self.of_faces:
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
            generated: Latents [n, Z] of motions for their captions, once a repeat.
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
