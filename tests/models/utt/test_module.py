"""Training of MATE and UTT: the adversarial weight, both groups, gradients."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from motionloom.datasets.conditions import Condition
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.condition.mate import MateConfig
from motionloom.models.discriminator.patch import AdversarialConfig, DiscriminatorConfig, generator_loss
from motionloom.models.gpt.tokens import interleave
from motionloom.models.tokenizer.base import Tokenizer
from motionloom.models.tokenizer.body_hand import H2VQConfig
from motionloom.models.tokenizer.single import MqConfig
from motionloom.models.training.optim import OptimConfig
from motionloom.models.utt.module import UttModule
from motionloom.models.utt.network import ConditionedUtt, UttConfig, UttLossConfig
from motionloom.pipeline.training.utilization import pass_flops

# ---- the weight


def test_the_adversarial_weight_starts_and_rises() -> None:
    ramp = UttLossConfig(adversarial=AdversarialConfig(weight=0.4), adversarial_start=10, adversarial_ramp=4)
    assert [ramp.weight(step) for step in range(8, 17)] == pytest.approx(
        [0, 0, 0.1, 0.2, 0.3, 0.4, 0.4, 0.4, 0.4]
    )
    at_once = UttLossConfig(adversarial=AdversarialConfig(weight=0.4), adversarial_start=3)
    assert [at_once.weight(step) for step in range(5)] == [0, 0, 0, 0.4, 0.4]
    assert UttLossConfig(adversarial=AdversarialConfig(weight=0)).weight(10**6) == 0


# ---- both groups

SMALL = DiscriminatorConfig(dim=8, ff=8, heads=2, layers=1, dropout=0.0)
LAYOUT = {"mq": "smpl75", "h2vq": "wholebody313"}


def toy_tokenizer(kind: str) -> Tokenizer:
    small = {"width": 8, "depth": 1, "code_dim": 8, "num_codes": 9}
    config = MqConfig(**small) if kind == "mq" else H2VQConfig(**small)
    made = config.build(MotionLayout.named(LAYOUT[kind]))
    for book in made.codebooks().values():
        nn.init.normal_(book.codebook)
    return made


def toy_module(kind: str = "mq", *, loss: dict[str, Any] | None = None, **net: Any) -> UttModule:
    torch.manual_seed(0)
    tokenizer = toy_tokenizer(kind)
    given = {"layers": 1, "dim": 16, "heads": 2, "ff": 16, "block_size": 24, "dropout": 0.0,
             "attention_dropout": 0.0, "z_dim": 2, "condition_dropout": 0.0, **net}  # fmt: skip
    mate = MateConfig(dim=8, layers=1, heads=2, ff=8, dropout=0.0, attention_dropout=0.0)
    streams, pattern = tokenizer.streams, tokenizer.pattern
    widths = {"text": 4, "audio": 3}
    conditioned = ConditionedUtt(mate, UttConfig(**given), widths, streams, pattern, timed=["audio"])
    config = UttLossConfig.parse({"discriminator": SMALL.dump(), **(loss or {})}, "loss")
    optim = OptimConfig(optimizer="adam")
    return UttModule(conditioned, optim, seed=0, max_steps=100, tokenizer=tokenizer, loss=config)


def toy_batch(module: UttModule, frames: int = 20) -> dict[str, Any]:
    generator = torch.Generator().manual_seed(1)
    dim = module.tokenizer.module.dim
    audio = torch.tensor([0, 1, 1, 0], dtype=torch.bool)[:, None] & (torch.arange(frames) < 16)
    text = torch.tensor([1, 0, 1, 0], dtype=torch.bool)[:, None].expand(-1, 3)
    return {
        "motion": torch.randn(4, frames, dim, generator=generator),
        "length": torch.tensor([20, 16, 8, 13]),
        "closed": torch.tensor([True, False, True, False]),
        "present": torch.ones(4, dim, dtype=torch.bool),
        "conditions": {
            "text": Condition(torch.randn(4, 3, 4, generator=generator), text),
            "audio": Condition(torch.randn(4, frames, 3, generator=generator), audio),
        },
    }


def test_tokens_are_those_of_the_frozen_tokenizer() -> None:
    module = toy_module("h2vq")
    batch = toy_batch(module)
    tokens, _, length = module.sequences(batch)
    tokenizer = module.tokenizer.module
    whole = len(tokenizer.pattern)
    assert length.tolist() == [5 * whole + 2, 4 * whole, 2 * whole + 2, 3 * whole]
    for row, groups in enumerate([5, 4, 2, 3]):
        motion = batch["motion"][row : row + 1, : 4 * groups]
        alone = tokenizer.encode(motion, torch.tensor([4 * groups]), batch["present"][row : row + 1])
        expected = interleave(alone, tokenizer.pattern).tokens[0]
        assert torch.equal(tokens[row, : groups * whole], expected)
    assert not any("tokenizer" in name for name in module.state_dict())
    assert not any(p.requires_grad for p in tokenizer.parameters())


def grads(module: nn.Module) -> dict[str, float]:
    return {
        name: 0.0 if p.grad is None else float(p.grad.abs().sum()) for name, p in module.named_parameters()
    }


def test_codes_of_hands_that_a_clip_lacks_teach_nothing() -> None:
    module = toy_module("h2vq")
    batch = toy_batch(module)
    batch["present"][:, module.tokenizer.module.hand_columns] = False
    module.losses_of("tokens", batch, {})["ce"].backward()
    body, hand = (head.weight.grad.abs().max() for head in module.net.utt.heads)
    assert hand == 0 < body
    # Where one stream says all, such a clip says nothing.
    module = toy_module("mq")
    batch = toy_batch(module)
    batch["present"][:, -1] = False
    assert module.losses_of("tokens", batch, {})["ce"] == 0


@pytest.mark.parametrize("kind", ["mq", "h2vq"])
def test_the_generators_loss_moves_mate_and_utt_and_not_the_critic(kind: str) -> None:
    module = toy_module(kind, loss={"adversarial": {"weight": 0.5, "sample": False}})
    assert module.discriminator is not None
    batch, shared = toy_batch(module), {}
    module.discriminator.requires_grad_(False)  # as `AlternatingModule` does in this turn
    values = module.losses_of("tokens", batch, shared)
    assert values.keys() >= {"loss", "ce", "adversarial"} | {f"accuracy_{n}" for n in module.net.utt.names}
    torch.testing.assert_close(values["loss"], values["ce"] + 0.5 * values["adversarial"])
    assert set(shared) == {"motion", "length", "glob"}
    torch.testing.assert_close(
        values["adversarial"],
        generator_loss(module.discriminator(shared["motion"], shared["glob"], shared["length"])),
    )
    values["adversarial"].backward()
    reached = grads(module.net)
    assert reached["mate.aggregate"] > 0 and reached["mate.project.text.weight"] > 0
    assert reached["mate.project.audio.weight"] > 0 and reached["utt.condition_in.weight"] > 0
    assert reached["utt.start"] > 0 and any(v > 0 for n, v in reached.items() if "backbone" in n)
    assert set(grads(module.discriminator).values()) == {0.0}
    assert set(grads(module.tokenizer.module).values()) == {0.0}


def test_the_critics_loss_moves_the_critic_alone() -> None:
    module = toy_module(loss={"adversarial": {"weight": 0.5}})
    assert module.discriminator is not None
    batch, shared = toy_batch(module), {}
    module.losses_of("tokens", batch, shared)
    values = module.losses_of("critic", batch, shared)  # also with what still has its gradient
    assert set(values) == {"loss", "real", "fake", "accuracy"}
    values["loss"].backward()
    assert set(grads(module.net).values()) == {0.0}
    moved = grads(module.discriminator)
    assert all(value > 0 for name, value in moved.items() if not name.endswith("bias")), moved
    assert set(grads(module.tokenizer.module).values()) == {0.0}


def test_the_critic_judges_real_frames_of_the_same_length() -> None:
    """What lies behind a row's whole groups changes nothing of what it says."""
    module = toy_module(loss={"adversarial": {"weight": 0.5, "sample": False}}).eval()
    batch = toy_batch(module)
    shared: dict[str, Tensor] = {}
    module.losses_of("tokens", batch, shared)
    assert shared["length"].tolist() == [20, 16, 8, 12]
    other = {**batch, "motion": batch["motion"].clone()}
    for row, length in enumerate([20, 16, 8, 12]):
        other["motion"][row, length:] = 99.0
    for name, value in module.losses_of("critic", batch, shared).items():
        torch.testing.assert_close(module.losses_of("critic", other, shared)[name], value)


