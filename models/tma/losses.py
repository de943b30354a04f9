"""The terms of TMA's loss as functions of tensors (HumanTOMATO appendix D.1, B.5.1).

L = L_rec + 1e-5 KL + 1e-5 L_E + 0.1 L_NCE. Every function computes and returns float32, under
autocast and of half inputs too.

Distributed: each function returns a value whose *mean over ranks* is the loss of the concatenated batch, so
DDP's gradient averaging reproduces one process with the whole batch. Rows per rank must be equal; numbers of
real frames need not.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor

from motionloom.datasets.base.config import Config
from motionloom.models.training.distributed import gather_rows, gather_rows_with_grad, masked_mean


class TmaLossConfig(Config):
    """Weights of the loss terms and the negative filter; the defaults but `temperature` are the paper's."""

    reconstruction: float = Field(default=1.0, ge=0)
    kl: float = Field(default=1e-5, ge=0)
    latent: float = Field(default=1e-5, ge=0)
    contrastive: float = Field(default=0.1, ge=0)
    temperature: float = Field(default=0.1, gt=0)
    """Of the contrastive loss [ours]; the paper states none."""
    threshold: float | None = Field(default=0.85, ge=-1, le=1)
    """Captions with a higher sBERT cosine are not negatives of each other; null keeps all negatives."""


def reconstruction_loss(pred: Tensor, target: Tensor, mask: Tensor, present: Tensor | None = None) -> Tensor:
    """SmoothL1 over the real frames and the columns that each clip holds.

    Args:
        pred: [B, T, D].
        target: [B, T, D].
        mask: bool [B, T], true at real frames.
        present: bool [B, D]; None = all.
    """
    error = F.smooth_l1_loss(pred.float(), target.float(), reduction="none")
    return masked_mean(error, mask, present)


def kl_divergence(mu_q: Tensor, logvar_q: Tensor, mu_p: Tensor, logvar_p: Tensor) -> Tensor:
    """KL(q || p) of diagonal Gaussians [B, Z], mean over batch *and* dimensions (TMR's reduction)."""
    mu_q, logvar_q, mu_p, logvar_p = (x.float() for x in (mu_q, logvar_q, mu_p, logvar_p))
    ratio = logvar_q - logvar_p
    terms = ratio.exp() + (mu_q - mu_p).square() * (-logvar_p).exp() - 1 - ratio
    return 0.5 * terms.mean()


def kl_four(text: tuple[Tensor, Tensor], motion: tuple[Tensor, Tensor]) -> Tensor:
    """Both KLs between the text and the motion Gaussian, and both to N(0, 1), summed (B.5.1)."""
    zero = torch.zeros_like(text[0])
    unit = (zero, zero)
    pairs = ((text, motion), (motion, text), (text, unit), (motion, unit))
    return torch.stack([kl_divergence(*q, *p) for q, p in pairs]).sum()


def latent_loss(text: Tensor, motion: Tensor) -> Tensor:
    """L_E: SmoothL1 between the two latents [B, Z]."""
    return F.smooth_l1_loss(text.float(), motion.float())


def false_negatives(sentence: Tensor, threshold: float) -> Tensor:
    """Pairs of captions with the same meaning, bool [N, N]: cosine of sBERT embeddings [N, E] > `threshold`.

    Exact duplicates are included (OpenTMA keeps those whose cosine rounds to 1.0 as negatives), the diagonal
    never is.
    """
    unit = F.normalize(sentence.float(), dim=-1)
    similar = unit @ unit.T > threshold
    return similar.fill_diagonal_(False)


def info_nce(
    text: Tensor,
    motion: Tensor,
    sentence: Tensor | None = None,
    *,
    temperature: float = 0.1,
    threshold: float | None = 0.85,
) -> Tensor:
    """Symmetric InfoNCE on cosine similarity over the global batch: text, motion [B, Z], sentence [B, E].

    Rows are gathered from all ranks with gradient: every rank computes the same global loss, and the gradient
    that reaches a rank's rows, averaged by DDP, equals that of one process. Pairs of `false_negatives` leave
    the softmax; without `sentence` or `threshold` every pair is a negative.
    """
    with torch.autocast(text.device.type, enabled=False):
        text = F.normalize(gather_rows_with_grad(text.float()), dim=-1)
        motion = F.normalize(gather_rows_with_grad(motion.float()), dim=-1)
        logits = text @ motion.T / temperature
        if sentence is not None and threshold is not None:
            logits = logits.masked_fill(false_negatives(gather_rows(sentence), threshold), -torch.inf)
        target = torch.arange(len(logits), device=logits.device)
        return 0.5 * (F.cross_entropy(logits, target) + F.cross_entropy(logits.T, target))
