"""Bailando: masks, losses, rewards and the way on against slow versions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from motionloom.datasets.conditions import Condition
from motionloom.models.metrics.dance_beats import motion_beats
from motionloom.models.training.optim import OptimConfig
from motionloom.pipeline.baselines.bailando.codes import DanceVq, DanceVqConfig
from motionloom.pipeline.baselines.bailando.module import (
    ActorCriticModule,
    CrossGptModule,
    beat_rewards,
    codes_of,
    moving_error,
    td_error,
)
from motionloom.pipeline.baselines.bailando.network import (
    ActorCritic,
    CrossGpt,
    CrossGptConfig,
    RewardConfig,
    music_of_codes,
    tiled_causal,
)

OPTIM = OptimConfig(optimizer="adam", lr=3e-3)
CODES: dict[str, Any] = {"width": 16, "depth": 1, "code_dim": 8, "halvings": 2, "num_codes": 12}
GPT: dict[str, Any] = {"dim": 16, "heads": 2, "ff": 32, "layers": 1, "dropout": 0.0}


def small_vq() -> DanceVq:
    torch.manual_seed(0)
    vq = DanceVq(DanceVqConfig(**CODES), 22)
    for half in (vq.up, vq.down):
        nn.init.normal_(half.quantizer.codebook)
    return vq.eval()


def small_gpt(context: int = 5) -> CrossGpt:
    torch.manual_seed(0)
    return CrossGpt(CrossGptConfig(**GPT, context=context), 12, 3).eval()


def test_the_root_is_taken_from_poses_and_put_back_by_steps() -> None:
    vq, joints = small_vq(), torch.randn(2, 16, 22, 3)
    moved = joints + torch.randn(2, 16, 1, 3)
    codes = vq.encode(joints)
    assert codes.shape == (2, 4, 2) and torch.equal(codes, vq.encode(moved))
    made, steps = vq.decode(codes), vq.steps(codes[..., 1])
    assert made.shape == joints.shape and not made[:, 0, 0].any()
    for frame in range(1, 16):
        torch.testing.assert_close(made[:, frame, 0] - made[:, frame - 1, 0], steps[:, frame - 1])
    poses, out = vq.poses(made), vq(joints)
    torch.testing.assert_close(poses["up"], out["up"].reconstruction, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(
        poses["down"][..., 3:], out["down"].reconstruction[..., 3:], rtol=1e-4, atol=1e-5
    )


def test_errors_of_places_steps_and_steps_of_steps() -> None:
    made, true = torch.randn(2, 7, 3, dtype=torch.float64), torch.randn(2, 7, 3, dtype=torch.float64)
    rate = [np.abs(np.diff((made - true).float().numpy(), n=n, axis=1)).mean() for n in range(3)]
    found = moving_error(made, true, 2.0, 3.0)
    assert float(found) == pytest.approx(rate[0] + 2 * rate[1] + 3 * rate[2], rel=1e-5)


def test_dancing_slides_along() -> None:
    gpt, first, music = small_gpt(context=3), torch.randint(12, (2, 1, 2)), torch.randn(2, 9, 3)
    made = gpt.dance(first, music)
    assert made.shape == (2, 9, 2) and torch.equal(made[:, :1], first)
    for row in range(2):
        codes = first[row]
        for at in range(1, 9):
            begin = max(0, at - 3)
            logits = gpt(codes[None, begin:], music[row : row + 1, begin + 1 : at + 1])
            codes = torch.cat([codes, logits[0, -1].argmax(-1)[None]])
        assert torch.equal(made[row], codes)
    assert not torch.equal(gpt.dance(first, music, temperature=5.0), made)
    assert torch.equal(gpt.dance(made, music[:, :4]), made[:, :4])


def test_music_of_codes_is_the_mean_of_their_frames() -> None:
    music = torch.randn(2, 7, 3)
    found = music_of_codes(music, 4)
    torch.testing.assert_close(found[:, 0], music[:, :4].mean(1))
    torch.testing.assert_close(found[:, 1], music[:, 4:].sum(1) / 4)  # the end is silence, which is 0
    assert not music_of_codes(music, 4, 3)[:, 2].any()


def dances(rows: int = 8, frames: int = 24) -> dict[str, Any]:
    """Poses that turn at the speed that the music says, and a beat in every second code."""
    speed = torch.randint(1, 4, (rows, 1, 1)).float()
    angle = 0.3 * speed * torch.arange(frames)[None, :, None] + torch.linspace(0, 6, 66)
    heard = torch.ones(rows, frames, dtype=torch.bool)
    return {
        "motion": angle.sin(),
        "length": torch.full((rows,), frames),
        "beats": (torch.arange(frames) % 8 == 2).expand(rows, -1),
        "conditions": {"audio": Condition(speed.expand(-1, frames, 3), heard)},
    }


def test_the_loss_is_the_cross_entropy_of_both_halves() -> None:
    vq, gpt, given = small_vq(), small_gpt(), dances()
    given["conditions"]["audio"].mask[2] = False
    found = CrossGptModule(gpt, OPTIM, seed=0, max_steps=1, vq=vq).eval().losses(given)
    codes, music, _ = codes_of(gpt, vq, given)
    total, hits = 0.0, 0.0
    for row in (0, 1, 3, 4, 5, 6, 7):
        chances = gpt(codes[row : row + 1, :-1], music[row : row + 1, 1:])[0].log_softmax(-1)
        for at in range(5):
            total -= sum(float(chances[at, half, codes[row, at + 1, half]]) for half in range(2))
            hits += float(chances[at, 0].argmax() == codes[row, at + 1, 0])
    assert float(found["loss"]) == pytest.approx(total / 35, rel=1e-4)
    assert float(found["accuracy_up"]) == pytest.approx(hits / 35)


def test_rewards_and_errors_of_the_critic_against_loops() -> None:
    rng = np.random.default_rng(0)
    joints, beats = rng.normal(size=(24, 22, 3)).cumsum(0), rng.random(24) < 0.2
    danced = {round(time * 20) for time in motion_beats(joints, 20.0)}
    found = beat_rewards(joints, beats, 20.0, 4, 10.0)
    for code in range(6):
        frames = range(4 * code, 4 * code + 4)
        both = any(frame in danced for frame in frames) and any(beats[frame] for frame in frames)
        assert found[code] == (5.0 if both else -5.0)
    assert set(found) == {-5.0, 5.0}


@pytest.mark.parametrize("contexts", [1, 3])
def test_actor_and_critic_learn_as_published(contexts: int) -> None:
    """Against the published step, written out: frozen states, one value and one error for both halves."""
    net, frames = ActorCritic(small_gpt(), 1), 4 * (5 * contexts + 1)
    module = ActorCriticModule(
        net, OPTIM, seed=0, max_steps=1, vq=small_vq(), fps=20.0, reward=RewardConfig(discount=0.9)
    ).train()
    given = dances(frames=frames)
    sound, mask = torch.randn(8, frames, 3), torch.ones(8, frames, dtype=torch.bool)
    given["conditions"]["audio"] = Condition(sound, mask)
    shared: dict[str, Any] = {}
    found = {group: module.losses_of(group, given, shared)["loss"] for group in ("actor", "critic")}
    codes, music = shared["codes"], shared["music"]
    assert codes.shape == (8, 6, 2)
    true, heard, _ = codes_of(net.gpt, module.vq.module, given)
    danced = net.gpt.eval().dance(true[:, :1], heard)
    actor, count, errors = 0.0, 0, []
    for row in range(8):
        starts = range(len(danced[row]) - 5)
        [begin] = [at for at in starts if torch.equal(heard[row, at : at + 6], music[row])]
        assert torch.equal(danced[row, begin : begin + 6], codes[row])
        joints = module.vq.module.decode(codes[row : row + 1, 1:-1]).detach()[0]
        beats = given["beats"][row, 4 * (begin + 1) : 4 * (begin + 5)].numpy()
        reward = beat_rewards((joints - joints[:, :1]).numpy(), beats, 20.0, 4, 10.0)
        states = net.gpt.states(codes[row : row + 1, :-1], music[row : row + 1, 1:])
        values = net.critic(states, tiled_causal(5, states.device))[0].sum(1)
        chances = net.gpt.logits(states)[0].log_softmax(-1)
        for at in range(4):
            error = float(reward[at] + 0.9 * values[at + 1] - values[at])
            errors.append(error**2)
            if begin == 0 or at == 3:
                actor -= error * sum(float(chances[at, half, codes[row, at + 1, half]]) for half in range(2))
                count += 1
    assert float(found["actor"]) == pytest.approx(actor / count, rel=1e-4)
    assert float(found["critic"]) == pytest.approx(sum(errors) / len(errors), rel=1e-4)
    # Only the last layers and the critic learn, and what follows is no more than a target.
    gpt = net.gpt
    trained = {*gpt.head.parameters(), *gpt.out.parameters(), *net.critic.parameters()}
    (found["actor"] + found["critic"]).backward()
    assert {weight for weight in net.parameters() if weight.grad is not None} == trained
    values = torch.randn(2, 4, requires_grad=True)
    td_error(torch.randn(2, 3), values, 0.9).sum().backward()
    torch.testing.assert_close(values.grad, torch.tensor([-1.0, -1.0, -1.0, 0.0]).expand(2, 4))


def test_actor_and_critic_take_turns() -> None:
    net = ActorCritic(small_gpt(), 1)
    module = ActorCriticModule(
        net, OPTIM, seed=0, max_steps=1, vq=small_vq(), fps=20.0,
        reward=RewardConfig(actor_steps=2, critic_steps=3),
    )  # fmt: skip
    actor, critic = module.optimizer_groups()
    assert [actor.steps_at(step) for step in range(7)] == [True, True, False, False, False, True, True]
    assert all(actor.steps_at(step) != critic.steps_at(step) for step in range(10))
