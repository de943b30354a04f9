"""Tokenizers with one encoder, one decoder and one token per codebook and four frames.

- `SingleTokenizer`: vanilla VQ and RVQ (HumanTOMATO appendix G) and the face RVQ (B.4).
- `FsqTokenizer`: the same convolutions around finite scalar quantization.
- `MotionQuantizer`: the MQ of UDE (section 3.1), strided convolutions around one codebook of 2048 codes. It
  models the layout of its data: UDE's 75-dimensional SMPL vector as published, or joint features. `part:
  bodyhand`, the default, is every column but a face's.
"""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.layers.conv import ConvDecoder, ConvEncoder
from motionloom.models.layers.strided import StridedDecoder, StridedEncoder
from motionloom.models.quantize.base import Codebook
from motionloom.models.quantize.ema import EmaQuantizer, ResidualQuantizer
from motionloom.models.quantize.fsq import FsqQuantizer
from motionloom.models.quantize.gradient import GradientQuantizer
from motionloom.models.tokenizer.base import Latents, Stream, Tokenizer, stream_metrics, token_mask
from motionloom.models.tokenizer.config import FsqConfig, MqConfig, RvqConfig, VqConfig


class SingleTokenizer(Tokenizer):
    """Streams: "code" for VQ; "level0", "level1", ... for RVQ."""

    def __init__(self, config: VqConfig | RvqConfig, layout: MotionLayout) -> None:
        if isinstance(config, RvqConfig):
            names = tuple(f"level{i}" for i in range(config.levels))
        else:
            names = ("code",)
        streams = tuple(Stream(name, config.num_codes, 1) for name in names)
        super().__init__(config, layout, config.part, streams, names)
        sizes, dim = config.conv_sizes(), config.code_dim
        self.encoder = ConvEncoder(self.dim, dim, halvings=2, **sizes)
        self.quantizer = ResidualQuantizer(config.quantizer(), len(names))
        self.decoder = ConvDecoder(dim, self.dim, doublings=2, **sizes)

    def codebooks(self) -> dict[str, Codebook]:
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


class OneCodebook(Tokenizer):
    """One stream, "code"; subclasses set `encoder`, `quantizer` and `decoder`."""

    encoder: nn.Module
    quantizer: FsqQuantizer | GradientQuantizer | EmaQuantizer

    def codebooks(self) -> dict[str, Codebook]:
        return {"code": self.quantizer}

    def _latents(self, x: Tensor, valid: Tensor | None) -> Tensor:
        z: Tensor = self.encoder(x, valid)
        return z

    def _quantize(
        self, x: Tensor, valid: Tensor | None, missing: dict[str, Tensor], *, update: bool
    ) -> Latents:
        z = self._latents(x, valid)
        out = self.quantizer(z, token_mask(valid, z.shape[1], 4), update=update)
        return Latents(out.quantized, out.penalty, {"code": out.codes}, stream_metrics(out.metrics, "code"))

    def _join(self, vectors: dict[str, Tensor]) -> Tensor:
        return vectors["code"]


class FsqTokenizer(OneCodebook):
    """The single tokenizer's convolutions around finite scalar quantization."""

    def __init__(self, config: FsqConfig, layout: MotionLayout) -> None:
        quantizer = FsqQuantizer(config.code_dim, config.steps)
        super().__init__(config, layout, config.part, (Stream("code", quantizer.num_codes, 1),), ("code",))
        sizes, dim = config.conv_sizes(), config.code_dim
        self.encoder = ConvEncoder(self.dim, dim, halvings=2, **sizes)
        self.quantizer = quantizer
        self.decoder = ConvDecoder(dim, self.dim, doublings=2, **sizes)

    def _latents(self, x: Tensor, valid: Tensor | None) -> Tensor:
        # Unit variance: an untrained encoder's small latents would all round to the code in the middle.
        return functional.layer_norm(super()._latents(x, valid), (self.config.code_dim,))


class MotionQuantizer(OneCodebook):
    """UDE's motion quantization."""

    def __init__(self, config: MqConfig, layout: MotionLayout) -> None:
        super().__init__(config, layout, config.part, (Stream("code", config.num_codes, 1),), ("code",))
        sizes, dim = config.conv_sizes(), config.code_dim
        self.encoder = StridedEncoder(self.dim, dim, **sizes)
        if config.quantizer == "gradient":
            self.quantizer = GradientQuantizer(config.codebook())
        else:
            self.quantizer = EmaQuantizer(config.codebook())
        self.decoder = StridedDecoder(dim, self.dim, **sizes)
