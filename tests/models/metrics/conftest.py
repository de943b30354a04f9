"""Golden vectors of public metrics."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch


@pytest.fixture(scope="session")
def golden(shared: Path) -> dict[str, torch.Tensor]:
    with np.load(shared / "golden" / "t6_metrics_A.npz", allow_pickle=False) as data:
        return {
            key: torch.from_numpy(np.asarray(data[key]))
            for key in data.files
            if data[key].dtype.kind in "fiub"
        }
