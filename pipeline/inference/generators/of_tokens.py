"""Base of models over one tokenizer's tokens."""

from __future__ import annotations

from abc import ABC, abstractmethod

from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.models.tokenizer.streaming import StreamDecoder
from motionloom.pipeline.contract.generation import Decoding
from motionloom.pipeline.contract.sampling import StreamConfig
from motionloom.pipeline.store.networks import TrainedTokenizer


class OfTokens(ABC):
    """A model of one tokenizer's tokens."""

    decides_length = True

    @property
    @abstractmethod
    def tokenizer(self) -> TrainedTokenizer:
        """The tokenizer of its tokens."""

    @property
    def layout(self) -> MotionLayout:
        return self.tokenizer.layout

    @property
    def part(self) -> Part:
        return self.tokenizer.net.part

    @property
    def group_tokens(self) -> dict[str, int]:
        return {stream.name: stream.per_group for stream in self.tokenizer.net.streams}

    def token_frames(self, streaming: StreamConfig) -> Decoding:
        """The tokenizer's decoder for a stream (`Streaming.frames`)."""
        least = -(-streaming.chunk_frames // self.tokenizer.net.group_frames)
        return StreamDecoder(self.tokenizer.net, least), lambda made: self.tokenizer.own_units(made[0])

    @property
    def unit_frames(self) -> int:
        return self.tokenizer.net.group_frames
