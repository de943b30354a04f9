"""`FsqTokenizer`: the single tokenizer's convolutions around finite scalar quantization."""

from __future__ import annotations

from torch import Tensor
from torch.nn import functional

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.layers.conv import ConvDecoder, ConvEncoder
from motionloom.models.quantize.base import Codebook
from motionloom.models.quantize.fsq import FsqQuantizer
from motionloom.models.tokenizer.base import Latents, Stream, Tokenizer, stream_metrics, token_mask
from motionloom.models.tokenizer.config import FsqConfig


class FsqTokenizer(Tokenizer):
    """One token, "code", per four frames."""

    def __init__(self, config: FsqConfig, layout: MotionLayout) -> None:
        quantizer = FsqQuantizer(config.code_dim, config.steps)
        super().__init__(config, layout, config.part, (Stream("code", quantizer.num_codes, 1),), ("code",))
        width, depth, growth = config.width, config.depth, config.dilation_growth
        self.encoder = ConvEncoder(
            self.dim, config.code_dim, width=width, halvings=2, depth=depth, dilation_growth=growth
        )
        self.quantizer = quantizer
        self.decoder = ConvDecoder(
            config.code_dim, self.dim, width=width, doublings=2, depth=depth, dilation_growth=growth
        )

    def codebooks(self) -> dict[str, Codebook]:
        """The quantizer of the one stream."""
        return {"code": self.quantizer}

    def _quantize(
        self, x: Tensor, valid: Tensor | None, missing: dict[str, Tensor], *, update: bool
    ) -> Latents:
        # Unit variance: an untrained encoder's small latents would all round to the code in the middle.
        z = functional.layer_norm(self.encoder(x, valid), (self.config.code_dim,))
        out = self.quantizer(z, token_mask(valid, z.shape[1], 4), update=update)
        return Latents(out.quantized, out.penalty, {"code": out.codes}, stream_metrics(out.metrics, "code"))

    def _join(self, vectors: dict[str, Tensor]) -> Tensor:
        return vectors["code"]
