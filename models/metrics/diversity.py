"""Diversity and MModality of embeddings (HumanTOMATO section 4.1.2): mean distances of randomly drawn pairs.

Pairs are drawn as the public evaluators draw them (two draws without replacement, from numpy's legacy
generator), so that the same seed gives their value.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from motionloom.datasets.schema import UserError


def _two_draws(count: int, pairs: int, seed: int) -> tuple[Tensor, Tensor]:
    generator = np.random.RandomState(seed)
    first = generator.choice(count, pairs, replace=False)
    return torch.from_numpy(first), torch.from_numpy(generator.choice(count, pairs, replace=False))


def diversity(x: Tensor, *, pairs: int = 300, seed: int = 0) -> Tensor:
    """Mean distance of `pairs` random pairs of rows of x [N, Z]; with N < `pairs`, of N pairs. Scalar
    float64.
    """
    first, second = _two_draws(len(x), min(pairs, len(x)), seed)
    x = x.double()
    out: Tensor = torch.linalg.vector_norm(x[first] - x[second], dim=-1).mean()
    return out


def multimodality(x: Tensor, *, pairs: int = 10, seed: int = 0) -> Tensor:
    """Mean distance of `pairs` random pairs among the repeats of each text: x [texts, repeats, Z]. Scalar
    float64.
    """
    if pairs > x.shape[1]:
        raise UserError(
            f"MModality draws {pairs} pairs and each text has {x.shape[1]} samples; sample more or draw fewer"
        )
    first, second = _two_draws(x.shape[1], pairs, seed)
    x = x.double()
    out: Tensor = torch.linalg.vector_norm(x[:, first] - x[:, second], dim=-1).mean()
    return out
