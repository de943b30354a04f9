"""Batches of the shapes that training sees, for dry runs."""

from __future__ import annotations

import torch

from motionloom.datasets.conditions import Condition
from motionloom.pipeline.stages.trained import Example

CAPTION_TOKENS = 24
"""Of a usual caption."""


def text_example(batch: int, width: int) -> Condition:
    """Captions of usual length."""
    features = torch.empty(batch, CAPTION_TOKENS, width)
    mask = torch.ones(batch, CAPTION_TOKENS, dtype=torch.bool)
    return Condition(features, mask, torch.empty(batch, width))


def caption_example(batch: int, frames: int, dim: int, width: int) -> Example:
    """Clips of `frames` frames and `dim` columns with captions of `width` features."""
    return Example(
        {
            "motion": torch.empty(batch, frames, dim),
            "length": torch.full((batch,), frames),
            "conditions": {"text": text_example(batch, width)},
            "similarity": torch.empty(batch, width),
        }
    )
