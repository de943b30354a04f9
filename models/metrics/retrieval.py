"""Text-motion retrieval: recall, R-precision, matching score (HumanTOMATO sections 4.1.2 and D.2).

All functions take row-aligned embeddings text [N, Z] and motion [N, Z], compute in float64 and return
fractions.

Ranks count the candidates strictly closer than the true one, plus half of those exactly as close: captions
that occur twice share their places, and a collapsed encoder does not look perfect.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

RECALLS = (1, 2, 3, 5, 10)

Distance = Literal["cosine", "euclidean"]
"""Similarity of latents: TMA's by cosine (D.2), those of the evaluator of Guo et al. as they are."""


_ROWS = 512
"""Rows that are compared with all others at a time: the distances of a large split are never all held."""


def ranks(distance: Tensor, positive: Tensor | None = None, first: int = 0) -> Tensor:
    """Rank (0 = first) of each row's nearest true column: distance [R, N], float64 [R].

    `positive` bool [R, N] marks the columns that count as true; column `first` + r of row r always does.
    """
    distance = distance.where(~distance.isnan(), torch.inf)  # what is no number is near to nothing
    true = distance.diagonal(first)
    if positive is not None:
        true = torch.minimum(true, distance.masked_fill(~positive, torch.inf).amin(1))
    closer = (distance < true[:, None]).sum(1)
    equal = (distance == true[:, None]).sum(1)
    return closer.double() + (equal - 1).double() / 2


def recall(
    text: Tensor,
    motion: Tensor,
    *,
    sentence: Tensor | None = None,
    threshold: float | None = None,
    batch: int | None = None,
    recalls: Sequence[int] = RECALLS,
    seed: int = 0,
    distance: Distance = "cosine",
) -> dict[str, float]:
    """Recall@k both ways under the protocols of section D.2, by cosine similarity or Euclidean distance.

    A, full set: neither option. B, threshold: `sentence` [N, E] and `threshold` (0.9): a retrieved item whose
    caption has at least this sentence cosine with the true one is a hit. C and D: `batch` 256 or 32: the set
    is shuffled by `seed`, cut into batches and each is a set of its own; the incomplete last one is dropped
    (a set smaller than `batch` is one batch).

    Returns:
        "t2m/R@1" ..., "t2m/MedR" (1 = first), the same for "m2t", and "size", the number of candidates.
    """
    text = text.double()
    motion = motion.double()
    if distance == "cosine":
        text = F.normalize(text, dim=-1)
        motion = F.normalize(motion, dim=-1)
    found: dict[str, list[Tensor]] = {"t2m": [], "m2t": []}
    batches = _batches(text, motion, batch, None if batch is None else seed)
    # Each batch is a set of candidates of its own; ranks of all batches are averaged together.
    for rows in batches:
        unit = None
        if sentence is not None and threshold is not None:
            unit = F.normalize(sentence[rows].double(), dim=-1)
        for way, (query, among) in {"t2m": (text, motion), "m2t": (motion, text)}.items():
            for first in range(0, len(rows), _ROWS):
                part = slice(first, first + _ROWS)
                between = -(query[rows[part]] @ among[rows].T)
                if distance == "euclidean":
                    between = torch.cdist(query[rows[part]], among[rows])
                positive = None if unit is None or threshold is None else unit[part] @ unit.T >= threshold
                found[way].append(ranks(between, positive, first))
    out = {"size": float(batches.shape[1])}
    for way, parts in found.items():
        rank = torch.cat(parts)
        out |= {f"{way}/R@{k}": (rank < k).double().mean().item() for k in recalls}
        out[f"{way}/MedR"] = rank.quantile(0.5).item() + 1
    return out


def r_precision(
    text: Tensor, motion: Tensor, *, batch: int = 32, top: int = 3, seed: int | None = None
) -> Tensor:
    """Share of texts whose own motion is among the `top` 1, 2, ... nearest of its batch; float64 [top].

    Euclidean distance in consecutive batches (of a shuffle, when `seed` is given); the incomplete last one is
    dropped. With fewer rows than `batch` the whole set is one batch. For TMA-R-Precision pass L2-normalised
    embeddings.
    """
    text, motion, batches = text.double(), motion.double(), _batches(text, motion, batch, seed)
    rank = torch.cat([ranks(torch.cdist(text[rows], motion[rows])) for rows in batches])
    return torch.stack([(rank < k).double().mean() for k in range(1, top + 1)])


def matching_score(
    text: Tensor, motion: Tensor, *, batch: int | None = None, seed: int | None = None
) -> Tensor:
    """Mean Euclidean distance between texts [N, Z] and their own motions [N, Z]; scalar float64.

    `batch` and `seed` drop the same rows as `r_precision` does, as the public evaluators do.
    """
    rows = _batches(text, motion, batch, seed).flatten()
    out: Tensor = torch.linalg.vector_norm(text.double()[rows] - motion.double()[rows], dim=-1).mean()
    return out


def _batches(text: Tensor, motion: Tensor, batch: int | None, seed: int | None) -> Tensor:
    """Row numbers int64 [n, size] of whole batches (None: one of all), shuffled where a seed is given."""
    count = len(text)
    size = count if batch is None else min(batch, count)
    order = torch.arange(count)
    if seed is not None:
        order = torch.randperm(count, generator=torch.Generator().manual_seed(seed))
    return order[: count // size * size].view(-1, size).to(text.device)


# Accuracy of UDE's Table 1: is a motion's own text the nearest among 61? (UDE section 4.3).


def other_texts(meaning: Tensor, count: int, seed: int = 0) -> Tensor:
    """Rows int64 [N, count] of irrelevant texts for each row, drawn without replacement.

    Texts of one number in `meaning`, int64 [N], say the same; every row must have as many of other numbers.
    """
    generator = torch.Generator().manual_seed(seed)
    meaning = meaning.cpu()
    found = []
    for first in range(0, len(meaning), _ROWS):
        own = meaning[first : first + _ROWS, None]
        # The largest draws choose without replacement; texts that mean the same are never chosen.
        draws = torch.rand(len(own), len(meaning), generator=generator, dtype=torch.float64)
        found.append(draws.masked_fill_(own == meaning, -1.0).topk(count, dim=1).indices)
    return torch.cat(found)


def accuracy_among(
    motion: Tensor, text: Tensor, others: Tensor, *, tops: Sequence[int] = (1, 5)
) -> dict[str, float]:
    """Shares of motions whose own text is among the k nearest of it and the others, by cosine similarity.

    Args:
        motion: Embeddings [N, Z] of the motions.
        text: Embeddings [N, Z] of their texts, row by row.
        others: Rows of each motion's other candidates, [N, 60] in the paper (`other_texts`).
        tops: The k of the result.

    Returns:
        "top-1" and so on. Texts exactly as near as the own one count half, so that an encoder that tells
        nothing apart does not look perfect.
    """
    motion = F.normalize(motion.double(), dim=-1)
    text = F.normalize(text.double(), dim=-1)
    candidates = torch.cat([torch.arange(len(motion))[:, None], others], dim=1).to(motion.device)
    ranked = []
    for first in range(0, len(motion), _ROWS):
        rows = slice(first, first + _ROWS)
        # Products are summed alike for every candidate, so that equal texts are exactly as near.
        near = (text[candidates[rows]] * motion[rows, None]).sum(-1).nan_to_num(nan=-1.0)
        own = near[:, :1]
        rest = near[:, 1:]
        ranked.append((rest > own).sum(1) + 0.5 * (rest == own).sum(1))
    rank = torch.cat(ranked)
    return {f"top-{k}": float((rank < k).double().mean()) for k in tops}
