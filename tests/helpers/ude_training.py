"""Small trainings on random motion of UDE's three networks (MQ, UTT with its critic, DMD) and of what it is
compared with: TM2T's tokenizer with its critic, FACT, Bailando's three.

Nothing draws per process: without dropout and z, and the DMD's noise is that of the whole batch, of which a
rank takes its rows. So two ranks and one process can be compared.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from rich.console import Console
from tiny_adversaries import Steps, context
from torch import Tensor, nn

from motionloom.datasets.conditions import Condition
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.condition.mate import MateConfig
from motionloom.models.diffusion.dmd import Dmd, DmdConfig
from motionloom.models.diffusion.module import DmdModule
from motionloom.models.layers.frozen import Frozen
from motionloom.models.tokenizer.module import TokenizerModule
from motionloom.models.tokenizer.single import MqConfig
from motionloom.models.training.distributed import rank, world_size
from motionloom.models.training.optim import OptimConfig
from motionloom.models.training.stage_module import StageModule
from motionloom.models.utt.module import UttModule
from motionloom.models.utt.network import ConditionedUtt, UttConfig, UttLossConfig
from motionloom.pipeline.baselines.bailando.codes import DanceVq, DanceVqConfig
from motionloom.pipeline.baselines.bailando.module import ActorCriticModule, CrossGptModule, DanceVqModule
from motionloom.pipeline.baselines.bailando.network import ActorCritic, CrossGpt, CrossGptConfig, RewardConfig
from motionloom.pipeline.baselines.fact.module import FactModule
from motionloom.pipeline.baselines.fact.network import Fact, FactConfig
from motionloom.pipeline.baselines.tm2t.module import AdversarialTokenizerModule
from motionloom.pipeline.baselines.tm2t.network import CriticConfig
from motionloom.pipeline.baselines.tm2t.tokenizer import Tm2tConfig, Tm2tQuantizer
from motionloom.pipeline.training.config import TrainConfig
from motionloom.pipeline.training.trainer import fit

LAYOUT = MotionLayout.named("smpl75")
MQ = MqConfig(width=8, depth=1, code_dim=8, num_codes=9, quantizer="gradient", start="data")
OPTIM = OptimConfig(optimizer="adam", lr=3e-3, warmup_steps=3)
NAMES = ("mq", "tm2t", "utt", "dmd", "fact", "dance_vq", "cross_gpt", "actor_critic")


class Clips(Steps):
    """Motion, text and music; lengths differ."""

    def made(self, step: int, part: int) -> dict[str, Any]:
        generator = torch.Generator().manual_seed(self.parts * step + part)

        def numbers(*shape: int) -> Tensor:
            return torch.randn(self.batch, *shape, generator=generator, dtype=torch.float64).to(self.dtype)

        order = torch.arange(self.batch)
        length = 8 + 4 * (order % 4)
        heard = (torch.arange(20) < length[:, None]) & (order % 3 > 0)[:, None]
        batch = {
            "motion": numbers(20, LAYOUT.dim).cumsum(1) * 0.3,
            "length": length,
            "closed": order % 2 == 0,
            "beats": (torch.arange(20) + order[:, None]) % 6 == 0,
            "held": torch.ones(self.batch, LAYOUT.dim, dtype=torch.bool),
            "conditions": {
                "text": Condition(numbers(3, 4), ((order % 3 < 2)[:, None]).expand(-1, 3)),
                "audio": Condition(numbers(20, 3), heard),
            },
        }
        conditions = {
            name: Condition(features[self.rows], mask[self.rows])
            for name, (features, mask, _) in batch.pop("conditions").items()  # type: ignore[attr-defined]
        }
        return {name: value[self.rows] for name, value in batch.items()} | {"conditions": conditions}


class SharedNoise(DmdModule):
    """The DMD with draws of the whole batch."""

    def seed_draws(self, part: int, turn: int = 0) -> None:
        """The same on every rank."""
        torch.manual_seed(self.seed * 1000 + self.step)

    def losses(self, batch: dict[str, Any]) -> dict[str, Tensor]:
        """As the base class."""
        with draws_of_all():
            return super().losses(batch)


@contextmanager
def draws_of_all() -> Iterator[None]:
    randint, randn = torch.randint, torch.randn
    number, world = (rank(), world_size()) if torch.is_grad_enabled() else (0, 1)

    def whole(low: int, high: int, size: tuple[int, ...], **options: Any) -> Tensor:
        return randint(low, high, (size[0] * world,), **options)[number * size[0] :][: size[0]]

    def like(x: Tensor) -> Tensor:
        made = randn(len(x) * world, *x.shape[1:], dtype=torch.float64)
        return made[number * len(x) :][: len(x)].to(x)

    with mock.patch.object(torch, "randint", whole), mock.patch.object(torch, "randn_like", like):
        yield


def tokenizer() -> Any:
    """A frozen one with distant codes, so that rounding changes none."""
    torch.manual_seed(1)
    made = MQ.build(LAYOUT)
    for book in made.codebooks().values():
        nn.init.normal_(book.codebook)
        book.initialised.fill_(True)
        book._is_initialised = True
    return made


def dances(name: str, given: dict[str, Any], dropout: float) -> StageModule:
    """The module of a model of dances; motions are taken for 25 joints."""
    sizes: dict[str, Any] = {"dim": 8, "heads": 2, "ff": 8, "layers": 1, "dropout": dropout}
    if name == "fact":
        lengths = {"motion_frames": 10, "music_frames": 16, "predicted_frames": 3}
        config = FactConfig(**sizes, **lengths, motion_layers=1, music_layers=1)
        return FactModule(Fact(config, LAYOUT, "all", music_dim=3), OPTIM, **given)
    codes = DanceVqConfig(width=8, depth=1, code_dim=8, halvings=2, num_codes=9, decay=0.8, reset_below=0.1)
    vq = DanceVq(codes, 25)
    if name == "dance_vq":
        return DanceVqModule(vq, OPTIM, root_optim=OPTIM, root_start=10, **given)
    for half in (vq.up, vq.down):
        nn.init.normal_(half.quantizer.codebook)
    vq.eval()
    gpt = CrossGpt(CrossGptConfig(**sizes, context=4), 9, 3)
    if name == "cross_gpt":
        return CrossGptModule(gpt, OPTIM, vq=vq, **given)
    reward = RewardConfig(actor_steps=2, critic_steps=3, temperature=1.0 if dropout else 0.0)
    return ActorCriticModule(ActorCritic(gpt, 1), OPTIM, vq=vq, fps=20.0, reward=reward, **given)


def module_of(name: str, steps: int, *, dropout: float = 0.0) -> StageModule:
    """The module of one network; `dropout` also turns on what else is drawn."""
    given: dict[str, Any] = {"seed": 3, "max_steps": steps}
    torch.manual_seed(0)
    if name not in ("mq", "tm2t", "utt", "dmd"):
        return dances(name, given, dropout)
    if name == "mq":
        return TokenizerModule(MQ.build(LAYOUT), OPTIM, **given)
    if name == "tm2t":
        net = Tm2tQuantizer(Tm2tConfig(**{**MQ.dump(), "kind": "tm2t", "recon": "l1"}), LAYOUT)
        return AdversarialTokenizerModule(net, OPTIM, critic=CriticConfig(start=4, width=8), **given)
    if name == "dmd":
        small = DmdConfig(
            dim=8, ff=8, encoder_layers=1, decoder_layers=1, heads=2, dropout=dropout, attention_dropout=0.0
        )
        frozen = tokenizer()
        kind = DmdModule if dropout else SharedNoise
        return kind(Dmd(small, frozen.streams, frozen.pattern, frozen.dim), OPTIM, tokenizer=frozen, **given)
    frozen = tokenizer()
    net = ConditionedUtt(
        MateConfig(dim=8, layers=1, heads=2, ff=8, dropout=dropout, attention_dropout=0.0, stride=2),
        UttConfig(
            layers=1, dim=8, heads=2, ff=8, block_size=8, dropout=dropout, attention_dropout=0.0,
            z_dim=2 if dropout else 0, condition_dropout=dropout, pkeep=1 - dropout, frame_condition=True,
        ),
        {"text": 4, "audio": 3}, frozen.streams, frozen.pattern, timed=["audio"])  # fmt: skip
    loss = {
        "adversarial": {"weight": 0.1, "sample": bool(dropout)},
        "adversarial_start": 4,
        "adversarial_ramp": 4,
        "discriminator": {"dim": 8, "ff": 8, "heads": 2, "dropout": dropout, "spectral_norm": True},
        "discriminator_optim": {"optimizer": "adam", "lr": 1e-3},
    }
    return UttModule(net, OPTIM, tokenizer=frozen, loss=UttLossConfig.parse(loss, "loss"), **given)


def train(
    name: str,
    folder: Path,
    *,
    dtype: torch.dtype = torch.float32,
    devices: int = 1,
    dies_at: int | None = None,
    signalled: dict[int, signal.Signals] | None = None,
    dropout: float = 0.0,
    **settings: Any,
) -> StageModule:
    """Train one network in `folder`, from its newest checkpoint; `dies_at` a step all ends with an error, and
    while a step of `signalled` is taken, that signal comes.
    """
    given: dict[str, Any] = {"steps": 16, "batch_size": 8, "checkpoint_every": 4, "validate_every": 8}
    config = TrainConfig(**{**given, **settings})
    module = module_of(name, config.steps, dropout=dropout).to(dtype)
    for frozen in (getattr(module, name, None) for name in ("tokenizer", "vq")):
        if isinstance(frozen, Frozen):
            frozen.module.to(dtype)
    fit(
        context(folder, Console(quiet=True), devices=devices),
        module,
        config,
        lambda *place: Clips(*place, dtype=dtype, dies_at=dies_at, signalled=signalled),
        lambda: Clips(8, size=2, dtype=dtype),
    )
    return module
