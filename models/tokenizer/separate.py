"""`SeparateVQ`: body and hands each with an own encoder, codebook and decoder (HumanTOMATO Tables 5 and 22).

The ablation of H2VQ: the same rates (two body tokens and one hand token per four frames, so the same bits),
but the body's codes do not know the hands' and neither decoder sees the other part.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.layers.conv import ConvDecoder, ConvEncoder
from motionloom.models.quantize.base import Codebook
from motionloom.models.quantize.ema import EmaQuantizer
from motionloom.models.tokenizer.base import Latents, stream_metrics, token_mask, without
from motionloom.models.tokenizer.body_hand import BodyHandTokenizer
from motionloom.models.tokenizer.config import SeparateConfig

_HALVINGS = {"body": 1, "hand": 2}


class SeparateVQ(BodyHandTokenizer):
    """Streams "body" and "hand" that share nothing."""

    def __init__(self, config: SeparateConfig, layout: MotionLayout) -> None:
        super().__init__(config, layout)
        columns = {"body": self.body_columns, "hand": self.hand_columns}
        width, depth, growth, d = config.width, config.depth, config.dilation_growth, config.code_dim
        self.encoders = nn.ModuleDict(
            {
                name: ConvEncoder(
                    len(where), d, width=width, halvings=_HALVINGS[name], depth=depth, dilation_growth=growth
                )
                for name, where in columns.items()
            }
        )
        self.quantizers = nn.ModuleDict(
            {name: EmaQuantizer(config.quantizer(), salt=i) for i, name in enumerate(columns)}
        )
        decoders = {
            name: ConvDecoder(
                d, len(where), width=width, doublings=_HALVINGS[name], depth=depth, dilation_growth=growth
            )
            for name, where in columns.items()
        }
        self.decoder = _ApartDecoder(decoders, columns, d)

    def codebooks(self) -> dict[str, Codebook]:
        """The quantizer of each stream."""
        return {name: self._book(name) for name in _HALVINGS}

    def _book(self, name: str) -> EmaQuantizer:
        book = self.quantizers[name]
        assert isinstance(book, EmaQuantizer)
        return book

    def _quantize(
        self, x: Tensor, valid: Tensor | None, missing: dict[str, Tensor], *, update: bool
    ) -> Latents:
        vectors: dict[str, Tensor] = {}
        codes: dict[str, Tensor] = {}
        metrics: dict[str, Tensor] = {}
        penalty = x.new_zeros((), dtype=torch.float32)
        for name, halvings in _HALVINGS.items():
            z = self.encoders[name](x[..., getattr(self, f"{name}_columns")], valid)
            absent = missing.get(name)
            out = self._book(name)(z, token_mask(valid, z.shape[1], 2**halvings, absent), update=update)
            vectors[name], codes[name] = without(out.quantized, absent), out.codes
            metrics |= stream_metrics(out.metrics, name)
            penalty = penalty + out.penalty
        return Latents(self._join(vectors), penalty, codes, metrics)


class _ApartDecoder(nn.Module):
    """Each part's latents through its own decoder, into its own columns."""

    order: Tensor

    def __init__(self, decoders: dict[str, ConvDecoder], columns: dict[str, Tensor], dim: int) -> None:
        super().__init__()
        self.decoders = nn.ModuleDict(decoders)
        self.dim = dim
        self.stride = decoders["body"].stride
        """Frames of one joined latent."""
        where = torch.cat([columns[name] for name in decoders])
        self.register_buffer("order", torch.argsort(where))

    def forward(self, joined: Tensor, valid: Tensor | None) -> Tensor:
        """Joined latents [B, T / 2, 2 d], valid frames [B] or None -> [B, T, D]."""
        body = self.decoders["body"](joined[..., : self.dim], valid)
        hand = self.decoders["hand"](joined[:, ::2, self.dim :], valid)
        return torch.cat([body, hand], dim=-1)[..., self.order]

    def needs(self, first: int, last: int) -> tuple[int, int]:
        """First and last of the joined latents that frames `first` to `last` are made of."""
        body, hand = (self.decoders[name] for name in ("body", "hand"))
        assert isinstance(body, ConvDecoder) and isinstance(hand, ConvDecoder)
        (low, high), (low_hand, high_hand) = body.needs(first, last), hand.needs(first, last)
        per = hand.stride // body.stride
        return min(low, low_hand * per), max(high, high_hand * per)
