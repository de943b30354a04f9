"""APE and AVE equal public code's figures, wherever a motion begins and whichever way it faces."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from motionloom.models.metrics.position import KINDS, PUBLIC_SIDES, position_errors


def clip(golden: dict[str, torch.Tensor], name: str, row: int) -> torch.Tensor:
    return golden[name][row, : int(golden["mr_lengths"][row])]


@pytest.mark.parametrize(
    ("case", "scale"), [("humanml3d_raw", 1.0), ("humanml3d_m", 1.5625), ("motionx_m", 1000.0)]
)
def test_public_code(golden: dict[str, torch.Tensor], case: str, scale: float) -> None:
    """In the public order: joints, pose, root, path; of APE, then of AVE. The reference is in float32."""
    found = [
        position_errors(clip(golden, "mr_rst", k), clip(golden, "mr_ref", k), sides=PUBLIC_SIDES)
        for k in (0, 1)
    ]
    frames = [one.frames for one in found]
    values = [float(np.average([one.ape[kind] for one in found], weights=frames)) / scale for kind in KINDS]
    values += [float(np.mean([one.ave[kind] for one in found])) / scale**2 for kind in KINDS]
    assert values == pytest.approx(golden[f"apeave_{case}"].tolist(), rel=1e-5)


def test_place_and_heading_of_the_start_do_not_count(golden: dict[str, torch.Tensor]) -> None:
    real = clip(golden, "mr_ref", 0).double()
    turn = torch.tensor([[np.cos(1.0), 0, np.sin(1.0)], [0, 1, 0], [-np.sin(1.0), 0, np.cos(1.0)]])
    moved = real @ turn.T + torch.tensor([3.0, 0.4, -2.0])
    found = position_errors(moved, real)
    assert max(abs(v) for v in (*found.ape.values(), *found.ave.values())) < 1e-9


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="one shape"):
        position_errors(torch.zeros(4, 22, 3), torch.zeros(5, 22, 3))
    with pytest.raises(ValueError, match="two frames"):
        position_errors(torch.zeros(1, 22, 3), torch.zeros(1, 22, 3))
