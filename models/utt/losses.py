"""From the UTT's logits to motion that a discriminator can judge (UDE equations 4 to 6).

L = L_ce + beta_adv L_adv. The cross-entropy and its figures are those of `models/gpt/losses.py`. For L_adv
predicted tokens become motion and keep their gradient: straight-through Gumbel one-hots over each codebook
(End excluded) [ours], then the frozen tokenizer's soft decoder; `discriminator/losses.py` judges the result.
"""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from motionloom.models.gpt.losses import group_counts, soft_codes
from motionloom.models.gpt.token_network import TokenNetwork
from motionloom.models.tokenizer.base import Tokenizer


class SoftMotion(NamedTuple):
    """A motion with a gradient to the logits behind it."""

    motion: Tensor
    """[B, T, dim], zero behind `length`."""
    length: Tensor
    """int64 [B], frames."""


def soft_motion(
    net: TokenNetwork,
    logits: Tensor,
    tokens: Tensor,
    kinds: Tensor,
    *,
    tokenizer: Tokenizer,
    gumbel_temperature: float,
    sample: bool,
    present: Tensor | None = None,
) -> SoftMotion:
    """Decode what logits [B, L, V] predict for the clips of tokens [B, L], kinds [B, L].

    Args:
        net: Whose logits they are.
        logits: Of `net`, with gradient.
        tokens: The clips' own tokens, which say how many groups there are.
        kinds: Stream of each token.
        tokenizer: Frozen.
        gumbel_temperature: Of the softmax behind the one-hots.
        sample: Draw from the distribution; false takes the likeliest codes.
        present: bool [B, dim], columns of the tokenizer that the clip has (None = all).
    """
    groups = group_counts(tokens, kinds, net.ends, len(net.pattern))
    weights = soft_codes(net, logits, groups, temperature=gumbel_temperature, sample=sample)
    frames = groups * tokenizer.group_frames
    return SoftMotion(tokenizer.decode_soft(weights, frames, present), frames)
