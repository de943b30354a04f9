"""MotionDiffuse: linear attention beside a slow version, what starts at nothing, and its loss."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from motionloom.datasets.conditions import Condition
from motionloom.models.diffusion.module import DenoiserModule
from motionloom.models.training.stage_module import OptimConfig
from motionloom.pipeline.baselines.motiondiffuse.network import (
    CaptionConfig,
    MotionDiffuse,
    MotionDiffuseConfig,
    Stylization,
    linear_attention,
)
from motionloom.pipeline.baselines.motiondiffuse.stage import sample_motions

SMALL = MotionDiffuseConfig(
    dim=16, layers=1, heads=2, ff=16, caption=CaptionConfig(dim=8, layers=1, heads=2, ff=8)
)


def small() -> MotionDiffuse:
    """With weights that let everything through, in float64."""
    torch.manual_seed(0)
    net = MotionDiffuse(SMALL, 5, 7, max_frames=20)
    for parameter in net.parameters():
        nn.init.normal_(parameter, std=0.4)
    return net.double().eval()


def words(length: list[int], width: int = 7) -> Condition:
    mask = torch.arange(max(length)) < torch.tensor(length)[:, None]
    return Condition(torch.randn(*mask.shape, width).double() * mask[..., None], mask)


def test_linear_attention_beside_a_slow_one() -> None:
    torch.manual_seed(0)
    query, key, value = torch.randn(3, 2, 2, 6, 4, dtype=torch.float64).unbind()
    mask = torch.tensor([[True] * 6, [True, True, True, False, True, False]])
    found = linear_attention(query, key, value, mask)
    for b, h, t, d in torch.cartesian_prod(*(torch.arange(n) for n in query.shape)).tolist():
        seen = [s for s in range(6) if mask[b, s]]
        total = 0.0
        for c in range(4):
            share = query[b, h, t, c].exp() / query[b, h, t].exp().sum()
            below = sum(key[b, h, s, c].exp() for s in seen)
            total += share * sum(key[b, h, s, c].exp() / below * value[b, h, s, d] for s in seen)
        assert float(found[b, h, t, d]) == pytest.approx(float(total), rel=1e-12)


def test_stylization() -> None:
    torch.manual_seed(0)
    block, x, style = (
        Stylization(4, 6, 0.0).double(),
        torch.randn(2, 3, 4).double(),
        torch.randn(2, 6).double(),
    )
    assert (block(x, style) == 0).all(), "it adds nothing at first"
    nn.init.normal_(block.out[2].weight)
    scale, shift = (nn.functional.silu(style) @ block.modulate[1].weight.T + block.modulate[1].bias).chunk(
        2, 1
    )
    normal = (x - x.mean(2, keepdim=True)) / (x.var(2, correction=0, keepdim=True) + 1e-5).sqrt()
    wanted = nn.functional.silu(normal * (1 + scale[:, None]) + shift[:, None]) @ block.out[2].weight.T
    torch.testing.assert_close(block(x, style), wanted)


@pytest.mark.usefixtures("float64")
def test_padding_of_frames_and_captions_plays_no_part() -> None:
    net, text, x, step = small(), words([4, 2]), torch.randn(2, 9, 5), torch.tensor([30, 800])
    mask = torch.arange(9) < torch.tensor([[9], [5]])
    found = net(x, step, text, mask)
    alone = Condition(text.features[1:, :2], text.mask[1:, :2])
    torch.testing.assert_close(found[1:, :5], net(x[1:, :5], step[1:], alone, mask[1:, :5]))
    assert (found[1, 5:] == 0).all()
    other = net(x[1:, :5], step[1:], words([2]), mask[1:, :5])
    assert (other - found[1:, :5]).abs().max() > 1e-3, "another caption, another answer"


def test_the_loss_is_a_mean_over_frames() -> None:
    """Of two clips of 6 and 2 frames the first counts three times as much."""
    torch.manual_seed(0)
    net = MotionDiffuse(SMALL, 5, 7)
    module = DenoiserModule(net, OptimConfig(), seed=0, max_steps=1)
    text = Condition(torch.zeros(2, 1, 7), torch.ones(2, 1, dtype=torch.bool))
    batch = {"motion": torch.zeros(2, 6, 5), "length": torch.tensor([6, 2]), "conditions": {"text": text}}
    torch.manual_seed(1)
    loss = float(module.losses(batch)["loss"].detach())
    torch.manual_seed(1)
    torch.randint(0, 1000, (2,))
    noise = torch.randn(2, 6, 5)  # the untrained network says 0
    assert loss == pytest.approx(float(torch.cat([noise[0], noise[1, :2]]).square().mean()), rel=1e-6)


@pytest.mark.parametrize("sampler", ["ddpm", "ddim", "dpm++"])
def test_a_motion_does_not_depend_on_its_batch(sampler: str) -> None:
    net, text = small().float(), words([3, 1, 2])
    text = Condition(text.features.float(), text.mask)
    options = {"sampler": sampler, "steps": 4}
    together = sample_motions(net, text, [8, 12, 8], seeds=[4, 5, 6], **options)  # type: ignore[arg-type]
    for row, frames in enumerate([8, 12, 8]):
        own = Condition(text.features[row : row + 1], text.mask[row : row + 1])
        alone = sample_motions(net, own, [frames], seeds=[4 + row], **options)  # type: ignore[arg-type]
        torch.testing.assert_close(together[row], alone[0], atol=1e-3, rtol=1e-3)
