"""Several motions drawn for each text, of which the one that TMA finds nearest to the text is kept.

A model that has learnt what a text means does not hit it with every draw; TMA, which the GPT's prior comes
from anyway, tells the draws apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from motionloom.models.gpt.drawing import sample_seeds
from motionloom.pipeline.store.latents import MotionJudge, embed_motions

T = TypeVar("T")


def candidate_seeds(seeds: Sequence[int], count: int) -> list[int]:
    """Seeds of `count` draws for each of `seeds`, one motion's behind another's: its own first, so that a
    single draw is the first of several.
    """
    return [one for seed in seeds for one in (seed, *sample_seeds(seed, count - 1))]


def repeated(values: Sequence[T], count: int) -> list[T]:
    """Each value `count` times, one behind another."""
    return [value for value in values for _ in range(count)]


def nearest_candidates(
    judge: MotionJudge, text: Tensor, motions: Sequence[NDArray[np.float32]]
) -> list[NDArray[np.float32]]:
    """Of each text's motions the one whose latent has the greatest cosine to the text's; [T, C] each.

    Args:
        judge: What embeds motions [T, C] of its part, in their own units.
        text: The texts' latents, float [B, Z].
        motions: B * K motions, a text's K draws one behind another.
    """
    count = len(motions) // len(text)
    latents = F.normalize(embed_motions(judge, motions).double(), dim=-1).view(len(text), count, -1)
    near = (latents * F.normalize(text.cpu().double(), dim=-1)[:, None]).sum(-1)
    return [motions[row * count + draw] for row, draw in enumerate(near.argmax(1).tolist())]
