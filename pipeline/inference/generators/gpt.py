"""Motion of text by a GPT over motion tokens (HumanTOMATO sections 3.3, 3.4 and B.4)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.contract.generation import GenerationRequest
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.inference.generators.base import OfTokens
from motionloom.pipeline.store.networks import LoadedGpt, LoadedTma, device_of

T = TypeVar("T")

_CANDIDATES_AT_ONCE = 64
"""Motions sampled together where several are drawn for each text."""


@dataclass(frozen=True)
class GptGenerator(OfTokens):
    """Tokens sampled from a GPT, then decoded: body and hands, or the face's residual codes (B.4)."""

    gpt: LoadedGpt
    given: Mapping[str, Any]
    face: bool
    method = "gpt"

    @property
    def settings(self) -> frozenset[str]:
        more = {"face_cfg_scale"} if self.face else set()
        more |= {"candidates"} if self.reranker is not None else set()
        return frozenset({"temperature", "top_k", "top_p", "cfg_scale"} | more)

    @property
    def reranker(self) -> LoadedTma | None:
        """TMA used to rank candidates: the one behind the text prior, if it models the same body part."""
        tma: LoadedTma | None = self.given.get("tma") if self.gpt.prior == "tma" else None
        return tma if tma is not None and tma.part == self.part else None

    @property
    def max_frames(self) -> int:
        return self.gpt.net.max_groups * self.unit_frames

    def prior(self, request: GenerationRequest) -> Tensor:
        """First input of the GPT [B, E]: the TMA text latent or the sentence embedding."""
        if self.gpt.prior == "sentence":
            return request.pooled_text("this GPT").to(device_of(self.gpt.net))
        if "tma" not in self.given:
            raise UserError("this GPT needs the TMA text encoder, and no tma stage is here")
        text = request.text("this GPT")
        latent: Tensor = self.given["tma"].embed_text(text.features, text.mask)
        return latent

    def generate(self, request: GenerationRequest) -> list[NDArray[np.float32]]:
        """Lengths that are no whole groups are made of one group more, and cut. Of several candidates the
        one nearest to its text is kept.
        """
        prior = self.prior(request)
        reranker = self.reranker
        count = request.sampling.candidates
        if reranker is None or count == 1:
            return self._drawn(prior, request.frames, request.seeds, request.sampling)
        out: list[NDArray[np.float32]] = []
        at_once = max(1, _CANDIDATES_AT_ONCE // count)
        for start in range(0, len(prior), at_once):
            rows = slice(start, start + at_once)
            frames = None if request.frames is None else repeated(request.frames[rows], count)
            texts = prior[rows]
            seeds = candidate_seeds(request.seeds[rows], count)
            drawn = self._drawn(texts.repeat_interleave(count, dim=0), frames, seeds, request.sampling)
            out += nearest_candidates(reranker, texts, drawn)
        return out

    @torch.no_grad()
    def _drawn(
        self, prior: Tensor, frames: Sequence[int] | None, seeds: Sequence[int], sampling: SamplingConfig
    ) -> list[NDArray[np.float32]]:
        """One motion for each row of the prior [B, E]."""
        from motionloom.models.gpt.rows import Drawing
        from motionloom.models.gpt.sampling import generate

        codes = generate(
            self.gpt.net,
            prior,
            groups=self.whole_groups(frames),
            how=Drawing(sampling.temperature, sampling.top_k or None, sampling.top_p),
            cfg_scale=sampling.guidance_of(self.part),
            seed=list(seeds),
        )
        return self.decoded(codes, frames)


def candidate_seeds(seeds: Sequence[int], count: int) -> list[int]:
    """`count` seeds for each of `seeds`, grouped by motion; the first is the motion's own."""
    from motionloom.models.layers.seeds import sample_seeds

    return [one for seed in seeds for one in (seed, *sample_seeds(seed, count - 1))]


def repeated(values: Sequence[T], count: int) -> list[T]:
    """Each value `count` times in a row."""
    return [value for value in values for _ in range(count)]


def nearest_candidates(
    reranker: LoadedTma, text: Tensor, motions: Sequence[NDArray[np.float32]]
) -> list[NDArray[np.float32]]:
    """Each text's motion whose latent has the greatest cosine to the text's; [T, C] each.

    Args:
        reranker: What embeds motions [T, C] of its part, in their own units.
        text: The texts' latents, float [B, Z].
        motions: B * K motions, a text's K draws next to each other.
    """
    from motionloom.pipeline.store.evaluator import embed_motions

    count = len(motions) // len(text)
    latents = F.normalize(embed_motions(reranker, motions).double(), dim=-1).view(len(text), count, -1)
    near = (latents * F.normalize(text.cpu().double(), dim=-1)[:, None]).sum(-1)
    return [motions[row * count + draw] for row, draw in enumerate(near.argmax(1).tolist())]
