"""Joint errors against golden vectors (OpenTMA, MotionGPT) and exact invariances."""

from __future__ import annotations

import pytest
import roma
import torch

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


@pytest.mark.usefixtures("float64")
def test_chosen_joints_keep_the_root_alignment() -> None:
    generator = torch.Generator().manual_seed(0)
    target = torch.randn(2, 9, 6, 3, generator=generator)
    pred = target + torch.tensor([5.0, 0.0, 0.0])
    pred[:, :, 4] += torch.tensor([0.0, 0.01, 0.0])
    length = torch.tensor([9, 4])
    assert joint_errors(pred, target, length).means()["mpjpe"] == pytest.approx(10 / 6, rel=1e-4)
    hand = joint_errors(pred, target, length, joints=torch.tensor([4, 5]))
    assert hand.means()["mpjpe"] == pytest.approx(5.0, rel=1e-4)
    assert (hand.frames.item(), hand.accel_frames.item()) == (13, 9)
