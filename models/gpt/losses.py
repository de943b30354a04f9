"""The GPT's loss terms: cross-entropy, input corruption and text-motion alignment (HumanTOMATO sections 3.5,
3.6).

L = L_CE + eta L_align. For L_align the predicted tokens become motion without losing the gradient:
straight-through Gumbel-softmax over each codebook (End excluded) [ours], the frozen tokenizer's soft decoder,
the frozen TMA motion encoder, then InfoNCE against the TMA text latents of the (global) batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor

from motionloom.datasets.base.config import Config
from motionloom.models.gpt.tokens import PAD, TokenNetwork
from motionloom.models.tokenizer.base import Tokenizer
from motionloom.models.training.distributed import masked_mean, mean_of_rows


class GptLossConfig(Config):
    """The cross-entropy's mean, and weight and temperatures of the alignment term."""

    per_clip: bool = False
    """Every clip counts alike, as in T2M-GPT's public code; otherwise every token does."""
    align_weight: float = Field(default=0.1, ge=0)
    """eta [ours]; 0 turns L_align off, and the tokenizer and TMA are then not needed."""
    align_from: int = Field(default=0, ge=0)
    """Step at which L_align begins [ours]; it takes half of a step's time, and at first all is noise."""
    align_on: Literal["predictions", "samples"] = "predictions"
    """Motions that L_align judges [ours]: tokens predicted after the true ones, or motions that the model
    samples itself. Those take several times longer; start such a stage from a trained GPT
    (`inputs: {start: gpt}`)."""
    samples: int = Field(default=2, ge=2)
    """Motions sampled for each caption, for `align_on: samples`."""
    gumbel_temperature: float = Field(default=1.0, gt=0)
    """Temperature of the drawn codes, for `align_on: predictions`."""
    temperature: float = Field(default=0.1, gt=0)
    """Of L_align [ours]; the paper states none."""
    threshold: float | None = Field(default=0.85, ge=-1, le=1)
    """Captions with a higher sBERT cosine are not negatives of each other; null keeps all negatives."""


def predicted(tokens: Tensor, logits: Tensor, known: Tensor | None = None) -> Tensor:
    """Bool [B, L]: real tokens the grammar does not already decide (padding and the Ends after the first are
    out), and of those the `known` [B, L] ones (None = all): not the codes of a part that the clip lacks.
    """
    # NaN counts, so that a lost network has no loss of 0.
    free = (tokens != PAD) & ((logits != -torch.inf).sum(-1) > 1)
    return free if known is None else free & known


def cross_entropy(
    logits: Tensor, tokens: Tensor, known: Tensor | None = None, *, per_clip: bool = False
) -> Tensor:
    """Mean over the `predicted` tokens of all ranks; logits [B, L, V], tokens int64 [B, L] padded with -1.

    With `per_clip` it is the mean over the clips of each clip's own mean.
    """
    errors = token_errors(logits, tokens)
    mask = predicted(tokens, logits, known)
    return mean_of_rows(errors[..., None], mask) if per_clip else masked_mean(errors, mask)


def token_errors(logits: Tensor, tokens: Tensor) -> Tensor:
    """Cross-entropy of each token [B, L]; 0 at padding."""
    each = F.cross_entropy(logits.flatten(0, 1), tokens.flatten(), ignore_index=PAD, reduction="none")
    return each.view_as(tokens)


def accuracy(logits: Tensor, tokens: Tensor, kinds: Tensor, kind: int, known: Tensor | None = None) -> Tensor:
    """Share of one stream's `predicted` tokens that are the most likely ones."""
    hit = (logits.argmax(-1) == tokens).float()
    return masked_mean(hit, predicted(tokens, logits, known) & (kinds == kind))


def corrupt(tokens: Tensor, kinds: Tensor, ends: Tensor, pkeep: float) -> Tensor:
    """Each code is kept with probability `pkeep`, else replaced by a uniform code of its own stream
    (T2M-GPT).

    tokens, kinds int64 [B, L], ends int64 [streams]. End tokens and padding stay.
    """
    end = ends[kinds]
    replace = (torch.rand(*tokens.shape, device=tokens.device) >= pkeep) & (tokens != PAD) & (tokens != end)
    draw = (torch.rand(*tokens.shape, device=tokens.device) * end).long()
    return torch.where(replace, torch.minimum(draw, end - 1), tokens)


def group_counts(tokens: Tensor, kinds: Tensor, ends: Tensor, group: int) -> Tensor:
    """Whole groups of `group` tokens before the first End or padding, int64 [B]."""
    stop = (tokens == PAD) | (tokens == ends[kinds])
    return (stop.cumsum(1) == 0).sum(1) // group


def soft_codes(
    gpt: TokenNetwork, logits: Tensor, groups: Tensor, *, temperature: float, sample: bool
) -> dict[str, Tensor]:
    """One-hot code weights per stream [B, G * per_group, K] of logits [B, L, V], differentiable straight
    through.

    `sample` adds Gumbel noise (a draw from the model); without it the most likely codes are taken. Rows
    after `groups` hold arbitrary codes.
    """
    # As many groups as fit, not as many as there are: reading a maximum back would wait for the device.
    batch = len(logits)
    size = len(gpt.pattern)
    count = logits.shape[1] // size
    steps = logits[:, : count * size].view(batch, count, size, -1)
    valid = torch.arange(count, device=logits.device)[None, :, None, None] < groups[:, None, None, None]
    out = {}
    for name in gpt.names:
        here = steps[:, :, _slots(gpt.pattern, name), : gpt.num_codes[name]]
        here = torch.where(valid, here, 0.0).flatten(1, 2)
        out[name] = straight_through(here, temperature, sample=sample)
    return out


def straight_through(logits: Tensor, temperature: float, *, sample: bool) -> Tensor:
    """One-hot weights [..., V] of logits: a draw by Gumbel noise, or the likeliest. Their gradient is that of
    the softmax by `temperature`.
    """
    if sample:
        return F.gumbel_softmax(logits, tau=temperature, hard=True)
    soft = (logits / temperature).softmax(-1)
    return F.one_hot(logits.argmax(-1), logits.shape[-1]).to(soft) + soft - soft.detach()


def _slots(pattern: Sequence[str], name: str) -> slice | list[int]:
    """Slots of a stream. Evenly spaced, as in all patterns here, they are a slice: a list would be sent to
    the device in every step, which a GPU is waited for.
    """
    slots = [i for i, stream in enumerate(pattern) if stream == name]
    gap = slots[1] - slots[0] if len(slots) > 1 else 1
    even = slice(slots[0], slots[-1] + 1, gap)
    return even if slots == list(range(len(pattern))[even]) else slots


def soft_motion(
    net: TokenNetwork,
    logits: Tensor,
    tokens: Tensor,
    kinds: Tensor,
    *,
    tokenizer: Tokenizer,
    temperature: float,
    sample: bool,
    present: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Motion [B, T, dim] that logits [B, L, V] of `net` predict for clips of tokens and kinds [B, L], with a
    gradient to the logits; and its lengths int64 [B] in frames, after which it is zero.

    Args:
        tokens: The clips' own tokens, which determine the number of groups.
        temperature: Of the softmax that the one-hots are drawn from.
        sample: Draw from the distribution; false takes the likeliest codes.
        present: bool [B, dim], columns of the tokenizer that the clip has (None = all).
    """
    groups = group_counts(tokens, kinds, net.ends, len(net.pattern))
    weights = soft_codes(net, logits, groups, temperature=temperature, sample=sample)
    frames = groups * tokenizer.group_frames
    return tokenizer.decode_soft(weights, frames, present), frames
