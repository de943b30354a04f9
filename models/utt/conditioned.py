"""`ConditionedUtt`: MATE and UTT as one network, trained end to end (UDE sections 3.2, 3.3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from torch import nn

from motionloom.models.condition.mate import Mate, MateConfig
from motionloom.models.tokenizer.base import Stream
from motionloom.models.utt.network import Utt, UttConfig


class ConditionedUtt(nn.Module):
    """From conditions to motion tokens.

    Args:
        mate: Sizes of the encoder of conditions.
        utt: Sizes of the token model.
        widths: Modality -> width of its features.
        streams: The tokenizer's streams.
        pattern: Stream of every slot of a group.
    """

    def __init__(
        self,
        mate: MateConfig,
        utt: UttConfig,
        widths: Mapping[str, int],
        streams: Sequence[Stream],
        pattern: Sequence[str],
    ) -> None:
        super().__init__()
        self.mate = Mate(mate, widths)
        self.utt = Utt(utt, streams, pattern, mate.dim, mate.stride)
