"""What a generator is asked whose motion is watched while it is made: tokens, group after group."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor

from motionloom.datasets.conditions import Conditions
from motionloom.datasets.schema import Config
from motionloom.pipeline.contract.generation import MotionGenerator
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.store.networks import TrainedTokenizer


class StreamConfig(Config):
    """How far a stream looks back and how much it makes at a time; all of it [ours]."""

    chunk_frames: int = Field(8, ge=1)
    """Frames that come together at least; more cost less in all, fewer come sooner."""
    context_frames: int = Field(40, ge=0)
    """Frames that a GPT goes on from where its block is full or another caption comes. UDE's own is its
    stage's `context_frames`."""
    hop_frames: int = Field(20, ge=1)
    """Frames that UDE draws at a time: another caption is heard after them."""
    decoder: Literal["diffusion", "tokenizer"] | None = None
    """What makes frames of a UDE's tokens: the diffusion decoder, which is better and needs the tokens of a
    window before its first frame, or the tokenizer's own, which needs some groups. None takes the first
    where the model has it."""
    ahead_seconds: float = Field(0.5, ge=0)
    """How far a stream whose captions come from a keyboard runs ahead of the clock."""


class TokenFlow(Protocol):
    """Tokens of one motion without an end, under conditions that may change."""

    def condition(self, conditions: Conditions) -> None:
        """Conditions, one row, of all that is drawn from now on; timed ones begin with the next group."""
        ...

    def draw(self, left: int | None) -> Mapping[str, Tensor]:
        """Some groups, one or more and at most `left` (None = there will be another condition, some day).

        Per stream int64 [1, G * per_group].
        """
        ...


class FrameFlow(Protocol):
    """Frames of tokens as they come."""

    def push(self, codes: Mapping[str, Tensor]) -> NDArray[np.float32] | None:
        """More tokens -> the features [T, C] that are final now, in their own units; None = none yet."""
        ...

    def finish(self) -> NDArray[np.float32] | None:
        """No more tokens follow: the rest."""
        ...


@runtime_checkable
class StreamingGenerator(MotionGenerator, Protocol):
    """A generator of tokens that can be decoded as they come."""

    @property
    def tokenizer(self) -> TrainedTokenizer:
        """What decodes them."""
        ...

    def flow(self, seed: int, sampling: SamplingConfig, streaming: StreamConfig) -> TokenFlow:
        """The tokens of a new motion. Of one caption they are those of `generate` by the same seed, as long
        as the network's block holds them.
        """
        ...

    def decoding(self, seed: int, sampling: SamplingConfig, streaming: StreamConfig) -> FrameFlow:
        """What makes frames of them."""
        ...
