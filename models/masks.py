"""Which values of a batch count in a loss: real frames, and columns that the clip holds."""

from __future__ import annotations

from torch import Tensor


def held_values(frames: Tensor, held: Tensor | None) -> Tensor:
    """Frames bool [B, T] and columns `held` bool [B, D] -> bool [B, T, D]; the frames alone when None."""
    return frames if held is None else frames[:, :, None] & held[:, None]
