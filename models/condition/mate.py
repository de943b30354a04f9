"""`Mate`: UDE's modality-agnostic transformer encoder (MATE, section 3.2).

Every modality of a batch's `Conditions` goes through one linear layer to a common width and gets its learned
modality token on each position (equation 3); an aggregation token stands in front; full attention runs over
all. The output of the aggregation token is the global embedding, the others are the sequential embedding.

Notable choices:
- A row may have any subset of the modalities; with several, their positions stand one after another (in the
  order that the network was built with), so one attention sees them all [ours]: the paper has one a sample.
- The paper has an aggregation token per modality. Here it is a common token plus one of each modality the row
  has: for one modality that is the paper's, for several and for none it is defined as well [ours]. A row
  without a modality is the unconditional input that guidance needs.
- Positions are sinusoidal, counted within each modality from 1 on (0 is the aggregation token). Counting over
  the whole would make a row's result depend on how far other rows' texts pad it [ours].
- Audio features differ by orders of magnitude (MFCC to beat flags): they must arrive normalised.

Legend: B batch, L positions of one modality, S positions of all, F its features, E width.
"""

from __future__ import annotations

import functools
from collections.abc import Collection, Mapping, Sequence
from typing import Literal, NamedTuple

import torch
from pydantic import Field
from torch import Tensor, nn

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.conditions import Condition, Conditions
from motionloom.models.layers.transformer import StackConfig, Transformer, sinusoid


class MateConfig(StackConfig):
    """Sizes; the defaults are the paper's (section 4.2)."""

    dim: int = Field(default=256, ge=2, multiple_of=2)
    layers: int = Field(default=6, ge=1)
    attention_dropout: float = Field(default=0.1, ge=0, lt=1)
    stride: Literal[1, 2, 4] = 1
    """Frames of music that one position reads; 1 is the paper's, more make its sequence shorter [ours]."""


class Encoded(NamedTuple):
    """The encoded conditions of a batch."""

    glob: Tensor
    """[B, E], global embedding."""
    seq: Tensor
    """[B, S, E], sequential embedding; zero where `mask` is false."""
    mask: Tensor
    """bool [B, S]."""
    timed: Tensor | None = None
    """[B, T, E], the part of `seq` that lies on the motion's time line, that of music, a position for
    `stride` frames; zero where a row has none. None = no row has any."""

    def rows(self, index: Tensor | slice) -> Encoded:
        timed = None if self.timed is None else self.timed[index]
        return Encoded(self.glob[index], self.seq[index], self.mask[index], timed)


