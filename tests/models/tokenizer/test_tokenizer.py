"""Every tokenizer kind: shapes, padding, encode/decode contract, freezing, checkpoints, errors."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError
from motionloom.models.tokenizer.base import Stream, Tokenizer
from motionloom.models.tokenizer.body_hand import H2VQ, H2VQConfig, SeparateConfig
from motionloom.models.tokenizer.single import FsqConfig, MqConfig, RvqConfig, VqConfig
from motionloom.pipeline.baselines.tm2t.tokenizer import Tm2tConfig

LAYOUT = MotionLayout.named("wholebody363")
SMALL: dict[str, Any] = {"width": 16, "depth": 2, "code_dim": 8, "num_codes": 16}
CONFIGS = {
    "h2vq": H2VQConfig(**SMALL),
    "vq": VqConfig(**SMALL),
    "rvq body": RvqConfig(**SMALL, part="body"),
    "rvq face": RvqConfig(**SMALL, part="face", levels=3),
    "separate": SeparateConfig(**SMALL),
    "fsq": FsqConfig(width=16, depth=2, code_dim=8, steps=(4, 4)),
    "mq": MqConfig(**SMALL, start="data"),
    "tm2t": Tm2tConfig(**SMALL, start="data"),
    "mq by moving averages": MqConfig(**SMALL, quantizer="ema"),
}


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


@pytest.fixture(params=list(CONFIGS))
def tokenizer(request: pytest.FixtureRequest) -> Tokenizer:
    net = CONFIGS[request.param].build(LAYOUT)
    for _ in range(3):
        net(torch.randn(8, 16, net.dim))
    return net


def masked_tokens(codes: Tensor, stream: Stream, length: Tensor) -> list[Tensor]:
    return [c[: (int(n) + 3) // 4 * stream.per_group] for c, n in zip(codes, length, strict=True)]


def test_columns_streams_and_shapes(tokenizer: Tokenizer) -> None:
    part = tokenizer.config.model_dump()["part"]
    assert tokenizer.columns.tolist() == LAYOUT.part(part).tolist()
    full = torch.randn(3, 20, 363)
    x = tokenizer.select(full)
    assert torch.equal(x, full[..., LAYOUT.part(part)])
    assert tokenizer.group_frames == 4
    out = tokenizer(x)
    assert tokenizer.features(out.reconstruction).shape == x.shape
    assert set(out.codes) == {s.name for s in tokenizer.streams} == set(tokenizer.pattern)
    for stream in tokenizer.streams:
        assert tokenizer.pattern.count(stream.name) == stream.per_group
        assert out.codes[stream.name].shape == (3, 5 * stream.per_group)
        assert out.codes[stream.name].dtype == torch.int64
        assert out.codes[stream.name].max() < stream.num_codes == 16
        for metric in ("perplexity", "usage", "dead", "resets"):
            assert out.metrics[f"{metric}_{stream.name}"].shape == ()


def test_paper_sizes() -> None:
    net = H2VQConfig().build(MotionLayout.named("wholebody313"))
    assert net.streams == (Stream("body", 512, 2), Stream("hand", 512, 1))
    assert net.pattern == ("body", "body", "hand")
    assert net.dim == 313
    assert isinstance(net, H2VQ)
    assert len(net.body_columns) == 133
    assert len(net.hand_columns) == 180
    codes = net.encode(torch.zeros(1, 196, 313))
    assert codes["body"].shape[1] + codes["hand"].shape[1] == 147  # 149 with the two End tokens
    dilations = [m.dilation[0] for m in net.hand_encoder.modules() if isinstance(m, nn.Conv1d)]
    assert dilations.count(9) == dilations.count(3) == 2  # one stack per halving
    assert {k for k in net.state_dict() if "quantizer" in k} == {
        f"{part}_quantizer.{name}"
        for part in ("body", "hand")
        for name in ("codebook", "ema_sum", "ema_count", "initialised", "draws")
    }


def test_padded_batch_equals_each_clip_alone(tokenizer: Tokenizer) -> None:
    tokenizer.eval()
    length = torch.tensor([8, 24, 4, 16])
    x = torch.randn(4, 24, tokenizer.dim)
    x[torch.arange(24) >= length[:, None]] = 5.0  # garbage, not zeros: the mask alone must do it
    out = tokenizer(x, length)
    recon, decoded = tokenizer.features(out.reconstruction, length), tokenizer.decode(out.codes, length)
    penalties = []
    for i, n in enumerate(length.tolist()):
        alone = tokenizer(x[i : i + 1, :n])
        penalties.append(alone.penalty)
        torch.testing.assert_close(
            recon[i, :n], tokenizer.features(alone.reconstruction)[0], rtol=1e-4, atol=1e-5
        )
        torch.testing.assert_close(decoded[i, :n], tokenizer.decode(alone.codes)[0], rtol=1e-4, atol=1e-5)
        assert (recon[i, n:] == 0).all()
        for stream in tokenizer.streams:
            assert torch.equal(
                masked_tokens(out.codes[stream.name], stream, length)[i], alone.codes[stream.name][0]
            )
    mean = sum(p * n for p, n in zip(penalties, length.tolist(), strict=True)) / length.sum()
    torch.testing.assert_close(out.penalty, mean, rtol=1e-4, atol=1e-6)


def test_decode_of_encode_is_the_eval_forward(tokenizer: Tokenizer) -> None:
    tokenizer.train()
    x = torch.randn(2, 16, tokenizer.dim)
    before = {k: v.clone() for k, v in tokenizer.state_dict().items()}
    codes = tokenizer.encode(x)  # never updates, in training mode neither
    assert all(torch.equal(v, before[k]) for k, v in tokenizer.state_dict().items())
    out = tokenizer.eval()(x)
    for name, value in codes.items():
        assert torch.equal(value, out.codes[name])
    torch.testing.assert_close(
        tokenizer.decode(codes), tokenizer.features(out.reconstruction), rtol=1e-4, atol=1e-5
    )


def test_decode_soft(tokenizer: Tokenizer) -> None:
    tokenizer.freeze()
    codes = {s.name: torch.randint(0, 16, (2, 3 * s.per_group)) for s in tokenizer.streams}
    hard = {k: functional.one_hot(v, 16).float().requires_grad_() for k, v in codes.items()}
    length = torch.tensor([12, 8])
    motion = tokenizer.decode_soft(hard, length)
    torch.testing.assert_close(motion, tokenizer.decode(codes, length), rtol=1e-4, atol=1e-5)
    motion.square().sum().backward()
    for stream in tokenizer.streams:
        grad = hard[stream.name].grad
        assert grad is not None
        assert grad[0].abs().sum(-1).min() > 0
        assert (grad[1, 2 * stream.per_group :] == 0).all()  # beyond the second clip's 8 frames


def test_gradients_reach_every_parameter(tokenizer: Tokenizer) -> None:
    x = torch.randn(4, 16, tokenizer.dim)
    out = tokenizer(x)
    ((out.reconstruction - out.input).square().mean() + 0.02 * out.penalty).backward()
    for name, parameter in tokenizer.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().sum() > 0, name


def test_freeze_survives_the_train_call_of_a_parent(tokenizer: Tokenizer) -> None:
    parent = nn.ModuleList([tokenizer.freeze(), nn.Linear(2, 2)])
    parent.train()
    before = {k: v.clone() for k, v in tokenizer.state_dict().items()}
    tokenizer(torch.randn(4, 16, tokenizer.dim))
    assert not any(m.training for m in tokenizer.modules())
    assert not any(p.requires_grad for p in tokenizer.parameters())
    assert all(torch.equal(v, before[k]) for k, v in tokenizer.state_dict().items())
    assert parent[1].training


def test_state_dict_round_trip_is_bit_equal(tokenizer: Tokenizer) -> None:
    torch.manual_seed(5)
    other = tokenizer.config.build(LAYOUT)  # type: ignore[arg-type]
    other.load_state_dict(tokenizer.state_dict())
    x = torch.randn(2, 16, tokenizer.dim)
    a, b = tokenizer.encode(x), other.encode(x)
    assert all(torch.equal(a[k], b[k]) for k in a)
    assert torch.equal(tokenizer.decode(a), other.decode(b))
    more = torch.randn(
        8, 16, tokenizer.dim
    )  # training goes on from the same codebook state, not from a new one
    tokenizer.train()(more)
    other.train()(more)
    assert all(torch.equal(v, other.state_dict()[k]) for k, v in tokenizer.state_dict().items())


def test_body_tokens_depend_on_hands_and_hand_tokens_not_on_the_body() -> None:
    net = CONFIGS["h2vq"].build(LAYOUT)
    assert isinstance(net, H2VQ)
    net(torch.randn(16, 16, 313))
    net.eval()
    x = torch.randn(8, 16, 313)
    other_body, other_hand = x.clone(), x.clone()
    other_body[..., net.body_columns] = torch.randn(8, 16, 133)
    other_hand[..., net.hand_columns] = 3 * torch.randn(8, 16, 180)
    a, b, c = net.encode(x), net.encode(other_body), net.encode(other_hand)
    assert torch.equal(a["hand"], b["hand"])
    assert not torch.equal(a["body"], b["body"])
    assert not torch.equal(a["body"], c["body"])


def test_mistakes_are_named() -> None:
    body = MotionLayout.named("body133")
    with pytest.raises(UserError, match=r"body133.* hand"):
        H2VQConfig(**SMALL).build(body)
    with pytest.raises(UserError, match=r"body133.* face"):
        RvqConfig(**SMALL, part="face").build(body)
    net = VqConfig(**SMALL, part="body").build(body)
    with pytest.raises(UserError, match=r"body133.*263"):
        net(torch.zeros(1, 8, 263))
    with pytest.raises(UserError, match="multiple of 4"):
        net(torch.zeros(1, 10, 133))
