"""The observed columns of the in-betweener: known features of some frames, and known places of the root.

Features hold the root's steps, not its place, so the place of frames after a gap would be unknown. Known
places are therefore columns of their own, relative to the first known one.

Training observes each motion in one of the ways in which an edit will: its begin and end, single frames,
parts of the figure, the root's path, several at once, or nothing.

Legend: B batch, T frames, D features, P pieces of the figure (`figure_parts.py`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from motionloom.datasets.motion.figure_parts import LOWER, PIECES, piece_columns, step_columns
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.diffusion.recovery import Recovery

PLACE_COLUMNS = 6
"""z, x, cosine and sine of the heading, whether the place is known, and whether the heading is."""


def observed_width(motion_dim: int) -> int:
    """Return the number of observed columns of D features."""
    return 2 * motion_dim + PLACE_COLUMNS


@dataclass(frozen=True)
class Places:
    """The root's place and heading where they are known, relative to each row's `anchor` frame."""

    anchor: Tensor
    """int64 [B]."""
    heading: Tensor
    """Radians [B, T]."""
    place: Tensor
    """z and x in metres [B, T, 2]."""
    heading_known: Tensor
    """bool [B, T]."""
    place_known: Tensor
    """bool [B, T]."""

    def columns(self) -> Tensor:
        """[B, T, 6], zero where nothing is known."""
        turned, stood = self.heading_known[..., None], self.place_known[..., None]
        facing = torch.stack([self.heading.cos(), self.heading.sin()], dim=-1)
        return torch.cat([self.place * stood, facing * turned, stood, turned], dim=-1)


def observed_columns(motion: Tensor, known: Tensor, places: Places | None) -> Tensor:
    """Return the observed columns [B, T, 2 D + 6] of normalised motion [B, T, D], `known` bool [B, T, D]."""
    features = torch.cat([motion * known, known.to(motion.dtype)], dim=-1)
    width = (*motion.shape[:-1], PLACE_COLUMNS)
    root = motion.new_zeros(width) if places is None else places.columns().to(motion.dtype)
    return torch.cat([features, root], dim=-1)


def known_columns(pieces: Tensor, layout: MotionLayout, columns: NDArray[np.int64]) -> Tensor:
    """Return which values are known, bool [B, T, D], given the known pieces of the figure, bool [B, T, P]."""
    of = torch.from_numpy(piece_columns(layout)[columns]).to(pieces.device)
    steps = torch.from_numpy(step_columns(layout)[columns]).to(pieces.device)
    # A step is known where both its frames are; a clip's last frame repeats the step before.
    following = torch.cat([pieces[:, 1:], pieces[:, -1:]], dim=1)
    both = pieces & following
    both = both & both[..., LOWER : LOWER + 1]
    return torch.where(steps, both[..., of], pieces[..., of])


class Observations:
    """Draws what training observes of each motion.

    Args:
        layout: The layout of whole frames; the motions have these `columns` of it.
        recovery: Recovers the root's path; None where the columns hold no root, then no places are observed.
        share: Share of the motions of which anything is observed.
    """

    def __init__(
        self, layout: MotionLayout, columns: NDArray[np.int64], recovery: Recovery | None, share: float
    ) -> None:
        self.layout, self.columns, self.recovery, self.share = layout, columns, recovery, share

    @classmethod
    def of(
        cls,
        layout: MotionLayout,
        columns: NDArray[np.int64],
        mean: NDArray[np.float32],
        std: NDArray[np.float32],
        share: float,
    ) -> Observations:
        """Return those of motion normalised by `mean` and `std`."""
        rooted = Recovery.possible(layout, columns)
        recovery = Recovery(layout, columns, mean, std) if rooted else None
        return cls(layout, columns, recovery, share)

    def __call__(self, motion: Tensor, length: Tensor) -> Tensor:
        """Return the observed columns [B, T, 2 D + 6] of motion [B, T, D] with `length` [B] real frames."""
        pieces, path = self._draw(length, motion.shape[1])
        known = known_columns(pieces, self.layout, self.columns)
        places = None
        if self.recovery is not None:
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
        count, device = len(length), length.device
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
        by_frame, by_part = chance(0.75), chance(0.4)
        pieces = (whole & by_frame[:, None])[..., None] | (some & by_part[:, None])[:, None]
        path = torch.where(chance(0.5, 1), torch.ones_like(single), single) & chance(0.25)[:, None]
        shown = inside & chance(self.share)[:, None]
        return pieces & shown[..., None], path & shown
