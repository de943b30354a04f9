"""UDE's motion quantization: published sizes, layouts, three layers, learning."""

from __future__ import annotations

import math

import pytest
import torch

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError
from motionloom.models.gpt.tokens import interleave
from motionloom.models.layers.strided import StridedDecoder, StridedEncoder
from motionloom.models.quantize.ema import EmaQuantizer
from motionloom.models.quantize.gradient import GradientQuantizer
from motionloom.models.tokenizer.base import Stream
from motionloom.models.tokenizer.build import build_tokenizer
from motionloom.models.tokenizer.config import MqConfig, parse_tokenizer
from motionloom.models.tokenizer.mq import MotionQuantizer


def test_sizes_of_the_paper() -> None:
    config = parse_tokenizer({"kind": "mq"}, "here")
    net = build_tokenizer(config, MotionLayout.named("smpl75"))
    assert isinstance(net, MotionQuantizer)
    assert (net.dim, net.streams, net.pattern) == (75, (Stream("code", 2048, 1),), ("code",))
    assert net.bits_per_second == pytest.approx(20 / 4 * math.log2(2048))
    block = (1024 * 3 + 1) * 1024 + (1024 + 1) * 1024
    down = (75 * 4 + 1) * 1024 + (1024 * 4 + 1) * 1024 + (1024 * 3 + 1) * 1024
    up = 2 * (1024 * 3 + 1) * 1024 + (1024 * 3 + 1) * 75
    assert sum(p.numel() for p in net.encoder.parameters()) == down + 2 * block
    assert sum(p.numel() for p in net.decoder.parameters()) == up + 2 * block
    assert sum(p.numel() for p in net.quantizer.parameters()) == 2048 * 1024
    assert isinstance(config, MqConfig)
    assert config.loss_terms()["alpha"] == 1
    assert (config.codebook_weight, config.commitment_weight) == (1, 1)


def test_depth_0_is_three_layers() -> None:
    for net in (StridedEncoder(5, 6, width=8, depth=0), StridedDecoder(6, 5, width=8, depth=0)):
        assert sum(isinstance(m, torch.nn.Conv1d) for m in net.modules()) == 3


@pytest.mark.parametrize(
    ("layout", "dim"), [("smpl75", 75), ("body133", 133), ("wholebody313", 313), ("wholebody363", 313)]
)
@pytest.mark.parametrize("quantizer", ["gradient", "ema"])
def test_models_the_layout_of_its_data(layout: str, dim: int, quantizer: str) -> None:
    torch.manual_seed(0)
    config = MqConfig.model_validate(
        {"width": 8, "code_dim": 6, "num_codes": 10, "start": "data", "quantizer": quantizer}
    )
    net = build_tokenizer(config, MotionLayout.named(layout))
    assert net.dim == dim
    x = torch.randn(2, 16, dim)
    out = net(x, torch.tensor([16, 7]))
    kind = GradientQuantizer if quantizer == "gradient" else EmaQuantizer
    assert isinstance(net.codebooks()["code"], kind)
    codes = net.encode(x, torch.tensor([16, 7]))
    motion = net.decode(codes, torch.tensor([16, 7]))
    assert motion.shape == x.shape
    assert (motion[1, 8:] == 0).all()
    sequence = interleave(codes, net.pattern, ends={"code": 10}, groups=torch.tensor([4, 2]))
    assert sequence.length.tolist() == [5, 3]
    assert out.metrics["dead_code"] <= 10


def test_a_face_is_modelled_alone_or_refused() -> None:
    net = build_tokenizer(MqConfig(width=8, code_dim=6, part="face"), MotionLayout.named("wholebody363"))
    assert net.dim == 50
    with pytest.raises(UserError, match="smpl75 has no face columns"):
        build_tokenizer(MqConfig(part="face"), MotionLayout.named("smpl75"))


def test_learns_by_gradient() -> None:
    """Reconstructs two kinds of motion far better than their mean, with several codes in use."""
    torch.manual_seed(0)
    config = MqConfig(width=32, code_dim=16, num_codes=32, start="data")
    net = build_tokenizer(config, MotionLayout.named("smpl75"))
    phase = torch.linspace(0, 6, 32)[None, :, None] + torch.rand(16, 1, 1) * 6
    x = torch.sin(phase * (1 + torch.arange(16)[:, None, None] % 2) + torch.arange(75))
    optimizer = torch.optim.Adam(net.parameters(), lr=2e-3)
    for _ in range(150):
        out = net(x)
        optimizer.zero_grad()
        loss = (out.written - out.read).square().mean() + config.commitment() * out.penalty
        loss.backward()
        optimizer.step()
    error = (net.decode(net.encode(x)) - x).square().mean()
    assert error < 0.4 * x.var()
    assert out.metrics["perplexity_code"] > 6
