"""FID: by the Cholesky factor and by the symmetric root, against Gaussians whose distance is known."""

from __future__ import annotations

import pytest
import torch

from motionloom.models.metrics.frechet import frechet_distance

WIDTH = 24


def commuting(spread: torch.Tensor, other: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, float]:
    """Covariances with the same axes, and their distance: the sum of (sqrt a - sqrt b)^2."""
    axes = torch.linalg.qr(
        torch.randn(WIDTH, WIDTH, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    )[0]
    truth = (spread.sqrt() - other.sqrt()).square().sum().item()
    return axes * spread @ axes.T, axes * other @ axes.T, truth


@pytest.mark.parametrize("least", [1.0, 1e-6, 1e-13, 0.0])
def test_distance_of_known_gaussians(least: float) -> None:
    """Well conditioned covariances take the Cholesky factor, others the symmetric root; both find the truth.

    Eigenvalues are known to 1e-16 of the largest, so a vanishing one's root to 1e-8, WIDTH times at most.
    """
    spread = torch.logspace(0, 1, WIDTH, dtype=torch.float64)
    spread[:8] *= least
    a, b, truth = commuting(spread, torch.linspace(1, 3, WIDTH, dtype=torch.float64))
    zero, one = torch.zeros(WIDTH, dtype=torch.float64), torch.ones(WIDTH, dtype=torch.float64)
    sure = 1e-12 if least > 1e-5 else 1e-6
    assert frechet_distance(zero, a, zero, b).item() == pytest.approx(truth, rel=sure)
    assert frechet_distance(zero, b, one, a).item() == pytest.approx(truth + WIDTH, rel=sure)
    assert frechet_distance(zero, a, zero, a).item() == pytest.approx(0.0, abs=WIDTH * 1e-6)
