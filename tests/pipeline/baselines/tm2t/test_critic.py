"""The critic of TM2T's tokenizer: both losses against a version in torch's own layers."""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.training.optim import OptimConfig
from motionloom.pipeline.baselines.tm2t.module import AdversarialTokenizerModule, Critic, RankNorm
from motionloom.pipeline.baselines.tm2t.network import CriticConfig
from motionloom.pipeline.baselines.tm2t.tokenizer import Tm2tConfig, Tm2tQuantizer

LAYOUT = MotionLayout.named("h3d263")
BATCH = {
    "motion": torch.randn(4, 16, 263, generator=torch.Generator().manual_seed(0)),
    "length": torch.full((4,), 16),
}


def module(start: int) -> AdversarialTokenizerModule:
    net = Tm2tConfig(width=8, code_dim=8, num_codes=6).build(LAYOUT)
    assert isinstance(net, Tm2tQuantizer)
    critic = CriticConfig(start=start, width=8)
    return AdversarialTokenizerModule(net, OptimConfig(lr=3e-3), seed=0, max_steps=40, critic=critic)


def plain(critic: Critic) -> nn.Sequential:
    """The same network in torch's own layers."""
    layers: list[nn.Module] = []
    for down, norm in zip(critic.down, critic.norms, strict=True):
        own = nn.BatchNorm1d(down.out_channels)
        own.weight, own.bias = norm.scale, norm.shift
        layers += [down, own, nn.LeakyReLU(0.2)]
    return nn.Sequential(*layers, critic.out)


def test_losses_equal_those_of_plain_layers() -> None:
    torch.manual_seed(1)
    both = module(start=0)
    second = plain(both.critic)
    shared: dict[str, torch.Tensor] = {}
    values = both.losses_of("tokenizer", BATCH, shared)
    real, made = (shared[name].transpose(1, 2) for name in ("motion", "made"))
    torch.testing.assert_close(values["adversarial"], -second(made).mean())
    l1 = functional.l1_loss(made, real)
    torch.testing.assert_close(values["loss"], l1 + values["commit"] - 0.5 * second(made).mean())
    judged = both.losses_of("critic", BATCH, {name: value.detach() for name, value in shared.items()})
    hinge = functional.relu(1 - second(real)).mean() + functional.relu(1 + second(made)).mean()
    torch.testing.assert_close(judged["loss"], 0.5 * hinge)


def test_normalisation_is_torchs_with_its_running_statistics() -> None:
    torch.manual_seed(3)
    own, second = RankNorm(5), nn.BatchNorm1d(5)
    there = torch.ones(4, 1, 6, dtype=torch.bool)
    for _ in range(3):
        x = 2 * torch.randn(4, 5, 6) + 1
        torch.testing.assert_close(own(x, there), second(x))
    assert second.running_mean is not None and second.running_var is not None
    torch.testing.assert_close(own.mean, second.running_mean)
    torch.testing.assert_close(own.var, second.running_var)
    torch.testing.assert_close(own.eval()(x, there), second.eval()(x))


def test_padding_of_a_window_plays_no_part() -> None:
    """Clips of 12 frames give in windows of 16 what they give alone."""
    alone, padded = (module(start=0) for _ in range(2))
    padded.load_state_dict(alone.state_dict())
    short = {"motion": BATCH["motion"][:, :12], "length": torch.full((4,), 12)}
    shown = {"motion": functional.pad(short["motion"], (0, 0, 0, 4)), "length": short["length"]}
    shared: tuple[dict[str, torch.Tensor], ...] = ({}, {})
    for group in ("tokenizer", "critic"):
        one = alone.losses_of(group, short, shared[0])
        torch.testing.assert_close(padded.losses_of(group, shown, shared[1]), one)
