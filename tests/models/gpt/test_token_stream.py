"""Tokens of a GPT without an end: beside `generate`, and beside a slow version without a cache."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from torch import Tensor

from motionloom.datasets.schema import UserError
from motionloom.models.gpt.network import GptConfig, InterleavedGPT
from motionloom.models.gpt.sampling import Drawing, generate
from motionloom.models.gpt.streaming import OPENING, TokenStream
from motionloom.models.tokenizer.base import Stream

PATTERN = ("body", "body", "hand")
STREAMS = (Stream("body", 9, 2), Stream("hand", 5, 1))
HOW = Drawing(0.9, 6, 0.95)
BLOCK = 24
"""The text and seven groups with their End tokens."""


def network(**more: float) -> InterleavedGPT:
    torch.manual_seed(3)
    config = GptConfig(layers=2, dim=16, heads=2, ff=32, block_size=BLOCK, **more)  # type: ignore[arg-type]
    net = InterleavedGPT(config, STREAMS, PATTERN, text_dim=4).double().eval()
    for head in net.heads:
        torch.nn.init.normal_(head.weight, std=0.7)  # peaked, so that a mix-up would show
    torch.nn.init.normal_(net.text_in.weight, std=2.0)
    return net


@pytest.fixture(scope="module")
def gpt() -> InterleavedGPT:
    return network()


def ending(likely: float) -> InterleavedGPT:
    """A network whose End has so much more, or less, in its favour."""
    net = network()
    bias = torch.zeros(net.heads[0].out_features).double()
    bias[net.num_codes["body"]] = likely
    net.heads[0].bias = torch.nn.Parameter(bias)
    return net


def text(seed: int) -> Tensor:
    return torch.randn(1, 4, generator=torch.Generator().manual_seed(seed)).double()


def drawn(stream: TokenStream, groups: int) -> list[list[int]]:
    return [stream.draw()[0].tolist() for _ in range(groups)]


@torch.no_grad()
def slow(
    gpt: InterleavedGPT, texts: Sequence[Tensor], *, context: int, scale: float, seed: int
) -> list[list[int]]:
    """A group for each of `texts`: the whole block is read again for every token."""
    numbers = np.random.Generator(np.random.Philox(key=seed)).random(len(texts) * len(PATTERN))
    out: list[list[int]] = []
    begin, start, before = 0, 0, None
    opening: list[list[int]] = []
    place = 0

    def token(group: list[int], now: Tensor, number: int, end: int) -> int:
        """Of the codes and, where `end` is 1, of End."""
        slot = len(group)
        past = torch.tensor([t for g in out[begin:] for t in g] + group, dtype=torch.int64)
        kinds = gpt.slots.repeat(number - begin + 1)[: len(past)]
        logits = []
        for null in (False, True):
            first = gpt.embed_text(now, torch.tensor([null]))
            hidden = gpt.hidden(torch.cat([first, gpt.embed(past[None], kinds[None])], dim=1))
            head = gpt.heads[gpt.names.index(PATTERN[slot])]
            logits.append(head(hidden[:, -1]).float()[:, : gpt.num_codes[PATTERN[slot]] + end])
        mixed = logits[0] if scale == 1 else logits[1] + scale * (logits[0] - logits[1])
        return int(HOW(mixed, torch.tensor(numbers[number * 3 + slot : number * 3 + slot + 1])))

    for number, now in enumerate(texts):
        if number - begin == gpt.max_groups or (before is not None and now is not before):
            begin, start = max(begin, number - context), number
            opening, place = ([], OPENING) if now is not before else (opening, place)
            place = 0 if begin == number else place
        if number > start and token([], now, number, 1) == gpt.num_codes["body"]:
            begin = start = number  # the clip is over: the text alone
            place = 0
        before, group = now, list(opening[place]) if place < len(opening) else list[int]()
        while len(group) < len(PATTERN):
            group.append(token(group, now, number, 0))
        out.append(group)
        if place == len(opening) < OPENING:
            opening.append(group)
        place += 1
    return out


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_one_block_is_a_motion_of_that_length(scale: float) -> None:
    gpt = ending(-1e3)
    stream = TokenStream(gpt, how=HOW, context=2, cfg_scale=scale, seed=11)
    stream.condition(text(0))
    made = drawn(stream, gpt.max_groups)
    whole = generate(
        gpt, text(0), groups=torch.tensor([gpt.max_groups]), how=HOW, cfg_scale=scale, seed=[11]
    )  # fmt: skip
    assert [token for a, b, _ in made for token in (a, b)] == whole.codes["body"][0].tolist()
    assert [hand for _, _, hand in made] == whole.codes["hand"][0].tolist()


@pytest.mark.parametrize(("context", "scale"), [(0, 1.0), (3, 1.0), (3, 2.5), (99, 1.0)])
def test_it_goes_on_as_the_slow_version(gpt: InterleavedGPT, context: int, scale: float) -> None:
    texts = [text(0)] * 4 + [text(1)] * 11 + [text(2)] * 3
    stream, made = TokenStream(gpt, how=HOW, context=context, cfg_scale=scale, seed=5), []
    before = None
    for now in texts:
        if now is not before:
            stream.condition(now)
        before = now
        made += drawn(stream, 1)
    kept = min(context, gpt.max_groups - 1)
    assert made == slow(gpt, texts, context=kept, scale=scale, seed=5)


def test_a_clip_that_is_over_begins_anew() -> None:
    """Whatever the network has drawn: the next block has read the text alone."""
    stream = TokenStream(ending(1e3), how=HOW, context=5, seed=5)
    stream.condition(text(0))
    for _ in range(5):
        drawn(stream, 1)
        assert stream._block.shape[1] == len(PATTERN)


@pytest.mark.parametrize("before", [0, 3])
def test_clips_of_a_text_begin_alike(before: int) -> None:
    """So that what it leaves open stays: from its second clip on where another text came before."""
    stream, clips = TokenStream(ending(0.5), how=HOW, context=2, seed=5), list[list[list[int]]]()
    if before:
        stream.condition(text(1))
        drawn(stream, before)
    stream.condition(text(0))
    while len(clips) < 40:
        [group] = drawn(stream, 1)
        if not clips or stream._block.shape[1] == len(PATTERN):
            clips.append([])
        clips[-1].append(group)
    alike = [tuple(map(tuple, clip[:OPENING])) for clip in clips[bool(before) : -1] if len(clip) >= OPENING]
    assert len(alike) > 2 and len(set(alike)) == 1
    assert len({tuple(map(tuple, clip)) for clip in clips}) > 1, "they go on as they are drawn"


def test_memory_is_one_block(gpt: InterleavedGPT) -> None:
    stream = TokenStream(gpt, how=HOW, context=2, seed=1)
    stream.condition(text(0))
    drawn(stream, 40)
    assert stream._block.shape[1] <= gpt.max_groups * 3 and stream._cache is not None
    assert stream._cache.layers[0].size == gpt.max_groups * 3


def test_refusals(gpt: InterleavedGPT) -> None:
    with pytest.raises(ValueError, match="nothing to draw from"):
        TokenStream(gpt, how=HOW, context=2).draw()
    with pytest.raises(UserError, match="condition_dropout"):
        TokenStream(network(condition_dropout=0.0), how=HOW, context=2, cfg_scale=2.0)
