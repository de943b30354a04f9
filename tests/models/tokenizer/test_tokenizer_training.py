"""Tokenizer losses against slow references, and the rows of the log."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from plain_training import take_steps
from torch import Tensor, nn
from torch.nn import functional

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.conditions import Condition
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.diffusion.module import TextDenoiserModule
from motionloom.models.diffusion.network import TextDenoiserConfig
from motionloom.models.tma.module import TmaModule
from motionloom.models.tma.network import Tma, TmaConfig
from motionloom.models.tokenizer.base import Recon, Stream, Tokenizer, TokenizerConfig, TokenizerOutput
from motionloom.models.tokenizer.body_hand import H2VQ, H2VQConfig, SeparateConfig
from motionloom.models.tokenizer.module import TokenizerModule, reconstruction_loss, velocity_loss
from motionloom.models.tokenizer.single import FsqConfig, MqConfig, RvqConfig, VqConfig
from motionloom.models.training.stage_module import OptimConfig, StageModule
from motionloom.pipeline.baselines.mdm.network import Mdm
from motionloom.pipeline.baselines.tm2t.tokenizer import Tm2tConfig


def slow_error(a: Tensor, b: Tensor, kind: Recon) -> list[float]:
    out = []
    for d in (a - b).flatten().tolist():
        out.append(d * d if kind == "l2" else (0.5 * d * d if abs(d) < 1 else abs(d) - 0.5))
    return out


@pytest.mark.parametrize("kind", ["l2", "smooth_l1"])
def test_losses_equal_a_slow_reference(kind: Recon) -> None:
    torch.manual_seed(0)
    a, b = 2 * torch.randn(3, 6, 2), torch.randn(3, 6, 2)
    length = torch.tensor([6, 2, 1])
    still, moving = [], []
    for i, n in enumerate(length.tolist()):
        still += slow_error(a[i, :n], b[i, :n], kind)
        if n > 1:
            moving += slow_error(a[i, 1:n] - a[i, : n - 1], b[i, 1:n] - b[i, : n - 1], kind)
    recon, velocity = reconstruction_loss(a, b, length, kind), velocity_loss(a, b, length, kind)
    assert recon.item() == pytest.approx(sum(still) / len(still), rel=1e-5)
    assert velocity.item() == pytest.approx(sum(moving) / len(moving), rel=1e-5)
    full = reconstruction_loss(a, b, None, kind)
    assert full.item() == pytest.approx(sum(slow_error(a, b, kind)) / a.numel(), rel=1e-5)
    assert reconstruction_loss(a, b, torch.full((3,), 6), kind).item() == pytest.approx(full.item())


def test_total_is_the_weighted_sum() -> None:
    a, b, penalty = torch.randn(2, 8, 3), torch.randn(2, 8, 3), torch.tensor(4.0)

    def losses(**config: float) -> dict[str, Tensor]:
        net = nn.Module()
        net.config = VqConfig(**config)  # type: ignore[assignment, arg-type]
        net.position_columns = [1, 2]  # type: ignore[assignment]
        net.forward = lambda *_: TokenizerOutput(b, a, penalty, {}, {})
        return TokenizerModule(net, OptimConfig(), seed=0, max_steps=1).losses({"motion": b, "length": None})

    terms = losses(alpha=0.5, velocity_weight=2.0)
    assert set(terms) == {"loss", "recon", "commit", "velocity"}
    torch.testing.assert_close(terms["loss"], terms["recon"] + 2 * terms["velocity"] + 0.5 * penalty)
    # T2M-GPT's public code: the same error of the positions' columns alone, beside that of all.
    terms = losses(position_weight=0.5, alpha=0.0)
    torch.testing.assert_close(terms["loss"], terms["recon"] + 0.5 * (a - b)[..., 1:].square().mean())
    plain = losses(alpha=0.02)
    assert set(plain) == {"loss", "recon", "commit"}
    torch.testing.assert_close(plain["loss"], (a - b).square().mean() + 0.08)


class Counting(StageModule):
    """A loss that grows by one a batch."""

    def __init__(self) -> None:
        super().__init__(torch.nn.Linear(1, 1), OptimConfig(), seed=0, max_steps=20)
        self.batches = 0

    def losses(self, batch: dict[str, Any]) -> dict[str, Tensor]:
        self.batches += 1
        return {"loss": self.net(torch.zeros(1)).sum() * 0 + self.batches}


@pytest.mark.parametrize("parts", [1, 2])
def test_a_row_of_the_log_is_the_mean_since_the_last(parts: int) -> None:
    module, rows = Counting(), []
    module.accumulate = parts
    for _ in range(2):
        take_steps(module, [{"length": torch.ones(1)}] * (10 * parts))
        rows.append(float(module.take_row()["train/loss"]))
    assert rows == pytest.approx([5 * parts + 0.5, 15 * parts + 0.5])


# Columns that a clip does not hold change no loss, gradient or codebook, whatever stands in them.

LAYOUT = MotionLayout.named("wholebody363")
SMALL: dict[str, Any] = {"width": 8, "depth": 1, "code_dim": 8, "velocity_weight": 0.5}
BOOK: dict[str, Any] = {**SMALL, "num_codes": 8, "reset_below": 0.1}
CONFIGS: dict[str, TokenizerConfig] = {
    "h2vq": H2VQConfig(**BOOK),
    "separate": SeparateConfig(**BOOK),
    "vq all": VqConfig(**BOOK, part="all"),
    "rvq bodyhand": RvqConfig(**BOOK, part="bodyhand"),
    "fsq": FsqConfig(**SMALL, steps=(4, 4)),
}
HELD = [3, 1, 2, 0]
LENGTH = torch.tensor([16, 12, 16, 9])


def module_of(config: TokenizerConfig) -> TokenizerModule:
    torch.manual_seed(0)
    net = config.build(LAYOUT)
    return TokenizerModule(net, OptimConfig(), seed=0, max_steps=1)


def batch_of(columns: Tensor, present: list[int], garbage: float = 0.0) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(5)
    motion = torch.randn(len(present), 16, len(columns), generator=generator)
    mask = torch.from_numpy(LAYOUT.present_columns[present])[:, columns]
    motion = torch.where(mask[:, None], motion, garbage * (1 + motion))
    return {"motion": motion, "length": LENGTH[: len(present)], "present": mask}


def trained(module: StageModule, batches: list[dict[str, Tensor]]) -> tuple[list[dict], list, dict]:
    """Losses of each batch, gradients of the last, and all weights and buffers after it."""
    losses = []
    for batch in batches:
        module.zero_grad()
        torch.manual_seed(3)
        values = module.losses(batch)
        values["loss"].backward()
        losses.append({k: v.detach().clone() for k, v in values.items()})
    return losses, [p.grad for p in module.parameters()], module.state_dict()


def same(one: Any, other: Any) -> None:
    torch.testing.assert_close(one, other, rtol=0, atol=0)


@pytest.mark.parametrize("kind", list(CONFIGS))
def test_garbage_in_missing_columns_changes_nothing(kind: str) -> None:
    runs = []
    for garbage in (0.0, 50.0):
        module = module_of(CONFIGS[kind])
        columns = module.net.columns
        batches = [batch_of(columns, present, garbage) for present in (HELD, [1, 2, 0, 0], HELD[::-1])]
        runs.append((*trained(module, batches), module.net.encode(**encode_arguments(batches[0]))))
    same(*runs)
    assert all(grad is not None for grad in runs[0][1])
    told = [batch_of(columns, [3, 3, 3, 3])] * 2
    untold = [{"motion": one["motion"], "length": one["length"]} for one in told]
    same(*(trained(module_of(CONFIGS[kind]), batches) for batches in (told, untold)))


def encode_arguments(batch: dict[str, Tensor]) -> dict[str, Tensor]:
    return {"x": batch["motion"], "length": batch["length"], "present": batch["present"]}


@pytest.mark.parametrize("kind", ["h2vq", "separate"])
def test_a_batch_without_hands_teaches_the_hands_nothing(kind: str) -> None:
    module = module_of(CONFIGS[kind])
    columns = module.net.columns
    trained(module, [batch_of(columns, HELD)])
    book = module.net.codebooks()["hand"]
    before = {k: v.clone() for k, v in book.state_dict().items() if k != "draws"}  # type: ignore[attr-defined]
    losses, _, _ = trained(module, [batch_of(columns, [0, 2, 0])])
    after = {k: v for k, v in book.state_dict().items() if k != "draws"}  # type: ignore[attr-defined]
    torch.testing.assert_close(after, before, rtol=1e-6, atol=0)
    assert losses[0]["resets_hand"] == 0 and losses[0]["penalty_hand"] == 0
    for name, parameter in module.net.named_parameters():
        if "hand_encoder" in name or "encoders.hand" in name or "decoders.hand" in name:
            assert (parameter.grad == 0).all(), name


def captioned(present: list[int], columns: Tensor) -> dict[str, Tensor]:
    size = len(present)
    torch.manual_seed(2)
    return batch_of(columns, present) | {
        "conditions": {
            "text": Condition(
                torch.randn(size, 3, 6), torch.ones(size, 3, dtype=torch.bool), torch.randn(size, 6)
            )
        },
        "similarity": torch.eye(size, 6),
    }


@pytest.mark.parametrize("kind", ["tma", "diffusion"])
def test_missing_columns_are_not_reconstructed(kind: str) -> None:
    columns = torch.from_numpy(LAYOUT.part("bodyhand"))
    torch.manual_seed(0)
    module: StageModule
    if kind == "tma":
        net = Tma(TmaConfig(latent=8, ff=8, layers=1, heads=2, dropout=0, attention_dropout=0), 313, 6)
        module, bias = TmaModule(net, OptimConfig(), seed=0, max_steps=1), net.motion_decoder.out.bias
    else:
        denoiser = Mdm(TextDenoiserConfig(dim=8, ff=8, layers=1, heads=2), 313, 6)
        module = TextDenoiserModule(denoiser, OptimConfig(), seed=0, max_steps=1)
        bias = next(p for p in denoiser.parameters() if p.shape == (313,))
    hand = torch.from_numpy(LAYOUT.part("hand"))
    losses, _, _ = trained(module, [captioned([0, 2, 0, 2], columns)])
    assert bias.grad is not None and (bias.grad[hand] == 0).all() and bias.grad[:60].abs().min() > 0
    told = captioned([3, 3, 3, 3], columns)
    whole, _, _ = trained(module, [told])
    del told["present"]
    same(trained(module, [told])[0], whole)
    assert torch.isfinite(losses[0]["loss"]) and losses[0]["loss"] != whole[0]["loss"]


# Every tokenizer kind: shapes, padding, encode/decode contract, freezing, checkpoints, errors.

NET: dict[str, Any] = {"width": 16, "depth": 2, "code_dim": 8, "num_codes": 16}
NETS = {
    "h2vq": H2VQConfig(**NET),
    "vq": VqConfig(**NET),
    "rvq body": RvqConfig(**NET, part="body"),
    "rvq face": RvqConfig(**NET, part="face", levels=3),
    "separate": SeparateConfig(**NET),
    "fsq": FsqConfig(width=16, depth=2, code_dim=8, steps=(4, 4)),
    "mq": MqConfig(**NET, start="data"),
    "tm2t": Tm2tConfig(**NET, start="data"),
    "mq by moving averages": MqConfig(**NET, quantizer="ema"),
}


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


@pytest.fixture(params=list(NETS))
def tokenizer(request: pytest.FixtureRequest) -> Tokenizer:
    net = NETS[request.param].build(LAYOUT)
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
    net = NETS["h2vq"].build(LAYOUT)
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
        H2VQConfig(**NET).build(body)
    with pytest.raises(UserError, match=r"body133.* face"):
        RvqConfig(**NET, part="face").build(body)
    net = VqConfig(**NET, part="body").build(body)
    with pytest.raises(UserError, match=r"body133.*263"):
        net(torch.zeros(1, 8, 263))
    with pytest.raises(UserError, match="multiple of 4"):
        net(torch.zeros(1, 10, 133))
