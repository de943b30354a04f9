"""`StreamDecoder`: motion of tokens that arrive group by group, in bounded memory.

A convolutional decoder makes a frame from the tokens within its reach alone (`Tokenizer.reach`), so a frame
is final as soon as the tokens that far behind it are known. Each chunk is decoded from a window that begins
that far before it: the frames are those of decoding all tokens at once, up to the order in which sums of
another length are added.

Legend: B batch, G groups, T = 4 G frames.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from motionloom.models.tokenizer.base import GROUP_FRAMES, Tokenizer


class ArrivingTokens:
    """Tokens as they come, without those that are read no more.

    Args:
        per_group: Tokens of each stream in a group.
    """

    def __init__(self, per_group: Mapping[str, int]) -> None:
        self.per_group = dict(per_group)
        self._codes: dict[str, Tensor] = {}
        self._first = self._known = 0
        """Group that `_codes` begin with, and groups whose tokens are known."""

    def _add(self, codes: Mapping[str, Tensor]) -> None:
        """More tokens, per stream int64 [B, G * per_group]."""
        for name, values in codes.items():
            before = self._codes.get(name)
            self._codes[name] = values if before is None else torch.cat([before, values], dim=1)
        name, per = next(iter(self.per_group.items()))
        self._known += codes[name].shape[1] // per

    def _forget(self, first: int) -> None:
        """Drop the tokens of the groups before `first`."""
        for name, per in self.per_group.items():
            self._codes[name] = self._codes[name][:, (first - self._first) * per :]
        self._first = first


class StreamDecoder(ArrivingTokens):
    """Decodes tokens as they come.

    Args:
        least: Groups that are decoded together at least, except the last ones: more waste less on the
            window's margins, fewer come sooner.
    """

    def __init__(self, net: Tokenizer, least: int = 1) -> None:
        super().__init__({stream.name: stream.per_group for stream in net.streams})
        self.net, self.least = net, max(1, least)
        self._decoded = 0
        """Groups whose frames were given."""

    def push(self, codes: Mapping[str, Tensor]) -> Tensor | None:
        """More tokens, per stream int64 [B, G * per_group] -> the frames [B, T, dim] that are final now.

        None where there are none yet.
        """
        self._add(codes)
        final = self._known - self.net.reach
        return self._decode(final) if final - self._decoded >= self.least else None

    def finish(self) -> Tensor | None:
        """The frames [B, T, dim] up to the end; None where all were given."""
        return self._decode(self._known) if self._known > self._decoded else None

    @torch.no_grad()
    def _decode(self, end: int) -> Tensor:
        """The frames of groups up to `end`; tokens that no later frame needs are dropped."""
        window = self.net.decode(self._codes)
        begin = self._decoded - self._first
        frames = window[:, begin * GROUP_FRAMES : (end - self._first) * GROUP_FRAMES]
        self._decoded = end
        self._forget(max(self._first, end - self.net.reach))
        return frames
