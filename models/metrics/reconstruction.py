"""Reconstruction errors of joints: MPJPE, PA-MPJPE, ACCEL (HumanTOMATO section 4.1.2), whole batches at once.

Joints are metres [..., T, N, 3]; results are millimetres (ACCEL: mm per frame squared, a second difference
that is not divided by the frame time, as in the public MLD/MotionGPT metrics).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from motionloom.models.layers.transformer import length_mask


class JointErrors(NamedTuple):
    """Sums over frames, so that batches can be added up; `means()` divides."""

    mpjpe: Tensor
    pa_mpjpe: Tensor
    accel: Tensor
    frames: Tensor
    accel_frames: Tensor

    def __add__(self, other: object) -> JointErrors:  # type: ignore[override]
        if not isinstance(other, JointErrors):
            return NotImplemented
        return JointErrors(*(a + b for a, b in zip(self, other, strict=True)))

    def means(self) -> dict[str, float]:
        """MPJPE and PA-MPJPE per frame (mm), ACCEL per inner frame (mm / frame^2)."""
        frames = self.frames.clamp(min=1)
        inner = self.accel_frames.clamp(min=1)
        return {
            "mpjpe": (self.mpjpe / frames).item(),
            "pa_mpjpe": (self.pa_mpjpe / frames).item(),
            "accel": (self.accel / inner).item(),
        }


def mpjpe(pred: Tensor, target: Tensor, *, root: int | None = 0) -> Tensor:
    """Mean joint distance in mm, [..., T, N, 3] -> [..., T], with joint `root` of both at the origin."""
    if root is not None:
        pred = pred - pred[..., root : root + 1, :]
        target = target - target[..., root : root + 1, :]
    out: Tensor = 1000 * torch.linalg.vector_norm(pred - target, dim=-1).mean(-1)
    return out


def procrustes(pred: Tensor, target: Tensor) -> Tensor:
    """`pred` [..., N, 3] under the similarity transform nearest to `target` (least squares)."""
    pred_mean = pred.mean(-2, keepdim=True)
    target_mean = target.mean(-2, keepdim=True)
    a = pred - pred_mean
    b = target - target_mean
    u, s, vh = torch.linalg.svd(a.mT @ b)
    # A reflection is not a rigid motion: the direction of the smallest singular value is flipped back.
    sign = torch.ones_like(s)
    sign[..., -1] = torch.where(torch.linalg.det(u @ vh) < 0, -1.0, 1.0)
    rotation = (u * sign[..., None, :]) @ vh
    scale = (s * sign).sum(-1) / a.square().sum((-1, -2)).clamp(min=torch.finfo(a.dtype).tiny)
    aligned: Tensor = scale[..., None, None] * (a @ rotation) + target_mean
    return aligned


def pa_mpjpe(pred: Tensor, target: Tensor) -> Tensor:
    """MPJPE per frame after a similarity alignment of each frame, mm: [..., T, N, 3] -> [..., T]."""
    return mpjpe(procrustes(pred, target), target, root=None)


def accel(pred: Tensor, target: Tensor) -> Tensor:
    """Mean joint acceleration error per inner frame, mm / frame^2: [..., T, N, 3] -> [..., T - 2]."""
    second = (pred - target).diff(n=2, dim=-3)
    out: Tensor = 1000 * torch.linalg.vector_norm(second, dim=-1).mean(-1)
    return out


def joint_errors(
    pred: Tensor, target: Tensor, length: Tensor, *, joints: Tensor | None = None, root: int = 0
) -> JointErrors:
    """Error sums of a padded batch: pred, target [B, T, N, 3] metres, length int64 [B].

    `joints` (indices) restricts the mean to body or hands. MPJPE and PA-MPJPE align joint `root` of each
    frame first (an index into the full skeleton); ACCEL does not, as in the public metrics. What lies behind
    `length` is never read.
    """
    pred = pred.double()
    target = target.double()
    keep = slice(None) if joints is None else joints
    real = length_mask(length, pred.shape[1])
    moved = (pred - pred[:, :, root : root + 1])[real][:, keep]
    goal = (target - target[:, :, root : root + 1])[real][:, keep]
    inner = length_mask((length - 2).clamp(min=0), max(0, pred.shape[1] - 2))
    return JointErrors(
        mpjpe(moved, goal, root=None).sum(),
        pa_mpjpe(moved, goal).sum(),
        accel(pred[:, :, keep], target[:, :, keep])[inner].sum(),
        real.sum(),
        inner.sum(),
    )
