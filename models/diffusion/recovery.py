"""`Recovery`: joints and the root's way of normalised features, with gradient, seen from any frame.

An edit knows where some frame of its middle stands, and the frames before it as well as those after it are
placed by it.

Legend: B batch, T frames, D features (the columns of a part), N joints.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from motionloom.datasets.motion.features.torch_joints import torch_joints_of, torch_way
from motionloom.datasets.motion.layout import ROOT, MotionLayout
from motionloom.datasets.schema import UserError


class Recovery:
    """Recovers joints from the `columns` of a layout, normalised by `mean` and `std` [D] of its columns.

    `UserError` where the columns do not hold the root.
    """

    def __init__(
        self,
        layout: MotionLayout,
        columns: NDArray[np.int64],
        mean: NDArray[np.float32],
        std: NDArray[np.float32],
    ) -> None:
        self.layout, self.columns = layout, columns
        self._mean, self._std = torch.from_numpy(mean[columns]), torch.from_numpy(std[columns])
        if not self.possible(self.layout, columns):
            raise UserError(
                "places are recovered from motion features with the root; these columns have none"
            )
        self._body = self.layout.without_face()
        own = self.layout.part("bodyhand")
        known = np.isin(own, columns)
        self._into = torch.from_numpy(np.flatnonzero(known))
        self._from = torch.from_numpy(np.flatnonzero(np.isin(columns, own)))

    @staticmethod
    def possible(layout: MotionLayout, columns: NDArray[np.int64]) -> bool:
        """Whether the columns of a layout hold the root."""
        if layout.family == "raw" or not all(layout.has(field) for field in ROOT):
            return False
        return all(np.isin(np.arange(layout.dim)[layout.slice(field)], columns).all() for field in ROOT)

    def way(self, features: Tensor, anchor: Tensor) -> tuple[Tensor, Tensor]:
        """Heading in radians [B, T], and z and x of the root in metres [B, T, 2], of normalised features
        [B, T, D]. Each row's frame `anchor` (int64 [B]) stands at the origin, facing +Z.
        """
        heading, x, z = torch_way(self._own_units(features), self._body)
        rows = torch.arange(len(features), device=features.device)
        first = heading[rows, anchor][:, None]
        place = torch.stack([z, x], dim=-1)
        return heading - first, turned_back(place - place[rows, anchor][:, None], first)

    def world(self, features: Tensor, anchor: Tensor) -> Tensor:
        """Joints [B, T, N, 3] in metres, seen as by `way`; those that the columns do not hold lie in the root
        of their frame, on the floor.
        """
        own = self._own_units(features)
        joints = torch_joints_of(own, self._body)
        heading, _, _ = torch_way(own, self._body)
        rows = torch.arange(len(features), device=features.device)
        root = joints[rows, anchor, 0][:, None, None]
        away = turned_back(
            torch.stack([joints[..., 2] - root[..., 2], joints[..., 0] - root[..., 0]], dim=-1),
            heading[rows, anchor][:, None, None],
        )
        return torch.stack([away[..., 1], joints[..., 1], away[..., 0]], dim=-1)

    def _own_units(self, features: Tensor) -> Tensor:
        """The columns of body and hands [B, T, D'], 0 where these are none."""
        own = features * self._std.to(features) + self._mean.to(features)
        full = own.new_zeros(*own.shape[:-1], self._body.dim)
        return full.index_copy(-1, self._into.to(own.device), own[..., self._from.to(own.device)])


def turned_back(place: Tensor, heading: Tensor) -> Tensor:
    """Points (z, x) [..., 2] as a figure of that heading [...] sees them."""
    cosine, sine = heading.cos(), heading.sin()
    z, x = place[..., 0], place[..., 1]
    return torch.stack([z * cosine + x * sine, x * cosine - z * sine], dim=-1)
