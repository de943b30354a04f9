"""Frames of tokens as they come, in their own units: by the tokenizer's decoder, or a diffusion decoder."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from motionloom.models.tokenizer.streaming import StreamDecoder
from motionloom.pipeline.contract.sampling import StreamConfig
from motionloom.pipeline.store.networks import TrainedTokenizer


class _Decoder(Protocol):
    def push(self, codes: Mapping[str, Tensor]) -> Tensor | None: ...
    def finish(self) -> Tensor | None: ...


class Frames:
    """A decoder and what makes metres of its numbers.

    Args:
        decoder: Tokens to frames.
        units: Its frames to features [T, C] in their own units.
    """

    def __init__(self, decoder: _Decoder, units: Callable[[Tensor], NDArray[np.float32]]) -> None:
        self._decoder, self._units = decoder, units

    @staticmethod
    def of_tokenizer(tokenizer: TrainedTokenizer, streaming: StreamConfig) -> Frames:
        least = -(-streaming.chunk_frames // tokenizer.net.group_frames)
        return Frames(StreamDecoder(tokenizer.net, least), lambda made: tokenizer.own_units(made[0]))

    def push(self, codes: Mapping[str, Tensor]) -> NDArray[np.float32] | None:
        return self._in_units(self._decoder.push(codes))

    def finish(self) -> NDArray[np.float32] | None:
        return self._in_units(self._decoder.finish())

    def _in_units(self, made: Tensor | None) -> NDArray[np.float32] | None:
        return None if made is None else np.asarray(self._units(made), np.float32)
