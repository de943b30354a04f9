"""Loss terms of TM2T: words counted or averaged, teacher forcing, hidden ends of clips, the critic."""

from __future__ import annotations

import torch
from pydantic import Field
from torch import Tensor
from torch.nn import functional

from motionloom.datasets.schema import Config
from motionloom.models.training.distributed import masked_mean, sum_over_ranks
from motionloom.pipeline.baselines.tm2t.network import PAD


class CriticConfig(Config):
    """The adversarial term."""

    weight: float = Field(0.5, gt=0)
    """Weight of the adversarial term in the tokenizer's loss."""
    start: int = Field(10_000, ge=0)
    """First step with the term, and the critic's first step; the release begins with its tenth epoch."""
    width: int = Field(512, ge=2, multiple_of=2)
    """Channels of the first convolution; the second has half."""


class CaptionLossConfig(Config):
    """How words are counted, and what of the tokens is hidden."""

    summed: bool = False
    """Add the words' errors of a batch up, as TM2T does: then all gradients are cut to `optim.grad_clip`."""
    hide: float = Field(default=1 / 3, ge=0, le=1)
    """Share of the draws in which the first or the last group of a clip is not seen (TM2T leaves out a
    token at either end)."""


class Seq2SeqLossConfig(Config):
    """Teacher forcing and inverse alignment."""

    forced: tuple[float, float] = (0.9, 0.1)
    """Share of the clips of which the true tokens are read, in the first and in the last step; the likeliest
    ones are read of the others."""
    inverse_weight: float = Field(default=1.0, ge=0)
    """Weight of the captioner's cross-entropy; 0 turns it off, and no captioner is needed."""
    gumbel_temperature: float = Field(default=1.0, gt=0)
    summed: bool = False
    """Add errors of a batch up, as TM2T does."""


def summed_or_mean(each: Tensor, counted: Tensor, *, summed: bool) -> Tensor:
    """Errors `each` where `counted`, over the batches of all ranks: their mean or their sum."""
    mean = masked_mean(each, counted)
    return mean * sum_over_ranks(counted.sum().float()) if summed else mean


def word_errors(logits: Tensor, words: Tensor) -> Tensor:
    """Cross-entropy of each word [B, W]; 0 at padding."""
    each = functional.cross_entropy(logits.flatten(0, 1), words.flatten(), ignore_index=PAD, reduction="none")
    return each.view_as(words)


def hidden_ends(groups: Tensor, size: int, group: int, share: float) -> Tensor:
    """Bool [B, size]: the first or the last group of `group` tokens of a `share` of rows; `groups` [B]."""
    drawn = torch.rand(len(groups), device=groups.device)
    first = torch.where(torch.rand_like(drawn) < 0.5, 0, groups - 1) * group
    place = torch.arange(size, device=groups.device) - first[:, None]
    # A clip of one group would have nothing left.
    return ((drawn < share) & (groups > 1))[:, None] & (place >= 0) & (place < group)
