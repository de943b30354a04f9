"""TMA in the coordinates of `Basis`: what it reads, what it writes, and clips without hands."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from motionloom.datasets.conditions import Condition
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.tma.losses import reconstruction_loss
from motionloom.models.tma.module import TmaModule
from motionloom.models.tma.network import Tma, TmaConfig
from motionloom.models.training.stage_module import OptimConfig

LAYOUT = MotionLayout.named("wholebody313")
pytestmark = pytest.mark.usefixtures("float64")

HANDS = torch.from_numpy(np.isin(np.arange(313), LAYOUT.part("hand")))
SIZES = {"latent": 16, "ff": 32, "layers": 1, "heads": 2, "dropout": 0.0, "attention_dropout": 0.0}
LENGTH = torch.tensor([12, 7])


def build(stride: int = 1) -> Tma:
    torch.manual_seed(0)
    config = TmaConfig(**SIZES, frame_stride=stride, root_gain=5.0, finger_gain=4.0)
    net = Tma.of_layout(config, LAYOUT, "bodyhand", text_dim=6)
    rng = np.random.default_rng(0)
    assert net.basis is not None
    net.basis.learn(rng.standard_normal(313), rng.uniform(0.1, 2.0, 313))
    return net.eval()


def plain(net: Tma) -> Tma:
    """The same weights without the coordinates."""
    config = TmaConfig(**SIZES, frame_stride=net.config.frame_stride)
    other = Tma(config, 313, 6).eval()
    other.load_state_dict({k: v for k, v in net.state_dict().items() if not k.startswith("basis.")})
    return other


def motion() -> Tensor:
    x = torch.randn(2, 12, 313, generator=torch.Generator().manual_seed(1))
    return x * (torch.arange(12)[None] < LENGTH[:, None])[..., None]


@pytest.mark.parametrize("stride", [1, 3])
@torch.no_grad()
def test_it_is_the_plain_network_between_the_coordinates(stride: int) -> None:
    net, x = build(stride), motion()
    assert net.basis is not None
    seen = net.basis.encode(x)
    assert (seen - x).abs().max() > 1
    mu, logvar = net.encode_motion(x, LENGTH)
    for found, wanted in zip((mu, logvar), plain(net).encode_motion(seen, LENGTH), strict=True):
        torch.testing.assert_close(found, wanted)
    written = plain(net).decode(mu, LENGTH, 12)
    torch.testing.assert_close(net.decode_coordinates(mu, LENGTH, 12), written)
    features = net.decode(mu, LENGTH, 12)
    # Features come rounded to float32; a finger's bone reads that in m over its unit.
    rounding = torch.finfo(torch.float32).eps * features.abs().max() * net.basis.std.max()
    bound = float(rounding / net.basis.unit.min())
    assert bound < 0.01
    torch.testing.assert_close(net.basis.encode(features), written, rtol=0, atol=bound)
    for row, frames in enumerate(-(-LENGTH // stride)):
        assert (features[row, frames:] == 0).all()


@torch.no_grad()
def test_hands_that_a_clip_does_not_hold_say_nothing() -> None:
    net, present = build(), (~HANDS).repeat(2, 1)
    present[1] = True
    one, other = motion(), motion()
    other[0][:, HANDS] = 7.0
    assert (net.coordinates(one, present)[0][:, HANDS] == 0).all()
    for a, b in zip(
        net.encode_motion(one, LENGTH, present), net.encode_motion(other, LENGTH, present), strict=True
    ):
        torch.testing.assert_close(a, b)
    assert (net.encode_motion(one, LENGTH)[0] - net.encode_motion(other, LENGTH)[0]).abs().max() > 1e-3


def test_the_reconstruction_is_judged_in_the_coordinates() -> None:
    net, x, present = build(stride=3), motion(), torch.ones(2, 313, dtype=torch.bool)
    present[0] = ~HANDS
    module = TmaModule(net, OptimConfig(), seed=0, max_steps=1).eval()
    words = torch.randn(2, 4, 6, generator=torch.Generator().manual_seed(2))
    batch = {
        "motion": x, "length": LENGTH,
        "conditions": {"text": Condition(words, torch.ones(2, 4, dtype=torch.bool))},
        "similarity": torch.eye(2), "present": present,
    }  # fmt: skip
    found = module.losses(batch)
    frames = -(-LENGTH // 3)
    mask = torch.arange(4)[None] < frames[:, None]
    assert net.basis is not None
    target = net.basis.encode(x[:, ::3])
    mu, _ = net.encode_motion(x, LENGTH, present)
    wanted = reconstruction_loss(plain(net).decode(mu, LENGTH, 12), target, mask, present)
    torch.testing.assert_close(found["rec_motion"], wanted)
    found["loss"].backward()
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in net.parameters())


def test_gains_need_a_layout_with_fingers() -> None:
    with pytest.raises(ValueError, match=r"Tma\.of_layout"):
        Tma(TmaConfig(finger_gain=4.0), 313, 6)
    assert Tma.of_layout(TmaConfig(**SIZES), LAYOUT, "bodyhand", 6).basis is None
    assert "basis.mean" in build().state_dict(), "how the features were normalised travels with the weights"
