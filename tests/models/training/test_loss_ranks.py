"""Losses of UDE and of the evaluator on two ranks equal those of one process, values and gradients alike.

Two gloo processes with half of the batch each, whose rows have different numbers of real frames and tokens,
under DDP, against one process with the whole batch: means over ranks of all figures and the gradients of the
discriminator, of MATE + UTT (with the adversarial term and rows without conditions), of the DMD and of both
parts of the evaluator. Networks are float64; noise and time steps are given, nothing is drawn.

The processes run this file as a script.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from two_ranks import run_two_ranks

from motionloom.datasets.conditions import Condition
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.condition.mate import Mate, MateConfig
from motionloom.models.diffusion.dmd import Dmd, DmdConfig, dmd_loss
from motionloom.models.discriminator.losses import discriminator_loss, generator_loss, gradient_penalty
from motionloom.models.discriminator.patch import DiscriminatorConfig, PatchDiscriminator
from motionloom.models.evaluator.module import EvaluatorModule
from motionloom.models.evaluator.network import Evaluator, EvaluatorConfig
from motionloom.models.gpt.frozen import Frozen
from motionloom.models.gpt.losses import cross_entropy, soft_motion
from motionloom.models.gpt.tokens import interleave
from motionloom.models.tokenizer.build import build_tokenizer
from motionloom.models.tokenizer.config import MqConfig
from motionloom.models.training.distributed import rank, world_size
from motionloom.models.training.optim import OptimConfig
from motionloom.models.utt.network import Utt, UttConfig

BATCH, GROUPS = 6, torch.tensor([5, 5, 4, 1, 2, 1])
FRAMES = GROUPS * 4 - torch.tensor([0, 1, 2, 0, 3, 1])
Rows = Callable[[Tensor], Tensor]


def numbers(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(BATCH, *shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def codes() -> Tensor:
    return torch.randint(9, (BATCH, 5), generator=torch.Generator().manual_seed(0))


class Generator(nn.Module):
    """MATE and UTT with the frozen critic and tokenizer behind them."""

    def __init__(self) -> None:
        super().__init__()
        self.mate = Mate(MateConfig(dim=8, layers=1, heads=2, ff=8), {"text": 3, "audio": 4}, timed=["audio"])
        tokenizer = build_tokenizer(MqConfig(width=8, code_dim=8, num_codes=9), MotionLayout.named("smpl75"))
        nn.init.normal_(tokenizer.codebooks()["code"].codebook)
        config = UttConfig(layers=1, dim=8, heads=2, ff=8, block_size=8, z_dim=2)
        self.utt = Utt(config, tokenizer.streams, tokenizer.pattern, 8)
        critic = PatchDiscriminator(DiscriminatorConfig(dim=8, heads=2, ff=8), 75, 8)
        self.tokenizer, self.critic = Frozen(tokenizer.double().freeze()), Frozen(critic.double())

    def forward(self, rows: Rows) -> dict[str, Tensor]:
        tokenizer, critic = self.tokenizer.module, self.critic.module
        text = torch.arange(4) < torch.tensor([4, 0, 2, 0, 1, 0])[:, None]
        audio = torch.arange(5) < torch.tensor([0, 5, 3, 0, 0, 5])[:, None]
        given = {
            "text": Condition(rows(numbers(4, 3)), rows(text)),
            "audio": Condition(rows(numbers(5, 4)), rows(audio)),
        }
        tokens, kinds, _ = interleave({"code": codes()}, ("code",), ends=self.utt.num_codes, groups=GROUPS)
        tokens, kinds = rows(tokens), rows(kinds)
        condition = self.mate(given)
        logits = self.utt(tokens, kinds, condition, rows(numbers(2)))
        made, length = soft_motion(
            self.utt, logits.double(), tokens, kinds, tokenizer=tokenizer, temperature=1.0, sample=False
        )
        ce = cross_entropy(logits, tokens)
        adversarial = generator_loss(critic(made, condition.glob, length))
        return {"loss": ce + adversarial, "ce": ce.clone(), "adversarial": adversarial.clone()}


class Critic(nn.Module):
    """The discriminator with its penalty."""

    def __init__(self) -> None:
        super().__init__()
        self.net = PatchDiscriminator(DiscriminatorConfig(dim=8, heads=2, ff=8), 5, 4)

    def forward(self, rows: Rows) -> dict[str, Tensor]:
        real, glob, length = rows(numbers(20, 5)), rows(numbers(4)), rows(FRAMES)
        fake = rows(numbers(20, 5, seed=1))
        values = discriminator_loss(self.net(real, glob, length), self.net(fake, glob, length))
        penalty = gradient_penalty(self.net, real, glob, length)
        return {**values, "loss": values["loss"] + 0.1 * penalty, "penalty": penalty.clone()}


class Denoiser(nn.Module):
    """The DMD."""

    def __init__(self) -> None:
        super().__init__()
        config = DmdConfig(dim=8, ff=8, encoder_layers=1, decoder_layers=1, heads=2)
        tokenizer = build_tokenizer(MqConfig(width=8, code_dim=8, num_codes=9), MotionLayout.named("smpl75"))
        self.net = Dmd(config, tokenizer.streams, tokenizer.pattern, 5)

    def forward(self, rows: Rows) -> dict[str, Tensor]:
        loss = dmd_loss(
            self.net,
            self.net.config.schedule.noiser(),
            rows(numbers(20, 5)),
            {"code": rows(codes())},
            rows(FRAMES),
            rows(torch.tensor([3, 900, 40, 0, 999, 500])),
            rows(numbers(20, 5, seed=1)),
        )
        return {"loss": loss}


class Both(nn.Module):
    """The evaluator's autoencoder and its pairs, which share no gradient."""

    def __init__(self) -> None:
        super().__init__()
        config = EvaluatorConfig(
            movement_hidden=8, movement=8, motion_hidden=8, text_hidden=8, latent=4, dropout=0
        )
        net, optim = Evaluator(config, MotionLayout.named("body133"), 3, 24), OptimConfig()
        self.module = EvaluatorModule(net, optim, seed=0, max_steps=2, movement_optim=optim, movement_steps=1)

    def forward(self, rows: Rows) -> dict[str, Tensor]:
        mask = torch.arange(4) < torch.tensor([4, 2, 3, 1, 4, 2])[:, None]
        text = Condition(rows(numbers(4, 3)), rows(mask))
        length = torch.tensor([24, 23, 9, 5, 24, 4])
        batch = {"motion": rows(numbers(24, 133)), "length": rows(length), "conditions": {"text": text}}
        values = {}
        for player in self.module.players():
            values |= {f"{player.name}_{k}": v for k, v in self.module.play(player.name, batch, {}).items()}
        return {**values, "loss": values["movement_loss"] + values["matching_loss"]}


