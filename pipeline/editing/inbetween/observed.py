"""The observed columns of the in-betweener: known features of some frames, and known places of the root.

Features hold the root's steps, not its place, so the place of frames after a gap would be unknown. Known
places are therefore columns of their own, relative to the first known one.

Training observes each motion in one of the ways in which an edit will: its begin and end, single frames,
parts of the figure, the root's path, several at once, or nothing.

Legend: B batch, T frames, D features (the columns of a part), N joints, P pieces of the figure.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.features.torch_joints import torch_way
from motionloom.datasets.motion.layout import LOWER, PIECES, ROOT, MotionLayout, piece_columns, step_columns

PLACE_COLUMNS = 6
"""z, x, cosine and sine of the heading, whether the place is known, and whether the heading is."""


def observed_width(motion_dim: int) -> int:
    """Return the number of observed columns of D features."""
    return 2 * motion_dim + PLACE_COLUMNS


class Recovery:
    """Recovers the root's way from the `columns` of a layout, of which its own are the first; `mean` and
    `std` [D] of the layout's columns normalise them.
    """

    def __init__(
        self,
        layout: MotionLayout,
        columns: NDArray[np.int64],
        mean: NDArray[np.float32],
        std: NDArray[np.float32],
    ) -> None:
        root = [column for field in ROOT if layout.has(field) for column in np.r_[layout.slice(field)]]
        if layout.family == "raw" or not root or not np.isin(root, columns).all():
            raise UserError(f"layout {layout.name}: an in-betweener is of columns that hold the root's way")
        self.layout = layout
        legs = piece_columns(layout) == LOWER
        if layout.has("root_height"):
            legs[layout.slice("root_height")] = False
        self.steps = step_columns(layout)[columns]
        """Which columns are steps to the next frame, bool [D]."""
        self.legs = torch.from_numpy(legs[columns])
        """Which columns pose the legs or lead the root along the floor, bool [D]."""
        self.mean = torch.from_numpy(mean[columns])
        self.std = torch.from_numpy(std[columns])

    def way(self, features: Tensor, anchor: Tensor) -> tuple[Tensor, Tensor]:
        """Heading in radians [B, T], and z and x of the root in metres [B, T, 2], of normalised features
        [B, T, D]. Each row's frame `anchor` (int64 [B]) stands at the origin, facing +Z.
        """
        own = features * self.std.to(features) + self.mean.to(features)
        heading, x, z = torch_way(own, self.layout)
        rows = torch.arange(len(features), device=features.device)
        first = heading[rows, anchor][:, None]
        place = torch.stack([z, x], dim=-1)
        return heading - first, turned_back(place - place[rows, anchor][:, None], first)


def turned_back(place: Tensor, heading: Tensor) -> Tensor:
    """Points (z, x) [..., 2] as a figure of that heading [...] sees them."""
    cosine = heading.cos()
    sine = heading.sin()
    z = place[..., 0]
    x = place[..., 1]
    return torch.stack([z * cosine + x * sine, x * cosine - z * sine], dim=-1)


class Places(NamedTuple):
    """The root's place and heading where they are known, relative to each row's `anchor` frame."""

    anchor: Tensor
    """int64 [B]."""
    heading: Tensor
    """Radians [B, T]; likely ones where they are not known."""
    place: Tensor
    """z and x in metres [B, T, 2]."""
    heading_known: Tensor
    """bool [B, T]."""
    place_known: Tensor
    """bool [B, T]."""

    def columns(self) -> Tensor:
        """[B, T, 6], zero where nothing is known."""
        turned = self.heading_known[..., None]
        stood = self.place_known[..., None]
        facing = torch.stack([self.heading.cos(), self.heading.sin()], dim=-1)
        return torch.cat([self.place * stood, facing * turned, stood, turned], dim=-1)


def observed_columns(motion: Tensor, known: Tensor, places: Places) -> Tensor:
    """Return the observed columns [B, T, 2 D + 6] of normalised motion [B, T, D], `known` bool [B, T, D]."""
    features = torch.cat([motion * known, known.to(motion.dtype)], dim=-1)
    return torch.cat([features, places.columns().to(motion.dtype)], dim=-1)


def known_columns(pieces: Tensor, layout: MotionLayout, columns: NDArray[np.int64]) -> Tensor:
    """Return which values are known, bool [B, T, D], given the known pieces of the figure, bool [B, T, P]."""
    return _of_pieces(pieces, *_piece_and_step(layout, columns))


def _piece_and_step(layout: MotionLayout, columns: NDArray[np.int64]) -> tuple[Tensor, Tensor]:
    """Each column's piece, int64 [D], and whether it is a step to the next frame, bool [D]."""
    return torch.from_numpy(piece_columns(layout)[columns]), torch.from_numpy(step_columns(layout)[columns])


