"""What a generator of motion is asked, and what it answers.

A generator makes one group of columns of a layout (`part`): body and hands, the face, or all. It says which
modalities it can be conditioned on and which sampling settings it takes notice of.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.datasets.conditions import Condition, Conditions
from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.store.text import TextSource

if TYPE_CHECKING:
    from motionloom.datasets.audio.sound import Sound


@dataclass(frozen=True)
class Prompt:
    """What one motion is conditioned on, as a person gives it and a viewer shows it."""

    text: str = ""
    """What the person does; empty without words."""
    face_text: str = ""
    """What the face does; empty takes `text`."""
    sound: Sound | None = None
    """The music."""
    music: NDArray[np.float32] | None = None
    """Its features, a row for each frame, where they are known already; None = made of the sound."""

    @property
    def modalities(self) -> frozenset[str]:
        """The modalities given."""
        given = {"text": bool(self.text.strip()), "audio": self.sound is not None}
        return frozenset(name for name, there in given.items() if there)

    @property
    def words(self) -> str:
        """The words about the face, or else about the body."""
        return self.face_text or self.text


@dataclass(frozen=True)
class GenerationRequest:
    """What a generator is asked for: one motion for each row of the conditions."""

    conditions: Conditions
    """Encoded and on the generator's device; rows that lack a modality have no true position in its mask."""
    frames: Sequence[int] | None
    """Length of each motion, or None where the model decides."""
    seeds: Sequence[int]
    """One for each motion, so that how they are batched plays no part."""
    sampling: SamplingConfig = field(default_factory=SamplingConfig)

    def text(self, who: str) -> Condition:
        """The encoded texts; `who` is conditioned on them, for the message where there are none."""
        text = self.conditions.get("text")
        if text is None:
            raise UserError(f"{who} is conditioned on text, and none was given")
        return text

    def pooled_text(self, who: str) -> torch.Tensor:
        """The sentence embeddings [B, E]."""
        pooled = self.text(who).pooled
        if pooled is None:
            raise UserError(f"{who} is conditioned on sentence embeddings, and none were given")
        return pooled


@dataclass(frozen=True)
class Stretch:
    """One stretch of a motion's time line: what it is conditioned on, and how long it is."""

    conditions: Conditions
    """As of a request; timed modalities begin with the stretch."""
    frames: Sequence[int] | None
    """Length of each row, or None where the model decides (only where it is the one stretch)."""


class MotionGenerator(Protocol):
    """A trained stage that makes motion."""

    @property
    def layout(self) -> MotionLayout:
        """The layout of whole frames."""
        ...

    @property
    def part(self) -> Part:
        """The columns of the layout that it makes."""
        ...

    @property
    def method(self) -> str:
        """A short name that tells generators of one part apart, such as "gpt" or "diffusion"."""
        ...

    @property
    def modalities(self) -> frozenset[str]:
        """The modalities it can be conditioned on."""
        ...

    @property
    def text(self) -> TextSource | None:
        """What encodes its words; None where it takes none."""
        ...

    @property
    def settings(self) -> frozenset[str]:
        """The fields of `SamplingConfig` that it takes notice of."""
        ...

    @property
    def unit_frames(self) -> int:
        """Lengths are multiples of this."""
        ...

    @property
    def max_frames(self) -> int | None:
        """Longest motion; None without a limit."""
        ...

    def generate(self, request: GenerationRequest) -> list[NDArray[np.float32]]:
        """Features of the part in their own units, [T, C] each, in the order of the rows."""
        ...


@runtime_checkable
class DrivenGenerator(MotionGenerator, Protocol):
    """A generator whose conditions may change on the way: one motion, conditioned stretch by stretch."""

    def drive(
        self, stretches: Sequence[Stretch], seeds: Sequence[int], sampling: SamplingConfig
    ) -> list[NDArray[np.float32]]:
        """As `generate`, of several stretches one after another; [T, C] each."""
        ...
