"""The patch discriminator: padding, condition, spectral norm; its losses against formulas."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from motionloom.models.discriminator.patch import (
    DiscriminatorConfig,
    PatchDiscriminator,
    Validity,
    discriminator_loss,
    generator_loss,
)

SMALL = DiscriminatorConfig(dim=16, heads=4, ff=32, dropout=0.0)


@pytest.fixture(params=[False, True], ids=["plain", "spectral"])
def net(request: pytest.FixtureRequest) -> PatchDiscriminator:
    torch.manual_seed(0)
    config = SMALL.model_copy(update={"spectral_norm": request.param})
    return PatchDiscriminator(config, 5, 6).double().eval()


def test_padded_batch_equals_each_clip_alone(net: PatchDiscriminator) -> None:
    length = torch.tensor([22, 7, 1, 12])
    motion, glob = torch.randn(4, 22, 5).double(), torch.randn(4, 6).double()
    motion[torch.arange(22) >= length[:, None]] = float("nan")
    score, mask = net(motion, glob, length)
    assert score.shape == (4, 6)
    assert mask.sum(1).tolist() == [6, 2, 1, 3]
    assert (score[~mask] == 0).all()
    for row, count in enumerate(length.tolist()):
        alone = net(motion[row : row + 1, :count], glob[row : row + 1], length[row : row + 1]).score[0]
        torch.testing.assert_close(score[row][mask[row]], alone, rtol=1e-10, atol=1e-10)


def test_depends_on_its_condition_and_on_every_frame(net: PatchDiscriminator) -> None:
    motion, glob = torch.randn(1, 16, 5).double().requires_grad_(), torch.randn(1, 6).double()
    score = net(motion, glob, torch.tensor([16])).score
    other = net(motion, glob + 1, torch.tensor([16])).score
    assert (score - other).abs().min() > 1e-6
    score[0, 0].backward()
    assert motion.grad is not None
    assert (motion.grad[0].abs().sum(1) > 0).all()  # the transformer sees all patches


def test_spectral_norm_bounds_every_weight() -> None:
    torch.manual_seed(0)
    net = PatchDiscriminator(SMALL.model_copy(update={"spectral_norm": True}), 5, 6).train()
    for _ in range(100):  # power iterations
        net(torch.randn(2, 16, 5), torch.randn(2, 6), torch.tensor([16, 9]))
    net.eval()
    layers = [m for m in net.modules() if isinstance(m, nn.Linear | nn.Conv1d)]
    assert len(layers) == 3 + 2 * 2 + 2 * 4 + 2
    for layer in layers:
        largest = torch.linalg.svdvals(layer.weight.detach().flatten(1)).max()
        assert largest == pytest.approx(1, abs=0.02)


def test_losses_are_the_formulas() -> None:
    real = Validity(
        torch.tensor([[2.0, 0.5, 9.0], [-1.0, 0.0, 9.0]]), torch.tensor([[1, 1, 0], [1, 0, 0]]) > 0
    )
    fake = Validity(torch.tensor([[-3.0, -0.5, 9.0], [1.0, 0.0, 9.0]]), real.mask)
    values = discriminator_loss(real, fake)
    assert values["real"] == pytest.approx((0 + 0.5 + 2) / 3)
    assert values["fake"] == pytest.approx((0 + 0.5 + 2) / 3)
    assert values["loss"] == pytest.approx(5 / 3)
    assert values["accuracy"] == pytest.approx((2 / 3 + 2 / 3) / 2)
    assert generator_loss(fake) == pytest.approx((3 + 0.5 - 1) / 3)
