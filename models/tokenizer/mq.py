"""`MotionQuantizer`: the MQ of UDE (section 3.1), one codebook of 2048 codes at a quarter of the frame rate.

It models the layout of its data, whichever that is: UDE's 75-dimensional SMPL vector as published, or joint
features. `part: bodyhand`, the default, is every column but a face's.
"""

from __future__ import annotations

from torch import Tensor

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.layers.strided import StridedDecoder, StridedEncoder
from motionloom.models.quantize.base import Codebook
from motionloom.models.quantize.ema import EmaQuantizer
from motionloom.models.quantize.gradient import GradientQuantizer
from motionloom.models.tokenizer.base import Latents, Stream, Tokenizer, stream_metrics, token_mask
from motionloom.models.tokenizer.config import MqConfig


class MotionQuantizer(Tokenizer):
    """One token, "code", per four frames."""

    def __init__(self, config: MqConfig, layout: MotionLayout) -> None:
        super().__init__(config, layout, config.part, (Stream("code", config.num_codes, 1),), ("code",))
        width, depth, growth = config.width, config.depth, config.dilation_growth
        self.encoder = StridedEncoder(
            self.dim, config.code_dim, width=width, depth=depth, dilation_growth=growth
        )
        self.quantizer: GradientQuantizer | EmaQuantizer
        if config.quantizer == "gradient":
            self.quantizer = GradientQuantizer(config.gradient_quantizer())
        else:
            self.quantizer = EmaQuantizer(config.ema_quantizer())
        self.decoder = StridedDecoder(
            config.code_dim, self.dim, width=width, depth=depth, dilation_growth=growth
        )

    def codebooks(self) -> dict[str, Codebook]:
        """The quantizer of the one stream."""
        return {"code": self.quantizer}

    def _quantize(
        self, x: Tensor, valid: Tensor | None, missing: dict[str, Tensor], *, update: bool
    ) -> Latents:
        z = self.encoder(x, valid)
        out = self.quantizer(z, token_mask(valid, z.shape[1], 4), update=update)
        return Latents(out.quantized, out.penalty, {"code": out.codes}, stream_metrics(out.metrics, "code"))

    def _join(self, vectors: dict[str, Tensor]) -> Tensor:
        return vectors["code"]
