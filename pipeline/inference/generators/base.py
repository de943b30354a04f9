"""Bases of generators: of whole motions from text, over one tokenizer's tokens, and of dances."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.modalities.table import MODALITIES
from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.models.gpt.tokens import Codes
from motionloom.pipeline.contract.generation import Capabilities, GenerationRequest
from motionloom.pipeline.store.networks import TrainedTokenizer


class StageGenerator(ABC):
    """A generator that reads the loaded inputs of its stage."""

    given: Mapping[str, Any]

    @property
    def modalities(self) -> frozenset[str]:
        return frozenset({"text"})

    @property
    def prepared(self) -> Mapping[str, object]:
        return {name: self.given.get(name) for name in self.modalities}

    @property
    def max_frames(self) -> int | None:
        return None

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities()


@dataclass(frozen=True)
class WholeMotion(StageGenerator):
    """A generator of one part of a layout from text; a kind of it adds its network and says `normalised`."""

    layout: MotionLayout
    part: Part
    given: Mapping[str, Any]
    """The stage's loaded inputs: "stats", "text"."""

    who: ClassVar[str]
    """For messages, such as "this VAE"."""
    method: ClassVar[str]
    settings: ClassVar[frozenset[str]] = frozenset()
    unit_frames = 1
    decides_length = False

    @abstractmethod
    def normalised(
        self, request: GenerationRequest, frames: Sequence[int]
    ) -> Sequence[NDArray[np.float32] | Tensor]:
        """One motion [T, C] of the part's columns for each row, T of `frames`, as the network was trained."""

    @torch.no_grad()
    def generate(self, request: GenerationRequest) -> list[NDArray[np.float32]]:
        columns = self.layout.part(self.part)
        stats = self.given["stats"]
        made = (
            torch.as_tensor(one).cpu().numpy() for one in self.normalised(request, request.lengths(self.who))
        )
        return [np.asarray(stats.denormalize(one, columns), dtype=np.float32) for one in made]


class OfTokens(StageGenerator):
    """A model of the tokens of the stage's "tokenizer"."""

    decides_length = True

    @property
    def tokenizer(self) -> TrainedTokenizer:
        """The tokenizer of its tokens."""
        tokenizer: TrainedTokenizer = self.given["tokenizer"]
        return tokenizer

    @property
    def layout(self) -> MotionLayout:
        return self.tokenizer.layout

    @property
    def part(self) -> Part:
        return self.tokenizer.net.part

    @property
    def unit_frames(self) -> int:
        return self.tokenizer.net.group_frames

    def whole_groups(self, frames: Sequence[int] | None) -> Tensor | None:
        """Return the groups [B] that hold so many frames; None where the model decides."""
        unit = self.unit_frames
        return None if frames is None else torch.tensor([-(-count // unit) for count in frames])

    def decoded(self, codes: Codes, frames: Sequence[int] | None) -> list[NDArray[np.float32]]:
        """Return features [T, C] in their own units by the tokenizer's decoder, cut to `frames`."""
        motions = self.tokenizer.decode(codes.codes, codes.groups.tolist())
        if frames is None:
            return motions
        return [motion[:count] for motion, count in zip(motions, frames, strict=True)]


@dataclass(frozen=True)
class DanceGenerator(StageGenerator):
    """Makes one dance for each music and draws nothing: what it begins with makes the difference."""

    layout: MotionLayout
    given: Mapping[str, Any]
    """The stage's loaded inputs; "audio" is read."""
    modalities = frozenset({"audio"})
    settings = frozenset[str]()
    decides_length = False

    def music(self, request: GenerationRequest) -> Tensor:
        """The normalised music [B, L, E] of a request; 0 after each row's end."""
        found = request.conditions.get("audio")
        if found is None:
            raise UserError("this model dances to music, and none was given")
        return MODALITIES["audio"].normalise(self.given["audio"], found).features
