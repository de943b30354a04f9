"""`Basis`: the coordinates in which a tokenizer, or TMA, reads, writes and judges a frame [ours].

Normalised features let the directions of largest spread decide where the bits of a code, or the first layer
of an encoder, go. Two things that people see at once are small there:

- Where the path leads: 4 of 313 columns, whose errors add up along a clip. `root_gain` multiplies them, as
  the public HumanML3D code does (its `feat_bias` is 5).
- What a hand does: finger positions are relative to the root, so nearly all their spread is where the arm is
  and how the wrist is turned. With a `finger_gain` they are read as bones in units of the bone's length /
  gain: the knuckles from their wrist, which tell how the hand is turned, and the bones after them in the
  palm's own frame, where a fist is the same numbers wherever the hand points. Velocities are read relative
  to the parent joint's.

Both are undone on the way out: a network takes and gives the paper's features, and without gains it is the
paper's. Zero is the mean in both.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import normalize

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.features.running_sum import running_sum
from motionloom.datasets.motion.layout import BODY_JOINTS, WRISTS, MotionLayout

FINGERS = (2, 5, 3)
"""Hands, fingers of a hand, joints of a finger from the wrist outwards: the order of `smplx52`."""
INDEX = 0
MIDDLE = 1
PINKY = 2


class Basis(nn.Module):
    """Normalised features of some columns of a layout <-> a network's coordinates.

    Args:
        columns: Those of its columns that are modelled, ascending.
        finger_gain: Bone lengths per unit of a finger bone; 0 leaves the fingers as they are.
    """

    gain: Tensor
    mean: Tensor
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
        self.louder = root_gain != 1
        self.bends = finger_gain > 0
        if not self.bends:
            return
        if not layout.has("positions"):
            raise UserError(
                f"finger_gain needs joint positions, and layout {layout.name} has none; set it to 0"
            )
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
        self.register_buffer("mean", torch.zeros(len(columns)))
        self.register_buffer("std", torch.ones(len(columns)))

    @property
    def knuckles(self) -> Tensor:
        """Columns of the knuckles' positions, which tell how a hand is turned; needs a `finger_gain`."""
        return self.fingers[0].reshape(*FINGERS, 3)[:, :, 0].flatten()

    @property
    def bent(self) -> Tensor:
        """Columns of the bones after them, which tell what the hand does; needs a `finger_gain`."""
        return self.fingers[0].reshape(*FINGERS, 3)[:, :, 1:].flatten()

    @torch.no_grad()
    def learn(self, mean: NDArray[np.floating], std: NDArray[np.floating]) -> None:
        """How the features were normalised, each [D of the modelled columns]; saved with the weights."""
        if self.bends:
            self.mean.copy_(torch.as_tensor(mean, dtype=torch.float32))
            self.std.copy_(torch.as_tensor(std, dtype=torch.float32))

    def encode(self, x: Tensor) -> Tensor:
        """Features [..., D] -> coordinates [..., D]. In float32 under autocast too: it is what is learnt."""
        with torch.autocast(x.device.type, enabled=False):
            return self._enter(x)

    def decode(self, seen: Tensor) -> Tensor:
        """The inverse of `encode`; half types come out as float32, whose resolution joints need."""
        with torch.autocast(seen.device.type, enabled=False):
            return self._leave(seen.to(torch.promote_types(seen.dtype, torch.float32)))

    def _enter(self, x: Tensor) -> Tensor:
        seen = x * self.gain.to(x.dtype) if self.louder else x
        if not self.bends:
            return seen
        bones = (self._bent(x) - self._bent(torch.zeros_like(self.mean))) / self.unit
        joints, wrists = self._moving(x)
        moving = _bones(joints, wrists) / self._spread()
        for columns, values in zip(self.fingers, (bones, moving), strict=True):
            seen = seen.index_copy(-1, columns, values.flatten(-4).to(x.dtype))
        return seen

    def _leave(self, seen: Tensor) -> Tensor:
        x = seen / self.gain.to(seen.dtype) if self.louder else seen
        if not self.bends:
            return x
        joints, wrists = self._standing(x)
        at, moving = (seen[..., columns].to(joints.dtype).reshape(joints.shape) for columns in self.fingers)
        bent = at * self.unit + self._bent(torch.zeros_like(self.mean))
        knuckles = bent[..., :1, :]
        bones = torch.cat([knuckles, bent[..., 1:, :] @ _palm(knuckles)], dim=-2)
        positions = (wrists + running_sum(bones, -2)).flatten(-4) - self.mean[self.fingers[0]]
        velocities = (self._moving(x)[1] + running_sum(moving * self._spread(), -2)).flatten(-4)
        for columns, values in zip(self.fingers, (positions, velocities), strict=True):
            x = x.index_copy(-1, columns, (values / self.std[columns]).to(x.dtype))
        return x

    def _bent(self, x: Tensor) -> Tensor:
        """Bones [..., 2, 5, 3, 3] in m: knuckles from the wrist, the others in the palm's frame."""
        bones = _bones(*self._standing(x))
        knuckles = bones[..., :1, :]
        return torch.cat([knuckles, bones[..., 1:, :] @ _palm(knuckles).transpose(-1, -2)], dim=-2)

    def _standing(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Positions in m of finger joints [..., 2, 5, 3, 3] and wrists [..., 2, 1, 1, 3]."""
        x = x.to(torch.promote_types(x.dtype, torch.float32)) * self.std + self.mean
        return self._joints(x, 0)

    def _moving(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Their velocities in m per frame, less the mean."""
        return self._joints(x.to(torch.promote_types(x.dtype, torch.float32)) * self.std, 1)

    def _joints(self, x: Tensor, field: int) -> tuple[Tensor, Tensor]:
        joints = x[..., self.fingers[field]].reshape(*x.shape[:-1], *FINGERS, 3)
        return joints, x[..., self.wrists[field]].reshape(*x.shape[:-1], 2, 1, 1, 3)

    def _spread(self) -> Tensor:
        """Return the divisors of velocities, [2, 5, 3, 3]."""
        return self.std[self.fingers[1]].reshape(*FINGERS, 3)


def _bones(joints: Tensor, wrists: Tensor) -> Tensor:
    """Joints [..., 2, 5, 3, 3] from their parents, the first of a finger from the wrist [..., 2, 1, 1, 3]."""
    first = wrists.expand(*joints.shape[:-2], 1, 3)
    return joints - torch.cat([first, joints[..., :-1, :]], dim=-2)


def _palm(knuckles: Tensor) -> Tensor:
    """Axes of the palm as rows, [..., 2, 1, 3, 3], from its knuckles [..., 2, 5, 1, 3].

    Along the middle finger, across towards the index finger, and out of the hand's back or its palm.
    Knuckles do not move against each other, so three of them determine how the hand is turned.
    """
    along = normalize(knuckles[..., MIDDLE, :, :], dim=-1)
    across = knuckles[..., INDEX, :, :] - knuckles[..., PINKY, :, :]
    across = normalize(across - (across * along).sum(-1, keepdim=True) * along, dim=-1)
    return torch.stack([along, across, torch.linalg.cross(along, across)], dim=-2)


def _columns(layout: MotionLayout, field: str, joints: range | tuple[int, ...]) -> NDArray[np.int64]:
    """Columns of some joints in a field of three values a joint."""
    first = layout.slice(field).start - (3 if field == "positions" else 0)  # the root has no position
    return np.concatenate([np.arange(first + 3 * joint, first + 3 * joint + 3) for joint in joints])
