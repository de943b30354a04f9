"""Base of generators that make all frames of a motion of given length at once."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.pipeline.contract.generation import Capabilities, GenerationRequest


@dataclass(frozen=True)
class WholeMotion(ABC):
    """A generator of one part of a layout from text; a kind of it adds its network and says `normalised`."""

    layout: MotionLayout
    part: Part
    given: Mapping[str, Any]
    """The stage's loaded inputs: "stats", "text"."""

    who: ClassVar[str]
    """For messages, such as "this VAE"."""
    method: ClassVar[str]
    settings: ClassVar[frozenset[str]] = frozenset()
    modalities = frozenset({"text"})
    unit_frames = 1
    decides_length = False

    @property
    def max_frames(self) -> int | None:
        return None

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities()

    @property
    def prepared(self) -> Mapping[str, object]:
        return {"text": self.given.get("text")}

    @abstractmethod
    def normalised(
        self, request: GenerationRequest, frames: Sequence[int]
    ) -> Sequence[NDArray[np.float32] | torch.Tensor]:
        """One motion [T, C] of the part's columns for each row, T of `frames`, as the network was trained."""

    @torch.no_grad()
    def generate(self, request: GenerationRequest) -> list[NDArray[np.float32]]:
        columns, stats = self.layout.part(self.part), self.given["stats"]
        made = (
            torch.as_tensor(one).cpu().numpy() for one in self.normalised(request, request.lengths(self.who))
        )
        return [np.asarray(stats.denormalize(one, columns), dtype=np.float32) for one in made]
