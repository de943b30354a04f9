"""`H2VQ`: Holistic Hierarchical VQ-VAE (HumanTOMATO section 3.2, B.2, Algorithms 1 and 2).

Hands are quantized first, at a quarter of the frame rate; the body at half of it, knowing the hand codes:
z_hat_B = Q_B(Conv1d(Concat(Transform(z_hat_H), z_B))). The paper leaves open: Transform = nearest x2
up-sampling and a linear projection; the fusing Conv1d has kernel 3; the decoder reads both latents at the
body rate and doubles it once.

With a `finger_gain` (`layers/basis.py`) the hand codes read how fingers bend and nothing else; how the hand
is turned is left to the body codes, which read the knuckles [ours].

A clip without hands gives the hand codebook nothing to learn; its hand latents are 0 wherever they are read.
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
from motionloom.models.tokenizer.config import H2VQConfig


class H2VQ(BodyHandTokenizer):
    """Two body tokens and one hand token per four frames."""

    hand_read: Tensor
    body_read: Tensor

    def __init__(self, config: H2VQConfig, layout: MotionLayout) -> None:
        super().__init__(config, layout)
        width, depth, growth, d = config.width, config.depth, config.dilation_growth, config.code_dim
        hand, body = self.hand_columns, self.body_columns
        if self.basis.bends:
            hand, body = self.basis.bent, torch.cat([body, self.basis.knuckles])
        self.register_buffer("hand_read", hand, persistent=False)
        self.register_buffer("body_read", body, persistent=False)
        self.hand_encoder = ConvEncoder(
            len(hand), d, width=width, halvings=2, depth=depth, dilation_growth=growth
        )
        self.body_encoder = ConvEncoder(
            len(body), d, width=width, halvings=1, depth=depth, dilation_growth=growth
        )
        self.hand_quantizer = EmaQuantizer(config.quantizer(), salt=0)
        self.transform = nn.Linear(d, d)
        self.fuse = nn.Conv1d(2 * d, d, 3, padding=1)
        self.body_quantizer = EmaQuantizer(config.quantizer(), salt=1)
        self.decoder = ConvDecoder(
            2 * d, self.dim, width=width, doublings=1, depth=depth, dilation_growth=growth
        )

    def codebooks(self) -> dict[str, Codebook]:
        """The quantizer of each stream."""
        return {"body": self.body_quantizer, "hand": self.hand_quantizer}

    def _quantize(
        self, x: Tensor, valid: Tensor | None, missing: dict[str, Tensor], *, update: bool
    ) -> Latents:
        no_hands = missing.get("hand")
        z_hand = self.hand_encoder(x[..., self.hand_read], valid)
        hand = self.hand_quantizer(z_hand, token_mask(valid, z_hand.shape[1], 4, no_hands), update=update)
        hand_vectors = without(hand.quantized, no_hands)
        z_body = self.body_encoder(x[..., self.body_read], valid)
        hint = self.transform(hand_vectors).repeat_interleave(2, dim=1)
        mask = token_mask(valid, z_body.shape[1], 2)
        both = torch.cat([hint, z_body], dim=-1)
        if mask is not None:
            both = both.masked_fill(~mask[..., None], 0.0)
        fused = self.fuse(both.transpose(1, 2)).transpose(1, 2)
        body = self.body_quantizer(fused, mask, update=update)
        return Latents(
            self._join({"body": body.quantized, "hand": hand_vectors}),
            body.penalty + hand.penalty,
            {"body": body.codes, "hand": hand.codes},
            stream_metrics(body.metrics, "body") | stream_metrics(hand.metrics, "hand"),
        )
