"""Diversity and MModality against golden vectors of T2M-GPT and OpenTMA."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from motionloom.datasets.schema import UserError
from motionloom.models.metrics.diversity import diversity, multimodality


@pytest.fixture(scope="module")
def golden(shared: Path) -> dict[str, torch.Tensor]:
    with np.load(shared / "golden" / "t6_metrics_A.npz", allow_pickle=False) as data:
        return {key: torch.from_numpy(np.asarray(data[key])) for key in data.files}


def test_equal_public_ones_under_their_seed(golden: dict[str, torch.Tensor]) -> None:
    seed = int(golden["div_seed"])
    for name in ("pred", "gt"):
        expected = golden[f"diversity_{name}"].item()
        assert diversity(golden[name], seed=seed).item() == pytest.approx(expected, rel=1e-5)
    mine = diversity(golden["pred"], seed=seed).item()
    assert mine == pytest.approx(golden["opentma_diversity_pred"].item(), rel=1e-5)
    mine = multimodality(golden["mm_embeddings"], seed=seed).item()
    assert mine == pytest.approx(golden["multimodality"].item(), rel=1e-5)


def test_small_sets() -> None:
    assert diversity(torch.ones(5, 3)).item() == 0
    assert multimodality(torch.arange(4.0).view(1, 4, 1), pairs=4).item() > 0
    with pytest.raises(UserError, match="each text has 4 samples"):
        multimodality(torch.zeros(2, 4, 3))
