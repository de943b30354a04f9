"""Random tokens of two streams, a small GPT of them, and one aligned with a small TMA."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.models.condition.mate import Encoded
from motionloom.models.gpt.losses import GptLossConfig
from motionloom.models.gpt.module import GptModule
from motionloom.models.gpt.network import GptConfig, InterleavedGPT
from motionloom.models.gpt.tokens import Codes, TokenSequence, interleave
from motionloom.models.tma.network import Tma, TmaConfig
from motionloom.models.tokenizer.base import Stream, Tokenizer
from motionloom.models.tokenizer.body_hand import H2VQConfig, SeparateConfig
from motionloom.models.training.stage_module import OptimConfig
from motionloom.pipeline.stages.networks.tokens import EncodedSplit
from motionloom.pipeline.store.tokens import TokenStore

PATTERN = ("body", "body", "hand")
STREAMS = (Stream("body", 7, 2), Stream("hand", 5, 1))
ENDS = {"body": 7, "hand": 5}
TINY = GptConfig(
    layers=2, dim=32, heads=4, ff=64, block_size=30, dropout=0.0, attention_dropout=0.0, pkeep=1.0
)
LAYOUT = MotionLayout.named("wholebody313")
HAND = torch.from_numpy(LAYOUT.part("hand"))


def toy_gpt(std: float = 0.02, text_dim: int = 6, **config: Any) -> InterleavedGPT:
    """Heads of a wide `std` make peaked distributions, in which a mix-up shows."""
    torch.manual_seed(0)
    net = InterleavedGPT(TINY.model_copy(update=config), STREAMS, PATTERN, text_dim=text_dim)
    for head in net.heads:
        torch.nn.init.normal_(head.weight, std=std)
    return net


def aligned_gpt(
    kind: type[H2VQConfig | SeparateConfig] = H2VQConfig, loss: dict[str, Any] | None = None, **config: Any
) -> tuple[GptModule, Tokenizer, Tma]:
    torch.manual_seed(0)
    tokenizer = kind(width=16, depth=1, code_dim=8, num_codes=9).build(LAYOUT)
    for book in tokenizer.codebooks().values():
        book.codebook.normal_()
    tma = Tma(TmaConfig(latent=16, ff=32, layers=1, heads=2), 313, 10)
    net = InterleavedGPT(TINY.model_copy(update=config), tokenizer.streams, tokenizer.pattern, text_dim=16)
    module = GptModule(
        net, OptimConfig(), seed=0, max_steps=10, loss=GptLossConfig(**(loss or {})),
        tokenizer=tokenizer, tma=tma,
    )  # fmt: skip
    return module, tokenizer, tma


def encode_split(
    tokenizer: Tokenizer, dataset: ClipDataset, stats: FeatureStats, batch_frames: int
) -> TokenStore:
    """Codes of all clips in order, in this process."""
    encoded = EncodedSplit(tokenizer, dataset, stats, batch_frames)
    return encoded.store(map(encoded.codes, range(len(encoded.batches))))


def random_codes(groups: Sequence[int], streams: Sequence[Stream] = STREAMS) -> Codes:
    """So many groups a row; 0 behind them."""
    draws, number, most = torch.Generator().manual_seed(3), torch.tensor(groups), max(groups)
    codes = {}
    for name, count, per in streams:
        values = torch.randint(count, (len(groups), most * per), generator=draws)
        codes[name] = values * (torch.arange(most * per) < number[:, None] * per)
    return Codes(codes, number)


def row_of(codes: Codes, index: int) -> dict[str, list[int]]:
    """The codes of one row by stream, without what is behind them."""
    count = int(codes.groups[index])
    return {s.name: codes.codes[s.name][index, : count * s.per_group].tolist() for s in STREAMS}


def encoded(batch: int, lengths: list[int] | None = None, *, timed: bool = False) -> Encoded:
    """Conditions of a UTT, at most five positions long."""
    draws = torch.Generator().manual_seed(1)
    glob, seq, music = (
        torch.randn(batch, *size, generator=draws, dtype=torch.float64) for size in ((6,), (5, 6), (15, 6))
    )
    mask = torch.arange(5) < torch.tensor(lengths or [5] * batch)[:, None]
    return Encoded(glob, seq, mask, music if timed else None)


def closed(groups: Sequence[int]) -> TokenSequence:
    """Sequences of them, each with its End tokens."""
    codes = random_codes(groups)
    return interleave(codes.codes, PATTERN, ends=ENDS, groups=codes.groups)


def sequences(groups: list[int], net: InterleavedGPT) -> tuple[TokenSequence, Tensor]:
    """Closed sequences of any codes, and a text for each."""
    streams = [Stream(name, net.num_codes[name], net.pattern.count(name)) for name in net.names]
    codes = random_codes(groups, streams)
    sequence = interleave(codes.codes, net.pattern, ends=net.num_codes, groups=codes.groups)
    draws = torch.Generator().manual_seed(1)
    return sequence, torch.randn(len(groups), net.text_in.in_features, generator=draws)
