"""`FeatureStats`: mean and standard deviation of the columns of a layout, as models normalise by them.

`statistics.py` computes them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from motionloom.datasets.modalities.modality import load_columns, save_columns
from motionloom.datasets.motion.layout import Family, MotionLayout, require_layout
from motionloom.datasets.schema import UserError

Values = TypeVar("Values", NDArray[np.float32], Tensor)
Columns = NDArray[np.int64] | slice
"""Columns of a layout: by number, or a field's slice."""


@dataclass(frozen=True)
class FeatureStats:
    """Mean and std, [D] float32, of the columns of a layout."""

    mean: NDArray[np.float32]
    std: NDArray[np.float32]
    layout: MotionLayout
    frames: int = 0
    """Frames they were computed from."""
    _tensors: dict[tuple[torch.device, torch.dtype], tuple[Tensor, Tensor]] = field(
        default_factory=dict, repr=False, compare=False
    )

    def normalize(self, values: Values, columns: Columns | None = None) -> Values:
        """(values - mean) / std over the last axis; numpy or torch. `columns`: which ones `values` holds."""
        if isinstance(values, Tensor):
            mean, std = self._on(values, columns)
            return (values - mean) / std
        return (values - self._take(self.mean, columns)) / self._take(self.std, columns)

    def denormalize(self, values: Values, columns: Columns | None = None) -> Values:
        """values * std + mean over the last axis; numpy or torch, differentiable."""
        if isinstance(values, Tensor):
            mean, std = self._on(values, columns)
            return values * std + mean
        return values * self._take(self.std, columns) + self._take(self.mean, columns)

    def save(self, path: Path) -> None:
        """Write a safetensors file, with the layout in its metadata, atomically."""
        layout = self.layout
        facts = {"layout": layout.name, "family": layout.family, "fps": repr(layout.fps)}
        save_columns(path, self.mean, self.std, self.frames, **facts)

    @staticmethod
    def load(path: Path, *, expect: MotionLayout | None = None) -> FeatureStats:
        """Read what `save` wrote; `UserError` when it is not that or not of the expected layout."""
        stage = "the statistics stage"
        mean, std, frames, about = load_columns(path, stage)
        try:
            family = cast(Family, about["family"])  # a wrong one fits no data set
            layout = MotionLayout.named(about["layout"], fps=float(about["fps"]), family=family)
        except (KeyError, ValueError) as error:
            raise UserError(f"{path}: not a statistics file ({error}); run {stage} again") from None
        if len(mean) != layout.dim:
            raise UserError(f"{path}: {len(mean)} columns, not {layout.dim}; run {stage} again")
        if expect is not None:
            require_layout(layout, expect, str(path))
        return FeatureStats(mean, std, layout, frames)

    def _on(self, like: Tensor, columns: Columns | None) -> tuple[Tensor, Tensor]:
        key = (like.device, like.dtype)
        if key not in self._tensors:
            self._tensors[key] = (torch.from_numpy(self.mean).to(like), torch.from_numpy(self.std).to(like))
        mean, std = self._tensors[key]
        if columns is None:
            return mean, std
        chosen = columns if isinstance(columns, slice) else torch.as_tensor(columns, device=like.device)
        return mean[chosen], std[chosen]

    @staticmethod
    def _take(values: NDArray[np.float32], columns: Columns | None) -> NDArray[np.float32]:
        return values if columns is None else values[columns]

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_tensors": {}}
