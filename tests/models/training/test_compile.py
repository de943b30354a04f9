"""Every stage's loss is one graph for torch.compile, and gives the same figures as without."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

from motionloom.datasets.conditions import Condition
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.diffusion.module import DiffusionModule
from motionloom.models.diffusion.network import DiffusionConfig, MotionDiffusion
from motionloom.models.gpt.losses import GptLossConfig
from motionloom.models.gpt.module import GptModule
from motionloom.models.gpt.network import GptConfig, InterleavedGPT
from motionloom.models.gpt.tokens import interleave
from motionloom.models.tma.module import TmaModule
from motionloom.models.tma.network import Tma, TmaConfig
from motionloom.models.tokenizer.build import build_tokenizer
from motionloom.models.tokenizer.config import FsqConfig, H2VQConfig, MqConfig, RvqConfig, SeparateConfig
from motionloom.models.tokenizer.module import TokenizerModule
from motionloom.models.training.stage_module import OptimConfig, StageModule

pytestmark = pytest.mark.slow

LAYOUT = MotionLayout.named("wholebody313")
SMALL: dict[str, Any] = {"width": 8, "depth": 1, "code_dim": 8}
BOOK: dict[str, Any] = {**SMALL, "num_codes": 16}
OPTIM = OptimConfig()


def windows(dim: int) -> dict[str, Any]:
    present = torch.ones(4, dim, dtype=torch.bool)
    present[1:3, -60:] = False  # columns of the hands
    return {"motion": torch.randn(4, 16, dim), "length": torch.tensor([16, 16, 12, 9]), "present": present}


def captioned(dim: int) -> dict[str, Any]:
    return windows(dim) | {
        "conditions": {
            "text": Condition(
                torch.randn(4, 5, 12),
                torch.arange(5)[None] < torch.tensor([[5], [4], [3], [2]]),
                torch.nn.functional.normalize(torch.randn(4, 12), dim=-1),
            )
        },
        "similarity": torch.nn.functional.normalize(torch.randn(4, 12), dim=-1),
    }


def tokenizer(kind: str) -> tuple[StageModule, dict[str, Any]]:
    config = {
        "h2vq": H2VQConfig(**BOOK, root_gain=5.0, finger_gain=2.0),
        "rvq": RvqConfig(**BOOK),
        "separate": SeparateConfig(**BOOK),
        "fsq": FsqConfig(**SMALL, steps=(4, 4)),
        "mq": MqConfig(**SMALL, num_codes=12, start="data"),
    }[kind]
    net = build_tokenizer(config, LAYOUT)
    return TokenizerModule(net, OPTIM, seed=0, max_steps=1, **config.loss_terms()), windows(net.dim)


def tma() -> tuple[StageModule, dict[str, Any]]:
    config = TmaConfig(latent=16, ff=16, layers=1, heads=2, root_gain=5.0, finger_gain=2.0)
    net = Tma.of_layout(config, LAYOUT, "bodyhand", 12)
    return TmaModule(net, OPTIM, seed=0, max_steps=1), captioned(313)


def diffusion() -> tuple[StageModule, dict[str, Any]]:
    net = MotionDiffusion(DiffusionConfig(dim=16, ff=16, layers=1, heads=2), 313, 12)
    return DiffusionModule(net, OPTIM, seed=0, max_steps=1), captioned(313)


def gpt() -> tuple[StageModule, dict[str, Any]]:
    book = build_tokenizer(H2VQConfig(**BOOK, root_gain=5.0, finger_gain=2.0), LAYOUT)
    align = Tma(TmaConfig(latent=16, ff=16, layers=1, heads=2), 313, 12)
    config = GptConfig(layers=1, dim=16, heads=2, ff=16, block_size=20, pkeep=0.8)
    net = InterleavedGPT(config, book.streams, book.pattern, 16)
    module = GptModule(
        net, OPTIM, seed=0, max_steps=1, loss=GptLossConfig(), tokenizer=book.freeze(), tma=align
    )
    groups = torch.tensor([4, 3, 2, 4])
    codes = {"body": torch.randint(16, (4, 8)), "hand": torch.randint(16, (4, 4))}
    tokens, kinds, _ = interleave(codes, book.pattern, ends=net.num_codes, groups=groups)
    batch = {"tokens": tokens, "kinds": kinds, "text": torch.randn(4, 16), "similarity": torch.randn(4, 12)}
    return module, batch


CASES: dict[str, Callable[[], tuple[StageModule, dict[str, Any]]]] = {
    **{kind: (lambda kind=kind: tokenizer(kind)) for kind in ("h2vq", "rvq", "separate", "fsq", "mq")},
    "tma": tma,
    "diffusion": diffusion,
    "gpt with alignment": gpt,
}


@pytest.mark.parametrize("case", list(CASES))
def test_one_graph_and_the_same_losses(case: str) -> None:
    torch._dynamo.reset()
    torch.manual_seed(0)
    module, batch = CASES[case]()
    module.eval()  # no dropout: compiled code may draw in another order
    torch.manual_seed(1)
    plain = module.losses(batch)
    compiled = torch.compile(module.losses, fullgraph=True, backend="aot_eager")
    torch.manual_seed(1)
    found = compiled(batch)
    assert found.keys() == plain.keys()
    for name, value in plain.items():
        torch.testing.assert_close(
            found[name], value, atol=1e-5, rtol=1e-4, msg=lambda m, n=name: f"{n}: {m}"
        )
    module.train()
    loss = compiled(batch)["loss"]
    loss.backward()
    assert all(p.grad is not None for p in module.net.parameters() if p.requires_grad)


@torch._dynamo.config.patch(recompile_limit=4)
def test_many_stages_compile_in_one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """A recipe's tokenizers share the code of their losses, of which only so many graphs may exist."""
    compiler = torch.compile
    monkeypatch.setattr(torch, "compile", lambda f, **options: compiler(f, backend="eager", **options))
    for kind in ("rvq", "fsq", "separate"):
        module, batch = CASES[kind]()
        module.compile_losses()
        for size in (4, 3):
            for mode in (True, False):
                module.train(mode)
                assert module.losses({name: value[:size] for name, value in batch.items()})["loss"] > 0
