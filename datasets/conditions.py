"""The conditions of a motion: one `Condition` a modality, in one mapping from shards to networks.

A row of a batch that lacks a modality has no true position in that modality's mask, so clips with text, with
music, with both and with neither share one batch. `datasets/modalities/` says what there is.

Legend: B batch, L positions, E features.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from torch import Tensor


class Condition(NamedTuple):
    """One modality of a batch."""

    features: Tensor
    """float32 [B, L, E]: word features of a text, frames of a sound; zero where `mask` is false."""
    mask: Tensor
    """bool [B, L]."""
    pooled: Tensor | None = None
    """float32 [B, E]: the whole in one vector (a sentence embedding), where the modality has one."""

    @property
    def present(self) -> Tensor:
        """bool [B]: rows that have this modality."""
        return self.mask.any(1)


Conditions = Mapping[str, Condition]
"""Modality -> its part of the batch. All share B."""
