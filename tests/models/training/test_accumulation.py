"""A step of two accumulated parts against the same step with the whole batch.

Equal where the loss is a mean over samples. The parts hold equally many real frames here: a mean of two means
is otherwise not the mean of all. Weights are float64 for the reason that `test_parity_ranks` gives.
"""

from __future__ import annotations

import pytest
import torch
from plain_training import take_steps
from rank_cases import BATCH, SMALL, rows_of, tokenizer
from torch import Tensor

from motionloom.models.tokenizer.base import Tokenizer, TokenizerConfig
from motionloom.models.tokenizer.body_hand import H2VQConfig
from motionloom.models.tokenizer.single import FsqConfig

STEPS = 4


def train(config: TokenizerConfig, parts: int) -> dict[str, Tensor]:
    """Weights after a few steps."""
    torch.manual_seed(0)
    module, batches = tokenizer(config)
    assert isinstance(module.net, Tokenizer)
    for book in module.net.codebooks().values():
        book.freeze()  # a codebook that learns takes every part for a step
    module.net.double()
    size, length = BATCH // parts, torch.tensor([24, 9, 5, 5, 24, 9])
    whole = [{**batches(step), "length": length} for step in range(STEPS)]
    module.accumulate = parts
    take_steps(module, [rows_of(one, slice(i * size, (i + 1) * size)) for one in whole for i in range(parts)])
    assert module.step == STEPS
    return module.net.state_dict()


@pytest.mark.parametrize(
    "config", [FsqConfig(**SMALL, steps=(5, 4)), H2VQConfig(**SMALL, num_codes=12)], ids=["fsq", "h2vq"]
)
def test_two_parts_equal_the_whole_batch(config: TokenizerConfig) -> None:
    whole, parts = train(config, 1), train(config, 2)
    for name, value in whole.items():
        torch.testing.assert_close(
            parts[name], value, rtol=1e-5, atol=1e-5, msg=lambda m, n=name: f"{n}: {m}"
        )
