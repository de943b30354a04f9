"""L_align on the model's own samples: the reward, its gradient, and that a model learns what is rewarded."""

from __future__ import annotations

from typing import Any

import pytest
import torch
import torch.nn.functional as F
from toy_gpt import aligned_gpt, sequences

from motionloom.models.gpt.module import GptModule
from motionloom.models.gpt.samples import Samples, log_likelihood, policy_loss, rewards, sample
from motionloom.models.gpt.tokens import interleave

COUNT = 2


@pytest.fixture
def module() -> GptModule:
    loss = {"align_on": "samples", "samples": COUNT, "align_weight": 0.5}
    return aligned_gpt(loss=loss, block_size=18, dropout=0.3, pkeep=0.9)[0]


def batch_of(module: GptModule) -> dict[str, Any]:
    sequence, text = sequences([4, 2, 3], module.net)
    return {**sequence._asdict(), "text": text}


def parts(module: GptModule) -> dict[str, Any]:
    assert module.tokenizer is not None and module.tma is not None
    return {"tokenizer": module.tokenizer.module, "tma": module.tma.module, "temperature": 0.1}


@pytest.mark.usefixtures("float64")
def test_rewards_are_the_motions_half_of_infonce(module: GptModule) -> None:
    """One sample at a time, by hand; a caption that says the same is no rival, the caption itself stays."""
    text = batch_of(module)["text"]
    sentence = F.normalize(torch.tensor([[1.0, 0.0], [0.0, 1.0], [1.0, 0.1]]), dim=-1)
    drawn = sample(module.net, text, COUNT)
    one = parts(module)
    found = rewards(drawn.codes, text, sentence, threshold=0.85, **one)
    for row in range(3 * COUNT):
        groups = int(drawn.codes.groups[row])
        size = {name: groups * module.net.pattern.count(name) for name in module.net.names}
        codes = {name: values[row : row + 1, : size[name]] for name, values in drawn.codes.codes.items()}
        frames = torch.tensor([4 * groups])
        latent, _ = one["tma"].encode_motion(one["tokenizer"].decode(codes, frames), frames)
        near = torch.cosine_similarity(text, latent) / 0.1
        own = row // COUNT
        rivals = [k for k in range(3) if k == own or {k, own} != {0, 2}]
        wanted = near[own] - torch.logsumexp(near[rivals], 0)
        assert found[row].item() == pytest.approx(wanted.item(), abs=1e-4)


def test_gradient_is_that_of_the_expected_reward(module: GptModule) -> None:
    """Against the exact gradient: every motion of one group, weighed by its probability. An open sequence of
    one group has 9 * 9 * 9 possibilities; the reward counts how many of its codes are 3."""
    net, text = module.net.eval(), torch.randn(1, 16)
    every = torch.cartesian_prod(*[torch.arange(9)] * 3)
    codes = {"body": every[:, :2], "hand": every[:, 2:]}
    sequence = interleave(codes, net.pattern)
    reward = (every == 3).sum(1).float()

    def gradient(loss: torch.Tensor) -> torch.Tensor:
        return torch.autograd.grad(loss, [net.text_in.weight])[0]

    everything = Samples(text.expand(729, -1), None, sequence)  # type: ignore[arg-type]
    likelihood, _ = log_likelihood(net, everything)
    exact = gradient(-(likelihood.sum(1).exp() * reward).sum())
    with torch.no_grad():
        chance = likelihood.sum(1).exp()
    torch.testing.assert_close(chance.sum(), torch.tensor(1.0))
    chosen = torch.multinomial(chance, 20_000, replacement=True, generator=torch.Generator().manual_seed(2))
    drawn = Samples(text.expand(20_000, -1), None, type(sequence)(*(x[chosen] for x in sequence)))  # type: ignore[arg-type]
    found = gradient(policy_loss(reward[chosen], *log_likelihood(net, drawn), 20_000))
    # A token's mean, so a third of the motion's sum.
    assert F.cosine_similarity(found.flatten(), exact.flatten(), dim=0) > 0.97
    assert (3 * found).norm() == pytest.approx(exact.norm().item(), rel=0.1)


def test_equal_rewards_teach_nothing(module: GptModule) -> None:
    drawn = sample(module.net, batch_of(module)["text"], COUNT)
    reward = torch.tensor([-1.0, -1.0, -0.2, -0.2, -3.0, -3.0])
    loss = policy_loss(reward, *log_likelihood(module.net, drawn), COUNT)
    assert loss.item() == pytest.approx(1.4)
    loss.backward()
    assert all(p.grad is None or p.grad.abs().max() == 0 for p in module.net.parameters())


def test_only_draws_count(module: GptModule) -> None:
    """Not the hand's End, which the body's decides, not the End behind the longest motion, not padding, and
    not the hands of a clip that has none."""
    net = module.net
    assert net.max_groups == 5
    codes = {name: torch.zeros(2, 5 * net.pattern.count(name), dtype=torch.int64) for name in net.names}
    sequence = interleave(codes, net.pattern, ends=net.num_codes, groups=torch.tensor([5, 2]))
    both = Samples(torch.randn(2, 16), None, sequence)  # type: ignore[arg-type]
    assert log_likelihood(net, both)[1].sum(1).tolist() == [15, 7]
    lacking = torch.tensor([[False, True], [False, False]])
    assert log_likelihood(net, both, lacking)[1].sum(1).tolist() == [10, 7]


def test_loss_adds_the_weighted_alignment_and_leaves_the_mode(module: GptModule) -> None:
    batch = batch_of(module)
    for training in (True, False):
        module.train(training)
        values = module.losses(batch)
        expected = values["ce"] + 0.5 * values["align"]
        torch.testing.assert_close(values["loss"], expected)
        assert module.net.training == training
    again = [module.train().losses(batch)["align"].item() for _ in range(2) if torch.manual_seed(5)]
    assert again[0] == again[1], "draws follow torch's seed, which every step sets"
