"""TM2T's motion tokenizer and its stage (Guo et al. 2022, section 3.1): one codebook at 4x.

Two strided convolutions, each with a residual block behind it, read all columns but the foot contacts; the
decoder has its residual blocks at the latents' rate. The codebook is learnt by gradient, as UDE's, which
follows it. The discriminator that it is trained against is in `module.py`. Padding is masked as in
`models/layers/conv.py`.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.layers.conv import Conv, real_frames, start_weights, zero_padded
from motionloom.models.layers.strided import SLOPE
from motionloom.models.quantize.gradient import GradientQuantizer
from motionloom.models.tokenizer.base import Recon, Stream, Tokenizer
from motionloom.models.tokenizer.single import MqConfig, OneCodebook
from motionloom.models.training.optim import OptimConfig
from motionloom.pipeline.baselines.tm2t.network import CriticConfig
from motionloom.pipeline.contract.showing import Curve
from motionloom.pipeline.stages.networks.tokenizer import TokenizerStage, TokenizerStageConfig
from motionloom.pipeline.store.weights import Release
from motionloom.pipeline.training.config import TrainConfig


class Tm2tConfig(MqConfig):
    """TM2T's tokenizer: its residual blocks are behind the codebook, in the decoder."""

    kind: Literal["tm2t"] = "tm2t"  # type: ignore[assignment]
    recon: Recon = "l1"
    depth: int = Field(default=3, ge=0, le=32)
    """Residual blocks of the decoder; the encoder has one after each layer that changes the rate."""
    num_codes: int = Field(default=1024, ge=2)
    quantizer: Literal["gradient"] = "gradient"

    def build(self, layout: MotionLayout) -> Tokenizer:
        return Tm2tQuantizer(self, layout)


class _Block(nn.Module):
    """Convolution, leaky ReLU, convolution, plus the input."""

    def __init__(self, width: int, dilation: int = 1) -> None:
        super().__init__()
        self.spread = Conv(width, width, 3, padding=dilation, dilation=dilation)
        self.mix = Conv(width, width, 3, padding=dilation, dilation=dilation)

    def forward(self, x: Tensor, real: Tensor | None) -> Tensor:
        hidden = functional.leaky_relu(self.spread(zero_padded(x, real)), SLOPE)
        mixed: Tensor = self.mix(zero_padded(hidden, real))
        return x + mixed


class Tm2tEncoder(nn.Module):
    """Frames to latents, [B, T, D] -> [B, T / 4, out_dim]; reads the columns `heard` of D."""

    heard: Tensor

    def __init__(self, heard: Tensor, out_dim: int, width: int) -> None:
        super().__init__()
        self.register_buffer("heard", heard, persistent=False)
        widths = (width, out_dim)
        self.down = nn.ModuleList(
            Conv(a, b, 4, stride=2, padding=1) for a, b in zip((len(heard), width), widths, strict=True)
        )
        self.blocks = nn.ModuleList(map(_Block, widths))
        start_weights(self, SLOPE)

    def forward(self, x: Tensor, valid: Tensor | None = None) -> Tensor:
        """`valid` [B] = frames that are not padding; T and `valid` are multiples of 4."""
        real = [real_frames(valid, x.shape[1], 2**i) for i in range(3)]
        hidden = x[..., self.heard]
        for i, (down, block) in enumerate(zip(self.down, self.blocks, strict=True)):
            hidden = functional.leaky_relu(down(zero_padded(hidden, real[i])), SLOPE)
            hidden = block(hidden, real[i + 1])
        return hidden


