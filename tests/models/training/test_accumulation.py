"""A step of two accumulated parts against the same step with the whole batch, through Lightning's Trainer.

Equal where the loss is a mean over samples. The parts hold equally many real frames and tokens here: a mean
of two means is otherwise not the mean of all. Weights are float64 for the reason that `test_parity_ranks`
gives.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import lightning as L
import pytest
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.gpt.losses import GptLossConfig
from motionloom.models.gpt.module import GptModule
from motionloom.models.gpt.network import GptConfig, InterleavedGPT
from motionloom.models.gpt.tokens import interleave
from motionloom.models.tma.losses import info_nce
from motionloom.models.tokenizer.base import Stream
from motionloom.models.tokenizer.build import build_tokenizer
from motionloom.models.tokenizer.config import AnyTokenizerConfig, FsqConfig, H2VQConfig
from motionloom.models.tokenizer.module import TokenizerModule
from motionloom.models.training.stage_module import OptimConfig, StageModule

STEPS, BATCH = 4, 6
SMALL: dict[str, Any] = {"width": 8, "depth": 1, "code_dim": 8, "velocity_weight": 0.5}
OPTIM = OptimConfig(lr=1e-3)

Case = tuple[StageModule, list[dict[str, Tensor]]]


def tokenizer(config: AnyTokenizerConfig) -> Case:
    net = build_tokenizer(config, MotionLayout.named("wholebody313"))
    for book in net.codebooks().values():
        book.freeze()  # a codebook that learns takes every part for a step
    module = TokenizerModule(net, OPTIM, seed=0, max_steps=STEPS, **config.loss_terms())
    length = torch.tensor([24, 9, 5, 5, 24, 9])
    motions = [torch.randn(BATCH, 24, net.dim, dtype=torch.float64) for _ in range(STEPS)]
    return module, [{"motion": motion, "length": length} for motion in motions]


def gpt() -> Case:
    streams, pattern = (Stream("body", 7, 2), Stream("hand", 5, 1)), ("body", "body", "hand")
    still: dict[str, Any] = {"dropout": 0, "attention_dropout": 0, "condition_dropout": 0}
    net = InterleavedGPT(
        GptConfig(layers=1, dim=16, heads=2, ff=32, block_size=20, **still), streams, pattern, 6
    )
    module = GptModule(net, OPTIM, seed=0, max_steps=STEPS, loss=GptLossConfig(align_weight=0))
    groups = torch.tensor([5, 1, 3, 3, 5, 1])
    batches = []
    for _ in range(STEPS):
        codes = {"body": torch.randint(7, (BATCH, 10)), "hand": torch.randint(5, (BATCH, 5))}
        sequence = interleave(codes, pattern, ends=net.num_codes, groups=groups)
        batches.append({**sequence._asdict(), "text": torch.randn(BATCH, 6, dtype=torch.float64)})
    return module, batches


CASES: dict[str, Callable[[], Case]] = {
    "fsq": lambda: tokenizer(FsqConfig(**SMALL, steps=(5, 4))),
    "h2vq, codebooks frozen": lambda: tokenizer(H2VQConfig(**SMALL, num_codes=12)),
    "gpt, cross-entropy": gpt,
}


def train(case: str, parts: int) -> dict[str, Tensor]:
    """Weights after a few clipped steps."""
    torch.manual_seed(0)
    module, batches = CASES[case]()
    module.net.double()
    size = BATCH // parts
    cut = [
        {name: value[i * size : (i + 1) * size] for name, value in batch.items()}
        for batch in batches
        for i in range(parts)
    ]
    trainer = L.Trainer(
        accelerator="cpu", devices=1, max_steps=STEPS, accumulate_grad_batches=parts, gradient_clip_val=0.5,
        logger=False, enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False,
    )  # fmt: skip
    trainer.fit(module, DataLoader(cut, batch_size=None))  # type: ignore[arg-type]
    assert trainer.global_step == STEPS
    return module.net.state_dict()


@pytest.mark.parametrize("case", list(CASES))
def test_two_parts_equal_the_whole_batch(case: str) -> None:
    whole, parts = train(case, 1), train(case, 2)
    for name, value in whole.items():
        torch.testing.assert_close(
            parts[name], value, rtol=1e-5, atol=1e-5, msg=lambda m, n=name: f"{n}: {m}"
        )


def test_parts_of_a_contrastive_loss_have_fewer_negatives() -> None:
    """What accumulation cannot do: chance is 1 of 8 in the whole batch and 1 of 4 in its parts."""
    torch.manual_seed(0)
    text, motion = torch.randn(8, 64), torch.randn(8, 64)
    whole = info_nce(text, motion, temperature=100.0)
    parts = torch.stack([info_nce(text[i : i + 4], motion[i : i + 4], temperature=100.0) for i in (0, 4)])
    assert whole.exp().item() == pytest.approx(8, rel=0.01)
    assert parts.mean().exp().item() == pytest.approx(4, rel=0.01)
