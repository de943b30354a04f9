"""The interface of a motion generator.

A generator makes one group of columns of a layout (`part`): body and hands, the face, or all. It declares its
modalities and the sampling settings that it uses.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.conditions import Condition, Conditions
from motionloom.datasets.modalities.table import MODALITIES
from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.models.diffusion.schedule import Sampler
from motionloom.pipeline.contract.sampling import SamplingConfig

if TYPE_CHECKING:
    from motionloom.datasets.audio.sound import Sound

Motion = NDArray[np.float32]
"""Features [T, C] of the generator's part, in their own units."""


_JUDGED = 3.0
"""Shortest sound, in seconds, whose beats are judged: a few beats of the slowest music."""


@dataclass(frozen=True)
class Prompt:
    """The conditions of one motion as a user gives them, before encoding."""

    text: str = ""
    """Caption of the motion; may be empty."""
    face_text: str = ""
    """Caption of the face; empty: that of the motion."""
    sound: Sound | None = None
    """The music."""
    conditions: Mapping[str, object] = field(default_factory=dict)
    """Further conditions by modality; under "audio" the features [T, 438], where they are known."""

    @property
    def given(self) -> dict[str, object]:
        text = self.text if self.text.strip() else None
        # Words are not spoilt by silence; without any, the silence says how long to stand.
        sound = None if text is not None and self.silent else self.sound
        own = {"text": text, "audio": sound}
        pairs = [*own.items(), *self.conditions.items()]
        return {name: value for name, value in pairs if value is not None}

    @property
    def modalities(self) -> frozenset[str]:
        return frozenset(self.given)

    @property
    def seconds(self) -> float | None:
        """Length of its timed conditions, such as music; None without any."""
        found = [MODALITIES[name].seconds(value) for name, value in self.given.items() if name in MODALITIES]
        return min((length for length in found if length is not None), default=None)

    @property
    def silent(self) -> bool:
        """Whether its sound is silent."""
        return self.sound is not None and self.sound.silent

    @property
    def idle(self) -> bool:
        """Whether silence is its only condition: the figure stands."""
        return self.modalities == {"audio"} and not self.conditions and self.silent

    @property
    def remark(self) -> str:
        """One sentence on a sound that is silent, or has hardly a beat; else empty."""
        if self.silent:
            return f"nothing is heard: {'the figure stands' if self.idle else 'its words drive the motion'}"
        if self.sound is None or self.sound.seconds < _JUDGED:
            return ""
        from motionloom.datasets.audio.given_beats import in_words
        from motionloom.datasets.audio.tracker import NO_BEAT, UNSURE, track

        beats = track(self.sound.piece or self.sound)
        if beats.pulse < NO_BEAT:
            return "hardly a beat is heard in the sound"
        return f"the beat may be wrong: {in_words(self.sound)}; --beats says it" * (beats.confidence < UNSURE)

    @property
    def words(self) -> str:
        """The caption of the face, or else that of the motion."""
        return self.face_text or self.text


@dataclass(frozen=True)
class GenerationRequest:
    """A request to a generator: one motion for each row of the conditions."""

    conditions: Conditions
    """Encoded and on the generator's device; rows that lack a modality have no true position in its mask."""
    frames: Sequence[int] | None
    """Length of each motion, or None where the model decides."""
    seeds: Sequence[int]
    """One for each motion, so that results do not depend on batching."""
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    noise_seeds: Sequence[int] | None = None
    """Seeds of a diffusion decoder's noise; None takes `seeds`. Other generators ignore them."""
    seed_motions: Sequence[Motion] | None = None
    """Motions that a generator with `seed_frames` continues, of that length: its columns [T0, C] in their own
    units; None takes motions of its own. Other generators ignore them."""

    def text(self, who: str) -> Condition:
        """Return the encoded texts; a `UserError` without any names the generator `who`."""
        text = self.conditions.get("text")
        if text is None:
            raise UserError(f"{who} is conditioned on text, and none was given")
        return text

    def lengths(self, who: str) -> Sequence[int]:
        """Return the frames of each motion; a `UserError` without any names the generator `who`."""
        if self.frames is None:
            raise UserError(
                f"{who} needs an explicit length: give --seconds, in a recipe seconds, or to evaluate it "
                f"lengths: recorded"
            )
        return self.frames

    def pooled_text(self, who: str) -> torch.Tensor:
        """The sentence embeddings [B, E]."""
        pooled = self.text(who).pooled
        if pooled is None:
            raise UserError(f"{who} is conditioned on sentence embeddings, and none were given")
        return pooled


@dataclass(frozen=True)
class Stretch:
    """One stretch of a motion's time line: its conditions and length."""

    conditions: Conditions
    """As of a request; timed modalities begin with the stretch."""
    frames: Sequence[int] | None
    """Length of each row, or None where the model decides (only where it is the one stretch)."""


@dataclass(frozen=True)
class Capabilities:
    """A generator's abilities besides `generate`; the default of each field says that it cannot."""

    drive: Callable[[Sequence[Stretch], Sequence[int], SamplingConfig], list[Motion]] | None = None
    """Generates stretches that follow each other, with a seed for each motion; [T, C] each."""
    denoising: Callable[[SamplingConfig], tuple[Sampler, int]] | None = None
    """Returns sampler and number of steps of its diffusion model under these settings."""
    seed_frames: int = 0
    """Frames of the seed motion that it continues; its output begins with them."""
    note: str = ""
    """A remark that must stand beside its figures."""
    more: Mapping[str, Callable[..., Any]] = field(default_factory=dict)
    """What packages add to generators, by the name of their `Ability`."""


class MotionGenerator(Protocol):
    """A trained stage that makes motion."""

    @property
    def layout(self) -> MotionLayout:
        """The layout of whole frames."""

    @property
    def part(self) -> Part:
        """The part of the layout that it makes."""

    @property
    def method(self) -> str:
        """A short name that tells generators of one part apart, such as "gpt" or "diffusion"."""

    @property
    def modalities(self) -> frozenset[str]:
        """The modalities it can be conditioned on."""

    @property
    def prepared(self) -> Mapping[str, object]:
        """Outputs of the stages that encode its modalities, by name: the text source, music statistics."""

    @property
    def settings(self) -> frozenset[str]:
        """The fields of `SamplingConfig` that it uses."""

    @property
    def unit_frames(self) -> int:
        """Frames of which every length is a multiple."""

    @property
    def max_frames(self) -> int | None:
        """Frames of the longest motion; None without a limit."""

    @property
    def decides_length(self) -> bool:
        """Whether it decides a motion's length if the request has none."""

    @property
    def capabilities(self) -> Capabilities:
        """Its abilities besides `generate`."""

    def generate(self, request: GenerationRequest) -> list[Motion]:
        """Features of the part in their own units, metres and radians, [T, C] each, in the order of the rows.

        A row depends on its own seed and conditions alone. `UserError` for a request that it cannot meet.
        """