class Mate(nn.Module):
    """Conditions of any modalities to one embedding space.

    Args:
        widths: Modality -> F, e.g. {"text": 384, "audio": 438}; their order is that of the sequence.
        timed: Modalities whose positions are the motion's frames, e.g. {"audio"}.
    """

    def __init__(self, config: MateConfig, widths: Mapping[str, int], *, timed: Collection[str]) -> None:
        super().__init__()
        if not widths:
            raise UserError("MATE needs at least one modality to read")
        self.config = config
        self.widths = dict(widths)
        self.timed = frozenset(timed)
        dim = config.dim
        self.project = nn.ModuleDict(
            {name: nn.Linear(width * self._stride(name), dim) for name, width in widths.items()}
        )
        self.modality = nn.ParameterDict({name: _token(dim) for name in widths})
        self.aggregate = _token(dim)
        self.aggregate_of = nn.ParameterDict({name: _token(dim) for name in widths})
        self.dropout = nn.Dropout(config.dropout)
        self.stack = Transformer(config, config.layers, attention_dropout=config.attention_dropout)

    def forward(self, conditions: Conditions, batch: int | None = None) -> Encoded:
        """Encode the conditions of a batch; modalities that the mapping lacks count as absent in every row.

        Args:
            conditions: Features [B, L, F] and masks [B, L] of each modality.
            batch: B, needed only where `conditions` is empty.
        """
        unknown = [name for name in conditions if name not in self.widths]
        if unknown:
            raise UserError(f"MATE was built for {list(self.widths)}, not for {unknown}")
        size = next((len(c.mask) for c in conditions.values()), batch)
        if size is None:
            raise ValueError("without any modality the size of the batch must be given")
        first = self.aggregate.expand(size, -1)
        pieces = []
        masks = []
        for name, width in self.widths.items():
            features, mask = self._modality(conditions.get(name), name, width, size)
            x = self.project[name](features.to(self.aggregate.dtype)) + self.modality[name]
            pieces.append(x + sinusoid(x.shape[1] + 1, x.shape[2], x.device)[1:].to(x.dtype))
            masks.append(mask)
            first = first + mask.any(1)[:, None] * self.aggregate_of[name]
        origin = sinusoid(1, first.shape[1], first.device).to(first.dtype)
        x = torch.cat([(first + origin)[:, None], *pieces], dim=1)
        mask = torch.cat(masks, dim=1)
        sizes = [piece.shape[1] for piece in pieces]
        x = self.stack(self.dropout(x), torch.cat([mask.new_ones(size, 1), mask], dim=1))
        seq = x[:, 1:].masked_fill(~mask[..., None], 0.0)
        return Encoded(x[:, 0], seq, mask, self._timed(seq.split(sizes, dim=1)))

    def unconditional(self, batch: int) -> Encoded:
        """Return the encoding of rows without any modality, S = 0."""
        out: Encoded = self({}, batch)
        return out

    def _timed(self, parts: Sequence[Tensor]) -> Tensor | None:
        """The sum of the timed modalities' embeddings [B, T, E], of which T is the longest's; None = none."""
        found = [x for name, x in zip(self.widths, parts, strict=True) if name in self.timed and x.shape[1]]
        size = max([0, *(x.shape[1] for x in found)])
        padded = [nn.functional.pad(x, (0, 0, 0, size - x.shape[1])) for x in found]
        return functools.reduce(torch.add, padded) if padded else None

    def _modality(
        self, condition: Condition | None, name: str, width: int, size: int
    ) -> tuple[Tensor, Tensor]:
        if condition is None:
            # Empty, so that its parameters still are in the graph, with zero gradients: distributed training
            # wants the same parameters used on every rank.
            device = self.aggregate.device
            return (
                self.aggregate.new_zeros(size, 0, width * self._stride(name)),
                torch.zeros(size, 0, dtype=torch.bool, device=device),
            )
        if condition.features.shape[-1] != width:
            raise UserError(
                f"MATE was built for {width} {name} features, the data has {condition.features.shape[-1]}"
            )
        features = condition.features.masked_fill(~condition.mask[..., None], 0.0)
        mask = condition.mask
        stride = self._stride(name)
        if stride > 1:
            more = -mask.shape[1] % stride
            features = nn.functional.pad(features, (0, 0, 0, more))
            mask = nn.functional.pad(mask, (0, more))
            rows, frames = mask.shape
            features = features.reshape(rows, frames // stride, stride * width)
            mask = mask.view(rows, frames // stride, stride).any(2)
        return features, mask

    def _stride(self, name: str) -> int:
        """Frames of a modality that one position reads."""
        return self.config.stride if name in self.timed else 1


def drop_conditions(conditions: Conditions, drop: Tensor) -> dict[str, Condition]:
    """Conditions without any modality in rows where `drop`, bool [B], is true (classifier-free guidance)."""
    out = {}
    for name, (features, mask, pooled) in conditions.items():
        out[name] = Condition(
            features.masked_fill(drop[:, None, None], 0.0),
            mask & ~drop[:, None],
            None if pooled is None else pooled.masked_fill(drop[:, None], 0.0),
        )
    return out


def _token(dim: int) -> nn.Parameter:
    return nn.Parameter(torch.randn(dim) * dim**-0.5)
