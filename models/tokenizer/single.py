"""`SingleTokenizer`: one encoder, one decoder, one or several residual codebooks over chosen columns.

Vanilla VQ and RVQ baselines of HumanTOMATO (appendix G) and its face RVQ (B.4) are this class with different
configs.
"""

from __future__ import annotations

from torch import Tensor

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.layers.conv import ConvDecoder, ConvEncoder
from motionloom.models.quantize.base import Codebook
from motionloom.models.quantize.residual import ResidualQuantizer
from motionloom.models.tokenizer.base import Latents, Stream, Tokenizer, stream_metrics, token_mask
from motionloom.models.tokenizer.config import RvqConfig, VqConfig


class SingleTokenizer(Tokenizer):
    """One token per codebook and four frames: "code" for VQ; "level0", "level1", ... for RVQ."""

    def __init__(self, config: VqConfig | RvqConfig, layout: MotionLayout) -> None:
        if isinstance(config, RvqConfig):
            names = tuple(f"level{i}" for i in range(config.levels))
        else:
            names = ("code",)
        streams = tuple(Stream(name, config.num_codes, 1) for name in names)
        super().__init__(config, layout, config.part, streams, names)
        width, depth, growth = config.width, config.depth, config.dilation_growth
        self.encoder = ConvEncoder(
            self.dim, config.code_dim, width=width, halvings=2, depth=depth, dilation_growth=growth
        )
        self.quantizer = ResidualQuantizer(config.quantizer(), len(names))
        self.decoder = ConvDecoder(
            config.code_dim, self.dim, width=width, doublings=2, depth=depth, dilation_growth=growth
        )

    def codebooks(self) -> dict[str, Codebook]:
        """The quantizer of each stream."""
        return {stream.name: self.quantizer.level(i) for i, stream in enumerate(self.streams)}

    def _quantize(
        self, x: Tensor, valid: Tensor | None, missing: dict[str, Tensor], *, update: bool
    ) -> Latents:
        z = self.encoder(x, valid)
        out = self.quantizer(z, token_mask(valid, z.shape[1], 4), update=update)
        metrics: dict[str, Tensor] = {}
        for i, stream in enumerate(self.streams):
            metrics |= stream_metrics({name: value[i] for name, value in out.metrics.items()}, stream.name)
        codes = {stream.name: out.codes[..., i] for i, stream in enumerate(self.streams)}
        return Latents(out.quantized, out.penalty, codes, metrics)

    def _join(self, vectors: dict[str, Tensor]) -> Tensor:
        total = vectors[self.streams[0].name]
        for stream in self.streams[1:]:
            total = total + vectors[stream.name]
        return total