def _of_pieces(pieces: Tensor, of: Tensor, steps: Tensor) -> Tensor:
    of = of.to(pieces.device)
    steps = steps.to(pieces.device)
    # A step is known where both its frames are; a clip's last frame repeats the step before.
    following = torch.cat([pieces[:, 1:], pieces[:, -1:]], dim=1)
    both = pieces & following
    both = both & both[..., LOWER : LOWER + 1]
    return torch.where(steps, both[..., of], pieces[..., of])


class Observations:
    """Draws what training observes of each motion.

    Args:
        layout: The layout of whole frames; the motions have these `columns` of it.
        mean, std: Statistics of the layout's columns, by which the motions are normalised.
        share: Share of the motions of which anything is observed.
    """

    def __init__(
        self,
        layout: MotionLayout,
        columns: NDArray[np.int64],
        mean: NDArray[np.float32],
        std: NDArray[np.float32],
        share: float,
    ) -> None:
        self.recovery = Recovery(layout, columns, mean, std)
        self.share = share
        # Found here, since torch.compile does not enter the locks of Python 3.11's cached properties.
        self._columns = _piece_and_step(layout, columns)

    def __call__(self, motion: Tensor, length: Tensor) -> Tensor:
        """Return the observed columns [B, T, 2 D + 6] of motion [B, T, D] with `length` [B] real frames."""
        pieces, path = self._draw(length, motion.shape[1])
        known = _of_pieces(pieces, *self._columns)
        rooted = pieces[..., LOWER]
        first = torch.where(rooted.any(1), rooted.byte().argmax(1), path.byte().argmax(1))
        heading, place = self.recovery.way(motion, first)
        turned = rooted.clone()
        rows = torch.arange(len(motion), device=motion.device)
        turned[rows, first] |= path.any(1)
        places = Places(first, heading, place, turned, rooted | path)
        return observed_columns(motion, known, places)

    def _draw(self, length: Tensor, frames: int) -> tuple[Tensor, Tensor]:
        """Known pieces bool [B, T, P], and frames whose place is known beside them bool [B, T]."""
        count = len(length)
        device = length.device
        at = torch.arange(frames, device=device)
        inside = at < length[:, None]

        def chance(share: float, *more: int) -> Tensor:
            drawn: Tensor = torch.rand(count, *more, device=device) < share
            return drawn

        # Begin and end: a gap of 10 to 90 percent, in a quarter of the motions up to one end.
        gap = (length * (0.1 + 0.8 * torch.rand(count, device=device))).long().clamp(min=1)
        start = (torch.rand(count, device=device) * (length - gap + 1)).long()
        start = torch.where(chance(0.125), 0, torch.where(chance(0.15), length - gap, start))
        ends = (at < start[:, None]) | (at >= (start + gap)[:, None])
        # Single frames, from one in three to one in forty.
        rare = 10 ** -(0.5 + 1.1 * torch.rand(count, 1, device=device))
        single = torch.rand(count, frames, device=device) < rare
        whole = torch.where(chance(0.75, 1), ends, single)
        # Parts of the figure in all frames or in those of the gap.
        some = torch.rand(count, len(PIECES), device=device) < torch.rand(count, 1, device=device)
        by_frame = chance(0.75)
        by_part = chance(0.4)
        pieces = (whole & by_frame[:, None])[..., None] | (some & by_part[:, None])[:, None]
        path = torch.where(chance(0.5, 1), torch.ones_like(single), single) & chance(0.25)[:, None]
        shown = inside & chance(self.share)[:, None]
        return pieces & shown[..., None], path & shown
