"""`SixD`: the columns of `smpl75` as MotionCLIP reads them, 25 x 6: the first two columns of each joint's
rotation, and the translation, filled up with zeros.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from motionloom.datasets.motion.features.torch_joints import torch_smpl_joints
from motionloom.datasets.motion.layout import MotionLayout


class SixD(nn.Module):
    """Normalised columns [..., 75] <-> [..., 150] in their own units."""

    mean: Tensor
    std: Tensor
    dim = 150

    def __init__(self, layout: MotionLayout) -> None:
        super().__init__()
        self.trans, self.pose = layout.slice("trans"), layout.slice("pose")
        self.register_buffer("mean", torch.zeros(layout.dim))
        self.register_buffer("std", torch.ones(layout.dim))

    @torch.no_grad()
    def learn(self, mean: NDArray[np.floating], std: NDArray[np.floating]) -> None:
        """How the columns were normalised, each [75]; saved with the weights."""
        self.mean.copy_(torch.as_tensor(mean))
        self.std.copy_(torch.as_tensor(std))

    def encode(self, x: Tensor) -> Tensor:
        """Normalised columns -> two columns of 24 rotations, one after the other, and the translation."""
        import roma

        values = x.to(torch.promote_types(x.dtype, torch.float32)) * self.std + self.mean
        turns = values[..., self.pose].reshape(*x.shape[:-1], 24, 3)
        two = roma.rotvec_to_rotmat(turns)[..., :2].transpose(-1, -2)
        trans = values[..., self.trans]
        return torch.cat([two.flatten(-3), trans, torch.zeros_like(trans)], dim=-1)

    def decode(self, seen: Tensor) -> Tensor:
        """The inverse of `encode`, of what is near rotations too."""
        import roma

        local, trans = self._parts(seen)
        turns = roma.rotmat_to_rotvec(local).flatten(-2)
        values = torch.empty(*seen.shape[:-1], len(self.mean), dtype=turns.dtype, device=seen.device)
        values[..., self.pose], values[..., self.trans] = turns, trans
        return (values - self.mean) / self.std

    def joints(self, seen: Tensor) -> Tensor:
        """Joints [..., 22, 3] in metres."""
        return torch_smpl_joints(*self._parts(seen))

    def _parts(self, seen: Tensor) -> tuple[Tensor, Tensor]:
        """Rotations [..., 24, 3, 3] by Gram and Schmidt, and translations [..., 3]."""
        import roma

        two = seen[..., :144].reshape(*seen.shape[:-1], 24, 2, 3).transpose(-1, -2)
        return roma.special_gramschmidt(two), seen[..., 144:147]
