"""A step of two accumulated parts against the same step with the whole batch.

Equal where the loss is a mean over samples. The parts hold equally many real frames and tokens here: a mean
of two means is otherwise not the mean of all. Weights are float64 for the reason that `test_parity_ranks`
gives.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import rank_cases
import torch
from plain_training import take_steps
from torch import Tensor

from motionloom.models.gpt.losses import GptLossConfig
from motionloom.models.gpt.module import GptModule
from motionloom.models.gpt.network import GptConfig, InterleavedGPT
from motionloom.models.gpt.tokens import interleave
from motionloom.models.tokenizer.base import Stream, Tokenizer, TokenizerConfig
from motionloom.models.tokenizer.body_hand import H2VQConfig
from motionloom.models.tokenizer.single import FsqConfig
from motionloom.models.training.stage_module import OptimConfig, StageModule

STEPS, BATCH = 4, 6
SMALL: dict[str, Any] = {"width": 8, "depth": 1, "code_dim": 8, "velocity_weight": 0.5}
OPTIM = OptimConfig(lr=1e-3, grad_clip=0.5)

Case = tuple[StageModule, list[dict[str, Tensor]]]


def tokenizer(config: TokenizerConfig) -> Case:
    module, batches = rank_cases.tokenizer(config)
    assert isinstance(module.net, Tokenizer)
    for book in module.net.codebooks().values():
        book.freeze()  # a codebook that learns takes every part for a step
    length = torch.tensor([24, 9, 5, 5, 24, 9])
    return module, [{**batches(step), "length": length} for step in range(STEPS)]


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
    module.accumulate = parts
    take_steps(module, cut)
    assert module.step == STEPS
    return module.net.state_dict()


@pytest.mark.parametrize("case", list(CASES))
def test_two_parts_equal_the_whole_batch(case: str) -> None:
    whole, parts = train(case, 1), train(case, 2)
    for name, value in whole.items():
        torch.testing.assert_close(
            parts[name], value, rtol=1e-5, atol=1e-5, msg=lambda m, n=name: f"{n}: {m}"
        )
