"""FID, Diversity and MModality against golden vectors of T2M-GPT and OpenTMA, and known Gaussians."""

from __future__ import annotations

import pytest
import torch

from motionloom.datasets.schema import UserError
from motionloom.models.metrics.distributions import diversity, fid, frechet_distance, multimodality

WIDTH = 24


def test_equal_public_ones_under_their_seed(golden: dict[str, torch.Tensor]) -> None:
    seed = int(golden["div_seed"])
    for name in ("pred", "gt"):
        expected = golden[f"diversity_{name}"].item()
        assert diversity(golden[name], seed=seed).item() == pytest.approx(expected, rel=1e-5)
    mine = diversity(golden["pred"], seed=seed).item()
    assert mine == pytest.approx(golden["opentma_diversity_pred"].item(), rel=1e-5)
    mine = multimodality(golden["mm_embeddings"], seed=seed).item()
    assert mine == pytest.approx(golden["multimodality"].item(), rel=1e-5)


@pytest.mark.parametrize("seed", range(5))
def test_of_few_repeats_all_pairs_count_whatever_the_seed(seed: int) -> None:
    """A drawn pair of two repeats would be of one with itself every second time."""
    assert multimodality(torch.tensor([[[0.0], [3.0]], [[1.0], [2.0]]]), seed=seed).item() == 2
    assert multimodality(torch.tensor([[[0.0], [1.0], [5.0]]]), seed=seed).item() == pytest.approx(10 / 3)
    assert diversity(torch.ones(5, 3)).item() == 0
    with pytest.raises(UserError, match="two samples"):
        multimodality(torch.zeros(2, 1, 3))


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


def test_fid_equals_public_ones(golden: dict[str, torch.Tensor]) -> None:
    pred, gt = golden["pred"], golden["gt"]
    for name, mine, rel in (
        ("fid_pred_gt", fid(pred, gt), 1e-5),
        ("fid_opentma", fid(gt, pred), 1e-5),
        ("fid_pred_gt_float64", fid(pred, gt), 1e-9),
        ("fid_singular_40", fid(pred[:40], gt[:40]), 1e-3),
    ):
        assert mine.item() == pytest.approx(golden[name].item(), rel=rel), name