def test_turns_begin_with_the_adversarial_term() -> None:
    module = toy_module(loss={"adversarial": {"weight": 0.5}, "adversarial_start": 7})
    tokens, critic = module.optimizer_groups()
    assert tokens.steps_at(0) and not critic.steps_at(6) and critic.steps_at(7) and critic.steps_at(8)
    shared: dict[str, Tensor] = {}
    values = module.losses_of("tokens", toy_batch(module), shared)
    assert "adversarial" not in values and not shared
    torch.testing.assert_close(values["loss"], values["ce"])
    at_once = toy_module(loss={"adversarial": {"weight": 0.5}})
    assert pass_flops(module, toy_batch(module)) == pass_flops(at_once, toy_batch(at_once))
    module.eval()  # in validation the figure is there, and not in the loss
    values = module.losses(toy_batch(module))
    assert {"tokens_adversarial", "critic_loss", "critic_accuracy"} <= set(values)
    torch.testing.assert_close(values["loss"], values["tokens_ce"])


def test_without_the_term_there_is_no_critic() -> None:
    module = toy_module(loss={"adversarial": {"weight": 0.0}})
    assert module.discriminator is None and [p.name for p in module.optimizer_groups()] == ["tokens"]
    assert not any("discriminator" in name for name in module.state_dict())
    values = module.losses(toy_batch(module))
    assert set(values) == {"loss", "tokens_loss", "tokens_ce", "tokens_accuracy_code"}


def test_corrupted_inputs_keep_their_targets() -> None:
    module = toy_module(pkeep=0.01, z_dim=0, loss={"adversarial": {"weight": 0.0}})
    seen = {}
    forward = module.net.utt.forward

    def spy(tokens: Tensor, *args: Any, **options: Any) -> Tensor:
        seen["tokens"], seen["inputs"] = tokens, options["inputs"]
        return forward(tokens, *args, **options)

    module.net.utt.forward = spy  # type: ignore[method-assign]
    batch = toy_batch(module)
    module.losses_of("tokens", batch, {})
    tokens = module.sequences(batch).tokens
    assert torch.equal(seen["tokens"], tokens)
    special = (tokens == -1) | (tokens == 9)
    assert torch.equal(seen["inputs"][special], tokens[special])
    assert (seen["inputs"] != tokens)[~special].float().mean() > 0.5
    module.eval()
    module.losses_of("tokens", batch, {})
    assert seen["inputs"] is None
