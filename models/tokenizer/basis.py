"""`Basis`: the coordinates in which a tokenizer reads, writes and judges a frame [ours].

Normalised features let the directions of largest spread decide where the bits of a code go. Two things that
people see at once are small there:

- Where the path leads: 4 of 313 columns, whose errors add up along a clip. `root_gain` multiplies them, as
  the public HumanML3D code does (its `feat_bias` is 5).
- What a hand does: finger positions are relative to the root, so nearly all their spread is the arm's. With a
  `finger_gain` they are read as bones, each from its parent joint, in units of the bone's length / gain, and
  their velocities likewise relative to the parent's.

Both are linear and are undone on the way out: a tokenizer takes and gives the paper's features, and without
gains it is the paper's.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from motionloom.datasets.motion.layout import BODY_JOINTS, WRISTS, MotionLayout
from motionloom.datasets.schema import UserError

FINGERS = (2, 5, 3)
"""Hands, fingers of a hand, joints of a finger from the wrist outwards: the order of `smplx52`."""


class Basis(nn.Module):
    """Normalised features of some columns of a layout <-> the tokenizer's coordinates.

    Args:
        layout: Layout of the full frames.
        columns: Those of its columns that are modelled, ascending.
        root_gain: Factor of the root's columns.
        finger_gain: Bone lengths per unit of a finger bone; 0 leaves the fingers as they are.
    """

    gain: Tensor
    std: Tensor
    fingers: Tensor
    wrists: Tensor
    unit: Tensor

    def __init__(
        self, layout: MotionLayout, columns: NDArray[np.int64], *, root_gain: float, finger_gain: float
    ) -> None:
        super().__init__()
        root = np.arange(layout.slice("positions").start) if layout.has("positions") else columns[:0]
        gain = np.where(np.isin(columns, root), root_gain, 1.0)
        self.register_buffer("gain", torch.as_tensor(gain, dtype=torch.float32), persistent=False)
        self.louder, self.bends = root_gain != 1, finger_gain > 0
        if not self.bends:
            return
        fingers = [_columns(layout, field, range(BODY_JOINTS, 52)) for field in ("positions", "velocities")]
        wrists = [_columns(layout, field, WRISTS) for field in ("positions", "velocities")]
        needed = np.concatenate([*fingers, *wrists])
        if len(layout.skeleton) < 52 or not np.isin(needed, columns).all():
            raise UserError(f"finger_gain needs body and hands together (layout {layout.name}); set it to 0")
        lengths = np.linalg.norm(layout.skeleton.offsets[BODY_JOINTS:], axis=1)
        unit = np.repeat(lengths / finger_gain, 3).reshape(*FINGERS, 3)
        for name, value in (("fingers", fingers), ("wrists", wrists)):
            where = np.searchsorted(columns, np.stack(value))
            self.register_buffer(name, torch.as_tensor(where), persistent=False)
        self.register_buffer("unit", torch.as_tensor(unit, dtype=torch.float32), persistent=False)
        self.register_buffer("std", torch.ones(len(columns)))

    @torch.no_grad()
    def learn(self, std: NDArray[np.floating]) -> None:
        """What the features were divided by, [D of the modelled columns]; saved with the weights."""
        if self.bends:
            self.std.copy_(torch.as_tensor(std, dtype=torch.float32))

    def enter(self, x: Tensor) -> Tensor:
        """Features [..., D] -> coordinates [..., D]."""
        seen = x * self.gain.to(x.dtype) if self.louder else x
        if not self.bends:
            return seen
        for field in range(2):
            joints, base, unit = self._chains(x, field)
            bones = joints - torch.cat([base, joints[..., :-1, :]], dim=-2)
            seen = seen.index_copy(-1, self.fingers[field], (bones / unit).flatten(-4).to(x.dtype))
        return seen

    def leave(self, seen: Tensor) -> Tensor:
        """The inverse of `enter`."""
        x = seen / self.gain.to(seen.dtype) if self.louder else seen
        if not self.bends:
            return x
        for field in range(2):
            bones, base, unit = self._chains(x, field)
            bones = seen[..., self.fingers[field]].to(bones.dtype).reshape(bones.shape) * unit
            joints = (base + bones.cumsum(-2)).flatten(-4) / self.std[self.fingers[field]]
            x = x.index_copy(-1, self.fingers[field], joints.to(x.dtype))
        return x

    def _chains(self, x: Tensor, field: int) -> tuple[Tensor, Tensor, Tensor]:
        """Of positions (0) or velocities (1), m: joints [..., 2, 5, 3, 3], wrists [..., 2, 5, 1, 3], unit."""
        fingers, wrists = self.fingers[field], self.wrists[field]
        wide = x.to(torch.promote_types(x.dtype, torch.float32))
        spread = self.std[fingers].reshape(*FINGERS, 3)
        joints = wide[..., fingers].reshape(*x.shape[:-1], *FINGERS, 3) * spread
        base = (wide[..., wrists] * self.std[wrists]).reshape(*x.shape[:-1], 2, 1, 1, 3)
        return joints, base.expand(*x.shape[:-1], 2, 5, 1, 3), self.unit if field == 0 else spread


def _columns(layout: MotionLayout, field: str, joints: range | tuple[int, ...]) -> NDArray[np.int64]:
    """Columns of some joints in a field of three values a joint."""
    first = layout.slice(field).start - (3 if field == "positions" else 0)  # the root has no position
    return np.concatenate([np.arange(first + 3 * joint, first + 3 * joint + 3) for joint in joints])
