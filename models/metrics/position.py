"""APE and AVE: errors of positions and of their variance over time, of motions made for a caption or a song.

Average Position Error and Average Variance Error of TEMOS (Ghosh et al., Petrovich et al.), which UDE's
Tables 1 and 2 print. Motions are put on the floor, begin above the origin and face one way at first; then
joints, the root, its path on the floor and the pose, seen from the root and the heading of its frame, are
compared. Metres, and square metres for AVE.

UDE does not say which code its figures come from; TEMOS' measures are the ones of these names. Public code
(`PUBLIC_SIDES`) reads the heading from other joints than it means to, and divides positions that are metres
already by 1000 (Motion-X) or 1.5625 (HumanML3D).

Legend: T frames, N joints, the first 22 of them the body's.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

_FEET = (7, 10, 8, 11)
"""Ankles and toes."""
_SIDES = ((1, 2), (16, 17))
"""Left and right hip, left and right shoulder."""
PUBLIC_SIDES = ((3, 2), (18, 17))
"""Joints that public code reads in their place: it removes the root, and then looks hips and shoulders up by
the numbers they had with it. The heading is that of the lowest spine joint and the right hip, and so on."""
_SOFTNESS = 0.5
KINDS = ("joints", "pose", "root", "path")


class PositionErrors(NamedTuple):
    """Errors of one motion; means over joints."""

    ape: dict[str, float]
    """By `KINDS`, in m; mean over frames. Of several motions the mean over all frames counts."""
    ave: dict[str, float]
    """In m²; of several motions the mean over motions counts."""
    frames: int


def position_errors(
    made: Tensor, real: Tensor, *, sides: tuple[tuple[int, int], ...] = _SIDES
) -> PositionErrors:
    """Return the errors of a motion against the recorded one, [T >= 2, N, 3] each, metres, Y up.

    Args:
        made: The motion that is judged.
        real: The recorded one.
        sides: (left, right) joints that say where the body faces; `PUBLIC_SIDES` for public code's figures.
    """
    ape = []
    ave = []
    for one, other in zip(_views(made, sides), _views(real, sides), strict=True):
        ape.append(torch.linalg.vector_norm(one - other, dim=-1).mean().item())
        ave.append(torch.linalg.vector_norm(one.var(0) - other.var(0), dim=-1).mean().item())
    return PositionErrors(dict(zip(KINDS, ape, strict=True)), dict(zip(KINDS, ave, strict=True)), len(made))


def _views(joints: Tensor, sides: tuple[tuple[int, int], ...]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Joints [T, N, 3], the pose without the root [T, N - 1, 3], the root [T, 3] and its path [T, 2]."""
    joints = joints.double()
    height = joints[:, _FEET, 1].amin(-1)
    low = height.min()
    high = height.max()
    # A soft minimum, so that one bad frame does not decide.
    floor = low - torch.log(_SOFTNESS + torch.exp(low - high))
    across = sum(joints[:, left] - joints[:, right] for left, right in sides)
    assert isinstance(across, Tensor)
    forward = torch.stack([-across[:, 2], across[:, 0]], dim=-1)
    forward = forward / torch.linalg.vector_norm(forward, dim=-1, keepdim=True).clamp(min=1e-12)
    root = joints[:, 0]
    begin = torch.stack([root[0, 0], floor, root[0, 2]])
    placed = _turned(joints - begin, forward[:1])
    around = torch.stack([root[:, 0], floor.expand(len(root)), root[:, 2]], dim=-1)
    pose = _turned(joints - around[:, None], forward)[:, 1:]
    return placed, pose, placed[:, 0], placed[:, 0, [0, 2]]


def _turned(joints: Tensor, forward: Tensor) -> Tensor:
    """Joints [T, N, 3] seen from one who faces `forward` [T or 1, 2], (x, z) of length 1."""
    sin = forward[:, None, 0]
    cos = forward[:, None, 1]
    x, y, z = joints.unbind(-1)
    return torch.stack([cos * x - sin * z, y, sin * x + cos * z], dim=-1)
