"""Joint errors against golden vectors (OpenTMA, MotionGPT) and exact invariances."""

from __future__ import annotations

import numpy as np
import pytest
import roma
import torch

from motionloom.models.metrics.position import KINDS, PUBLIC_SIDES, position_errors
from motionloom.models.metrics.reconstruction import accel, joint_errors, mpjpe, pa_mpjpe, procrustes


def close(value: torch.Tensor, expected: torch.Tensor, rtol: float = 1e-5) -> None:
    torch.testing.assert_close(value.double(), expected.double(), rtol=rtol, atol=1e-8)


@pytest.mark.parametrize("clip", [0, 1])
def test_frame_errors_equal_opentma(golden: dict[str, torch.Tensor], clip: int) -> None:
    n = int(golden["mr_lengths"][clip])
    pred, target = golden["mr_rst"][clip, :n].double(), golden["mr_ref"][clip, :n].double()
    # The golden values come out of float32 arithmetic on metres: 2e-6 of the distances at hand.
    close(mpjpe(pred, target), 1000 * golden[f"mpjpe_frame_{clip}"])
    close(mpjpe(pred, target, root=None), 1000 * golden[f"mpjpe_noalign_frame_{clip}"])
    close(pa_mpjpe(pred, target), 1000 * golden[f"pampjpe_frame_{clip}"])
    close(accel(pred, target), 1000 * golden[f"accel_frame_{clip}"])


def test_batch_totals_equal_motiongpt(golden: dict[str, torch.Tensor]) -> None:
    pred, target, length = golden["mr_rst"], golden["mr_ref"], golden["mr_lengths"]
    out = joint_errors(pred, target, length)
    close(torch.tensor([*out.means().values()]), golden["mr_metrics_mm"])
    both = joint_errors(pred[:1], target[:1], length[:1]) + joint_errors(pred[1:], target[1:], length[1:])
    for a, b in zip(both, out, strict=True):
        close(a, b)
    spoiled = pred.clone()
    spoiled[1, int(length[1]) :] = torch.nan
    assert joint_errors(spoiled, target, length).means() == out.means()


def test_procrustes_undoes_any_similarity() -> None:
    generator = torch.Generator().manual_seed(0)
    target = torch.randn(50, 7, 3, generator=generator, dtype=torch.float64)
    rotation = roma.random_rotmat(50, dtype=torch.float64)
    pred = 1.7 * (target @ rotation.mT) + torch.tensor([3.0, -2.0, 1.0])
    torch.testing.assert_close(procrustes(pred, target), target)
    mirrored = target * torch.tensor([-1.0, 1.0, 1.0])
    assert (pa_mpjpe(mirrored, target) > 100).all()  # a reflection is not undone
    assert torch.isfinite(procrustes(torch.zeros(1, 7, 3), target[:1].float())).all()


# APE and AVE equal public code's figures, wherever a motion begins and whichever way it faces.


def recorded(golden: dict[str, torch.Tensor], name: str, row: int) -> torch.Tensor:
    return golden[name][row, : int(golden["mr_lengths"][row])]


@pytest.mark.parametrize(
    ("case", "scale"), [("humanml3d_raw", 1.0), ("humanml3d_m", 1.5625), ("motionx_m", 1000.0)]
)
def test_public_code(golden: dict[str, torch.Tensor], case: str, scale: float) -> None:
    """In the public order: joints, pose, root, path; of APE, then of AVE. The reference is in float32."""
    found = [
        position_errors(recorded(golden, "mr_rst", k), recorded(golden, "mr_ref", k), sides=PUBLIC_SIDES)
        for k in (0, 1)
    ]
    frames = [one.frames for one in found]
    values = [float(np.average([one.ape[kind] for one in found], weights=frames)) / scale for kind in KINDS]
    values += [float(np.mean([one.ave[kind] for one in found])) / scale**2 for kind in KINDS]
    assert values == pytest.approx(golden[f"apeave_{case}"].tolist(), rel=1e-5)


def test_place_and_heading_of_the_start_do_not_count(golden: dict[str, torch.Tensor]) -> None:
    real = recorded(golden, "mr_ref", 0).double()
    turn = torch.tensor([[np.cos(1.0), 0, np.sin(1.0)], [0, 1, 0], [-np.sin(1.0), 0, np.cos(1.0)]])
    moved = real @ turn.T + torch.tensor([3.0, 0.4, -2.0])
    found = position_errors(moved, real)
    assert max(abs(v) for v in (*found.ape.values(), *found.ave.values())) < 1e-9
