"""Tokenizers with two body tokens and one hand token per four frames: `H2VQ` and its ablation `SeparateVQ`.

They share streams, columns, rates and the treatment of clips without hands, so that they compare fairly.

`H2VQ` is the Holistic Hierarchical VQ-VAE (HumanTOMATO section 3.2, B.2, Algorithms 1 and 2). Hands are
quantized first, at a quarter of the frame rate; the body at half of it, knowing the hand codes: z_hat_B =
Q_B(Conv1d(Concat(Transform(z_hat_H), z_B))). The paper leaves open: Transform = nearest x2 up-sampling and a
linear projection; the fusing Conv1d has kernel 3; the decoder reads both latents at the body rate and doubles
it once.

With a `finger_gain` (`layers/basis.py`) the hand codes encode how fingers bend and nothing else; how the hand
is turned is left to the body codes, which read the knuckles [ours].

`SeparateVQ` models body and hands apart, each with its own encoder, codebook and decoder (Tables 5 and 22).

A clip without hands teaches the hand codebook nothing; its hand latents are 0 wherever they are read.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.layers.conv import Conv, ConvDecoder, ConvEncoder
from motionloom.models.quantize.base import Codebook
from motionloom.models.quantize.ema import EmaQuantizer
from motionloom.models.tokenizer.base import (
    EmaTokenizerConfig,
    Latents,
    Stream,
    Tokenizer,
    stream_metrics,
    token_mask,
    without,
)

_HALVINGS = {"body": 1, "hand": 2}


class H2VQConfig(EmaTokenizerConfig):
    """Holistic Hierarchical VQ: a hand codebook at 4x, a body codebook at 2x."""

    kind: Literal["h2vq"] = "h2vq"
    part: Literal["bodyhand"] = "bodyhand"

    def build(self, layout: MotionLayout) -> Tokenizer:
        return H2VQ(self, layout)


class SeparateConfig(EmaTokenizerConfig):
    """Body and hand modelled apart (Tables 5 and 22): H2VQ's rates, but neither knows of the other."""

    kind: Literal["separate"] = "separate"
    part: Literal["bodyhand"] = "bodyhand"

    def build(self, layout: MotionLayout) -> Tokenizer:
        return SeparateVQ(self, layout)


class BodyHandTokenizer(Tokenizer):
    """Streams "body" and "hand". Subclasses set `decoder` and implement `codebooks` and `_quantize`."""

    body_columns: Tensor
    hand_columns: Tensor

    def __init__(self, config: H2VQConfig | SeparateConfig, layout: MotionLayout) -> None:
        if not layout.has_part("hand"):
            raise UserError(
                f"layout {layout.name} has no hand columns; use kind 'vq' or 'rvq' with part 'body'"
            )
        streams = (Stream("body", config.num_codes, 2), Stream("hand", config.num_codes, 1))
        super().__init__(config, layout, config.part, streams, ("body", "body", "hand"))
        columns = layout.part(config.part)
        body, hand = (np.searchsorted(columns, layout.part(part)) for part in ("body", "hand"))
        self.register_buffer("body_columns", torch.from_numpy(body))
        self.register_buffer("hand_columns", torch.from_numpy(hand))

    def missing(self, present: Tensor | None) -> dict[str, Tensor]:
        return {} if present is None else {"hand": ~present[:, self.hand_columns].all(1)}

    def _join(self, vectors: dict[str, Tensor]) -> Tensor:
        return torch.cat([vectors["body"], vectors["hand"].repeat_interleave(2, dim=1)], dim=-1)


class H2VQ(BodyHandTokenizer):
    """Two body tokens and one hand token per four frames."""

    hand_input_columns: Tensor
    body_input_columns: Tensor

    def __init__(self, config: H2VQConfig, layout: MotionLayout) -> None:
        super().__init__(config, layout)
        sizes = config.conv_sizes()
        d = config.code_dim
        hand = self.hand_columns
        body = self.body_columns
        if self.basis.bends:
            hand = self.basis.bent
            body = torch.cat([body, self.basis.knuckles])
        self.register_buffer("hand_input_columns", hand, persistent=False)
        self.register_buffer("body_input_columns", body, persistent=False)
        self.hand_encoder = ConvEncoder(len(hand), d, halvings=2, **sizes)
        self.body_encoder = ConvEncoder(len(body), d, halvings=1, **sizes)
        self.hand_quantizer = EmaQuantizer(config.quantizer(), salt=0)
        self.transform = nn.Linear(d, d)
        self.fuse = Conv(2 * d, d, 3, padding=1)
        self.body_quantizer = EmaQuantizer(config.quantizer(), salt=1)
        self.decoder = ConvDecoder(2 * d, self.dim, doublings=1, **sizes)

    def codebooks(self) -> dict[str, Codebook]:
        return {"body": self.body_quantizer, "hand": self.hand_quantizer}

    def _quantize(
        self, x: Tensor, valid: Tensor | None, missing: dict[str, Tensor], *, update: bool
    ) -> Latents:
        no_hands = missing.get("hand")
        z_hand = self.hand_encoder(x[..., self.hand_input_columns], valid)
        hand = self.hand_quantizer(z_hand, token_mask(valid, z_hand.shape[1], 4, no_hands), update=update)
        hand_vectors = without(hand.quantized, no_hands)
        z_body = self.body_encoder(x[..., self.body_input_columns], valid)
        hint = self.transform(hand_vectors).repeat_interleave(2, dim=1)
        mask = token_mask(valid, z_body.shape[1], 2)
        both = torch.cat([hint, z_body], dim=-1)
        if mask is not None:
            both = both * mask[..., None]
        fused = self.fuse(both)
        body = self.body_quantizer(fused, mask, update=update)
        return Latents(
            self._join({"body": body.quantized, "hand": hand_vectors}),
            body.penalty + hand.penalty,
            {"body": body.codes, "hand": hand.codes},
            stream_metrics(body.metrics, "body") | stream_metrics(hand.metrics, "hand"),
        )


class SeparateVQ(BodyHandTokenizer):
    """Streams "body" and "hand" that share nothing."""

    def __init__(self, config: SeparateConfig, layout: MotionLayout) -> None:
        super().__init__(config, layout)
        columns = {"body": self.body_columns, "hand": self.hand_columns}
        sizes = config.conv_sizes()
        d = config.code_dim
        self.encoders = nn.ModuleDict(
            {
                name: ConvEncoder(len(where), d, halvings=_HALVINGS[name], **sizes)
                for name, where in columns.items()
            }
        )
        self.quantizers = nn.ModuleDict(
            {name: EmaQuantizer(config.quantizer(), salt=i) for i, name in enumerate(columns)}
        )
        decoders = {
            name: ConvDecoder(d, len(where), doublings=_HALVINGS[name], **sizes)
            for name, where in columns.items()
        }
        self.decoder = _ApartDecoder(decoders, columns, d)

    def codebooks(self) -> dict[str, Codebook]:
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
            vectors[name] = without(out.quantized, absent)
            codes[name] = out.codes
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
        where = torch.cat([columns[name] for name in decoders])
        self.register_buffer("order", torch.argsort(where))

    def forward(self, joined: Tensor, valid: Tensor | None) -> Tensor:
        """Joined latents [B, T / 2, 2 d], valid frames [B] or None -> [B, T, D]."""
        body = self.decoders["body"](joined[..., : self.dim], valid)
        hand = self.decoders["hand"](joined[:, ::2, self.dim :], valid)
        return torch.cat([body, hand], dim=-1)[..., self.order]