class Tm2tDecoder(nn.Module):
    """Latents to frames, [B, L, dim] -> [B, 4 L, out_dim]."""

    def __init__(self, dim: int, out_dim: int, *, width: int, depth: int, dilation_growth: int) -> None:
        super().__init__()
        dilations = [dilation_growth**i for i in reversed(range(depth))]
        self.blocks = nn.ModuleList(_Block(dim, dilation) for dilation in dilations)
        self.up = nn.ModuleList(Conv(a, b, 3, padding=1) for a, b in ((dim, width), (width, out_dim)))
        self.out = Conv(out_dim, out_dim, 3, padding=1)
        start_weights(self, SLOPE)

    def forward(self, z: Tensor, valid: Tensor | None = None) -> Tensor:
        """`valid` [B] = *frames* that are not padding, a multiple of 4; padded frames come out as zero."""
        real = [real_frames(valid, z.shape[1] * 4, 2**i) for i in range(3)]
        hidden = z
        for block in self.blocks:
            hidden = block(hidden, real[2])
        for i, up in enumerate(self.up):
            wide = zero_padded(hidden, real[2 - i]).repeat_interleave(2, dim=1)
            hidden = functional.leaky_relu(up(wide), SLOPE)
        return zero_padded(self.out(zero_padded(hidden, real[0])), real[0])


class Tm2tQuantizer(OneCodebook):
    """TM2T's tokenizer."""

    encoder: Tm2tEncoder
    decoder: Tm2tDecoder

    def __init__(self, config: Tm2tConfig, layout: MotionLayout) -> None:
        super().__init__(config, layout, config.part, (Stream("code", config.num_codes, 1),), ("code",))
        heard = np.ones(layout.dim, dtype=np.bool_)
        if layout.has("foot_contacts"):
            heard[layout.slice("foot_contacts")] = False
        numbers = torch.from_numpy(np.flatnonzero(heard[layout.part(config.part)]))
        self.encoder = Tm2tEncoder(numbers, config.code_dim, config.width)
        self.quantizer = GradientQuantizer(config.codebook())
        self.decoder = Tm2tDecoder(config.code_dim, self.dim, **config.conv_sizes())


def tm2t_names(net: Tm2tQuantizer) -> dict[str, str]:
    """Names of the network's parameters -> their names in TM2T's release, each network's behind its own."""
    ups = len(net.decoder.blocks) + 1
    theirs = {"quantizer": "quantizer.embedding", "decoder.out": f"vq_decoder.main.{ups + 5}"}
    theirs |= {f"encoder.down.{i}": f"vq_encoder.main.{3 * i}" for i in range(2)}
    theirs |= {f"decoder.up.{i}": f"vq_decoder.main.{ups + 3 * i}" for i in range(2)}
    blocks = {f"encoder.blocks.{i}": f"vq_encoder.main.{3 * i + 2}" for i in range(2)}
    blocks |= {f"decoder.blocks.{i}": f"vq_decoder.main.{i}" for i in range(len(net.decoder.blocks))}
    for here, there in blocks.items():
        theirs |= {f"{here}.spread": f"{there}.model.0", f"{here}.mix": f"{there}.model.2"}
    return {
        name: f"{theirs[owner]}.{'weight' if leaf == 'codebook' else leaf}"
        for name, _ in net.named_parameters()
        for owner, _, leaf in [name.rpartition(".")]
    }


class Tm2tStageConfig(TokenizerStageConfig):
    """TM2T's tokenizer; the defaults are the published ones but for the steps."""

    net: Tm2tConfig = Tm2tConfig()
    critic: CriticConfig = CriticConfig()
    optim: OptimConfig = OptimConfig(optimizer="adam", lr=1e-4, betas=(0.9, 0.999), grad_clip=0.0)
    train: TrainConfig = TrainConfig(steps=100_000, batch_size=128)


class Tm2tStage(TokenizerStage):
    """A tokenizer and its critic, which take turns."""

    trainer = "motionloom.pipeline.baselines.tm2t.module:AdversarialTokenizerModule"
    curves = tuple(
        Curve(name)
        for name in ("tokenizer_recon", "tokenizer_adversarial", "tokenizer_perplexity", "critic_accuracy")
    )

    def release(self, net: Tokenizer) -> Release:
        """TM2T's, without the critic."""
        assert isinstance(net, Tm2tQuantizer)
        return Release(tm2t_names(net))