CASES: dict[str, Callable[[], nn.Module]] = {
    "utt": Generator, "critic": Critic, "dmd": Denoiser, "evaluator": Both
}  # fmt: skip


def run(case: str) -> dict[str, dict[str, Tensor]]:
    torch.manual_seed(0)
    net = CASES[case]().double().eval()
    size = BATCH // world_size()
    mine = slice(rank() * size, (rank() + 1) * size)
    model: nn.Module = net
    if world_size() > 1:
        model = DistributedDataParallel(net)
    values = model(lambda x: x[mine])
    values["loss"].backward()
    figures = {}
    for name, value in values.items():
        mean = value.detach().double().clone()
        if world_size() > 1:
            dist.all_reduce(mean)
        figures[name] = mean / world_size()
    grads = {name: p.grad for name, p in net.named_parameters() if p.grad is not None}
    return {"figures": figures, "grads": grads}


def worker(number: int, folder: Path) -> None:
    torch.set_num_threads(1)
    init = f"file://{folder}/rendezvous"
    dist.init_process_group("gloo", init_method=init, rank=number, world_size=2)
    torch.save({case: run(case) for case in CASES}, folder / f"{number}.pt")
    dist.barrier()
    os._exit(0)


@pytest.mark.timeout(200)
def test_two_ranks_equal_one_process(tmp_path: Path) -> None:
    run_two_ranks(__file__, tmp_path, numbered=True, timeout=150)
    two = [torch.load(tmp_path / f"{number}.pt", weights_only=True) for number in range(2)]
    for case in CASES:
        one = run(case)
        assert len(one["grads"]) > 10
        for kind, values in one.items():
            for name, value in values.items():
                first, second = (found[case][kind][name] for found in two)
                torch.testing.assert_close(first, second, rtol=0, atol=0)
                # UTT logits and the schedule's tables are float32.
                torch.testing.assert_close(
                    first.double(), value.double(), rtol=1e-5, atol=1e-6,
                    msg=lambda m, n=f"{case}: {name}": f"{n}: {m}",
                )  # fmt: skip


if __name__ == "__main__":
    worker(int(sys.argv[1]), Path(sys.argv[2]))
