"""Optimizers, one and several: rates, turns, counts, a slow loop in plain torch, precision, one graph."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from tiny_adversaries import CRITIC, Duel, Vectors, train
from torch import Tensor, nn

from motionloom.models.training.alternating import OptimizerGroup
from motionloom.models.training.optim import OptimConfig

STEPS = 24


def by_hand(steps: int = STEPS) -> dict[str, Tensor]:
    """The duel of `tiny_adversaries` without dropout, written out in plain torch and float64."""
    duel = Duel(seed=3, max_steps=steps, dropout=0.0).double()
    net, critic = duel.net, duel.critic
    data = Vectors(8, dtype=torch.float64)
    adam = torch.optim.Adam(net.parameters(), lr=0.01, betas=(0.9, 0.99))
    adamw = torch.optim.AdamW(critic.parameters(), lr=0.02, betas=(0.9, 0.99), weight_decay=0.1)
    for step in range(steps):
        x = data[step]["x"]
        made = net(x)
        loss = (made - x).square().mean() + 0.3 * (critic(made) - 1).square().mean()
        grads = torch.autograd.grad(loss, list(net.parameters()))
        norm = torch.stack([g.square().sum() for g in grads]).sum().sqrt()
        for param, grad in zip(net.parameters(), grads, strict=True):
            param.grad = grad * min(1.0, 0.3 / (norm + 1e-6))
        adam.param_groups[0]["lr"] = 0.01 * min(1.0, (step + 1) / 3)
        adam.step()
        if step < 4 or step % 2:
            continue
        adamw.zero_grad()
        judged = (critic(x) - 1).square().mean() + critic(made.detach()).square().mean()
        judged.backward()
        torch.nn.utils.clip_grad_norm_(critic.parameters(), 0.2)
        done = torch.tensor((step - 4) / (steps - 4), dtype=torch.float64)
        adamw.param_groups[0]["lr"] = 0.02 * (0.5 * (1 + torch.cos(torch.pi * done))).item()
        adamw.step()
    return duel.state_dict()


@pytest.mark.parametrize("parts", [1, 2])
def test_equals_the_loop_written_by_hand(parts: int, tmp_path: Path) -> None:
    """Also in parts: the critic's gradient, too, is taken behind the generator's step for all of them."""
    duel = train(tmp_path, module={"dropout": 0.0}, dtype=torch.float64, accumulate=parts, validate_every=0)
    for name, value in by_hand().items():
        torch.testing.assert_close(duel.state_dict()[name], value, rtol=1e-10, atol=1e-12)
    untouched = Duel(seed=3, max_steps=1).unused
    assert torch.equal(duel.unused.float(), untouched), "no gradient: neither a step nor weight decay"


def test_steps_are_counted_once(tmp_path: Path) -> None:
    train(tmp_path, accumulate=2)
    names = [path.name for path in sorted((tmp_path / "checkpoints").iterdir())]
    assert names == ["step=00000018.ckpt", "step=00000024.ckpt"]
    checkpoint = torch.load(tmp_path / "checkpoints" / names[-1], weights_only=True)
    assert checkpoint["global_step"] == STEPS
    assert [max(s["step"].item() for s in o["state"].values()) for o in checkpoint["optimizer_states"]] == [
        24,
        10,
    ]


def test_turns() -> None:
    group = OptimizerGroup("critic", (nn.Linear(2, 2),), OptimConfig(), every=3, start_step=5)
    assert [step for step in range(15) if group.steps_at(step)] == [5, 8, 11, 14]
    over = OptimizerGroup("critic", (nn.Linear(2, 2),), OptimConfig(), every=3, start_step=5, end_step=11)
    assert [step for step in range(15) if over.steps_at(step)] == [5, 8]


def test_drops_multiply_from_their_steps_on() -> None:
    """T2M-GPT's schedule: a warm-up, then 0.05 times the rate from a step on."""
    config = OptimConfig(warmup_steps=4, drop_at=(10, 20), drop_factor=0.05)
    found = [config.factor(step, 100) for step in (0, 3, 9, 10, 19, 20, 99)]
    assert found == pytest.approx([0.25, 1, 1, 0.05, 0.05, 0.0025, 0.0025])
    assert config.factor(10, 100) == config.factor(10, 10_000), "a longer training begins the same"


def test_a_parameter_of_two_players_is_refused() -> None:
    duel = Duel(seed=0, max_steps=1)
    duel.critic = duel.net
    with pytest.raises(ValueError, match="two groups"):
        duel.configure_optimizers()


def test_bfloat16_trains_near_float32(tmp_path: Path) -> None:
    """Weights and gradients stay float32; the backward pass runs outside autocast."""
    full = train(tmp_path / "32", module={"dropout": 0.0})
    half = train(tmp_path / "16", module={"dropout": 0.0}, precision="bf16-mixed")
    for name, value in full.state_dict().items():
        assert half.state_dict()[name].dtype == torch.float32
        # Steps of 24 x lr at most; the two differ by a small share of that.
        torch.testing.assert_close(half.state_dict()[name], value, atol=0.1 * STEPS * CRITIC.lr, rtol=0)
    assert any(not torch.equal(v, full.state_dict()[k]) for k, v in half.state_dict().items())
