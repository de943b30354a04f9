"""Retrieval accuracy of UDE's Table 1: is a motion's own text the nearest among 61? (UDE section 4.3)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from motionloom.datasets.schema import UserError


def accuracy_among(
    motion: Tensor,
    text: Tensor,
    *,
    candidates: int = 61,
    tops: Sequence[int] = (1, 5),
    same: Tensor | None = None,
    seed: int = 0,
) -> dict[str, float]:
    """Shares of motions whose own text is among the k nearest of `candidates`, by cosine similarity.

    Args:
        motion: Embeddings [N, Z] of the motions.
        text: Embeddings [N, Z] of their texts, row by row.
        candidates: The own text and so many less one others, drawn at random for each motion without
            replacement.
        tops: The k of the result.
        same: bool [N, N], texts that mean the same as the row's own and so are no irrelevant ones.
        seed: Of the draws.

    Returns:
        "top-1" and so on. Texts exactly as near as the own one count half, so that an encoder that tells
        nothing apart does not look perfect.
    """
    count = len(motion)
    allowed = ~torch.eye(count, dtype=torch.bool) if same is None else ~(same.cpu() | torch.eye(count).bool())
    fewest = int(allowed.sum(1).min()) if count else 0
    if candidates < 2 or fewest < candidates - 1:
        raise UserError(
            f"retrieval among {candidates} needs {max(candidates - 1, 1)} other texts for every motion, and "
            f"one has {fewest}; evaluate more clips or among fewer"
        )
    generator = torch.Generator().manual_seed(seed)
    draws = torch.rand(count, count, generator=generator, dtype=torch.float64).masked_fill(~allowed, -1.0)
    others = draws.topk(candidates - 1, dim=1).indices.to(motion.device)
    motion, text = F.normalize(motion.double(), dim=-1), F.normalize(text.double(), dim=-1)
    near = motion @ text.T
    own, rest = near.diagonal()[:, None], near.gather(1, others)
    rank = (rest > own).sum(1) + 0.5 * (rest == own).sum(1)
    return {f"top-{k}": float((rank < k).double().mean()) for k in tops}
