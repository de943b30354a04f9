"""FID, Diversity and MModality of embeddings (HumanTOMATO section 4.1.2).

FID is taken by a symmetric eigen-decomposition: tr sqrt(A B) of two covariances equals the sum of square
roots of the eigenvalues of R' B R for any R with A = R R', which is symmetric: no general matrix square root,
no imaginary parts to drop, and singular covariances need no epsilon. R is the Cholesky factor where A has
one, which is the fastest, and else the symmetric root.

Pairs of Diversity and MModality are drawn as the public evaluators draw them (two draws without replacement,
from numpy's legacy generator), so that the same seed gives their value.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def statistics(x: Tensor) -> tuple[Tensor, Tensor]:
    """Mean [Z] and covariance [Z, Z], over N - 1, of embeddings [N >= 2, Z]; float64 on the CPU."""
    x = x.cpu().double()
    mean = x.mean(0)
    centred = (x - mean).numpy(force=True)
    product = torch.from_numpy(centred.T @ centred)  # numpy makes one half of a symmetric product
    return mean, product / (len(x) - 1)


def _eigenvalues(a: Tensor, b: Tensor) -> Tensor:
    """Return the eigenvalues of `a` `b` [Z], both symmetric and not negative."""
    from scipy.linalg import LinAlgError, eigh

    try:
        return torch.from_numpy(eigh(b.numpy(), a.numpy(), type=2, eigvals_only=True, driver="gv"))
    except LinAlgError:  # `a` has no Cholesky factor
        values, vectors = torch.linalg.eigh(a)
        root = (vectors * values.clamp(min=0).sqrt()) @ vectors.T
        out: Tensor = torch.linalg.eigvalsh(root.T @ b @ root)
        return out


def frechet_distance(mean_a: Tensor, cov_a: Tensor, mean_b: Tensor, cov_b: Tensor) -> Tensor:
    """Squared Frechet distance of two Gaussians; scalar float64, never negative."""
    mean_a, cov_a, mean_b, cov_b = (x.cpu().double() for x in (mean_a, cov_a, mean_b, cov_b))
    shared = _eigenvalues(cov_a, cov_b).clamp(min=0).sqrt().sum()
    distance = (mean_a - mean_b).square().sum() + cov_a.trace() + cov_b.trace() - 2 * shared
    out: Tensor = distance.clamp(min=0)
    return out


def fid(a: Tensor, b: Tensor) -> Tensor:
    """Frechet distance of embeddings [N, Z] and [M, Z]."""
    return frechet_distance(*statistics(a), *statistics(b))


def _two_draws(count: int, pairs: int, seed: int) -> tuple[Tensor, Tensor]:
    generator = np.random.RandomState(seed)
    first = generator.choice(count, pairs, replace=False)
    return torch.from_numpy(first), torch.from_numpy(generator.choice(count, pairs, replace=False))


def diversity(x: Tensor, *, pairs: int = 300, seed: int = 0) -> Tensor:
    """Mean distance (float64) of min(`pairs`, N) random pairs of rows [N, Z]; `ValueError` for one row."""
    if len(x) < 2:
        raise ValueError(f"diversity of {len(x)} rows: 2 or more are needed")
    first, second = _two_draws(len(x), min(pairs, len(x)), seed)
    x = x.double()
    out: Tensor = torch.linalg.vector_norm(x[first] - x[second], dim=-1).mean()
    return out


def multimodality(x: Tensor, *, pairs: int = 10, seed: int = 0) -> Tensor:
    """Mean distance of `pairs` random pairs among the repeats of each text: x [texts, repeats >= 2, Z].
    Scalar float64.

    The published draw may pair a repeat with itself. With fewer repeats than `pairs` that would be most of
    what is drawn: then it is the mean of all pairs.
    """
    count = x.shape[1]
    if count < pairs:
        first, second = torch.triu_indices(count, count, 1)
    else:
        first, second = _two_draws(count, pairs, seed)
    x = x.double()
    out: Tensor = torch.linalg.vector_norm(x[:, first] - x[:, second], dim=-1).mean()
    return out
