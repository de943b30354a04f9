"""`Bones`: where the bones of a motion point, as a loss sees it [ours].

Positions are relative to the root, so in the plain error a finger is mostly where its arm is: a hand that is
half open costs little beside an arm that is a hand's width off. The vector from a joint's parent to the joint
does not know of the arm; divided by the bone's length it counts every bone alike.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError


class Bones(nn.Module):
    """Differences of normalised features -> differences of bone vectors, in units of the bones' rest lengths.

    Args:
        layout: Layout of the full frames.
        columns: Those of its columns that the features are, ascending.
        std: What all columns of the layout were divided by, [D].
    """

    positions: Tensor
    parents: Tensor
    height: Tensor
    scale: Tensor
    height_scale: Tensor
    lengths: Tensor

    def __init__(self, layout: MotionLayout, columns: NDArray[np.int64], std: NDArray[np.floating]) -> None:
        super().__init__()
        height = layout.slice("root_height").start
        wanted = np.arange(layout.slice("positions").start, layout.slice("positions").stop)
        held = wanted[np.isin(wanted, columns)]
        joints = np.concatenate([[0], (held[::3] - wanted[0]) // 3 + 1])
        parents = np.asarray(layout.skeleton.parents)[joints[1:]]
        if height not in columns or not np.isin(parents, joints).all():
            raise UserError(
                "bone_weight needs the joints from the root on; set it to 0 for hands or faces alone"
            )
        lengths = np.linalg.norm(layout.skeleton.offsets, axis=1)[joints[1:], None]
        for name, value in (
            ("positions", np.searchsorted(columns, held)),
            ("parents", np.searchsorted(joints, parents)),
            ("height", np.searchsorted(columns, height)),
            ("scale", std[held].reshape(-1, 3)),
            ("height_scale", std[height]),
            ("lengths", lengths),
        ):
            array = np.asarray(value)
            kind = torch.float32 if array.dtype.kind == "f" else torch.int64
            self.register_buffer(name, torch.as_tensor(array, dtype=kind), persistent=False)

    def forward(self, features: Tensor) -> Tensor:
        """[..., D] -> [..., bones, 3]."""
        features = features.float()
        joints = features[..., self.positions].reshape(*features.shape[:-1], -1, 3) * self.scale
        # Positions are relative to the root but in height, which counts from the floor.
        root = torch.zeros_like(joints[..., :1, :])
        root[..., 0, 1] = features[..., self.height] * self.height_scale
        ends = torch.cat([root, joints], dim=-2)
        vectors: Tensor = joints - ends[..., self.parents, :]
        return vectors / self.lengths

    def held(self, held: Tensor) -> Tensor:
        """Bool [B, D] -> bool [B, bones]: both ends are held, for a part's columns are held together."""
        return held[:, self.positions[::3]]
