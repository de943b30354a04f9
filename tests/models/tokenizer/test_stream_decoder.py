"""Motion decoded as its tokens come: the reach of every decoder, and chunks beside the whole."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.tokenizer.base import GROUP_FRAMES, Tokenizer, TokenizerConfig
from motionloom.models.tokenizer.body_hand import H2VQConfig, SeparateConfig
from motionloom.models.tokenizer.single import FsqConfig, MqConfig, RvqConfig, VqConfig
from motionloom.models.tokenizer.streaming import StreamDecoder
from motionloom.pipeline.baselines.tm2t.tokenizer import Tm2tConfig

GROUPS = 26
SMALL = {"width": 8, "code_dim": 6, "num_codes": 16}
KINDS: dict[str, TokenizerConfig] = {
    "h2vq": H2VQConfig(**SMALL, depth=2, dilation_growth=2),
    "h2vq with fingers": H2VQConfig(**SMALL, depth=1, finger_gain=2.0, root_gain=3.0),
    "vq": VqConfig(**SMALL, depth=2, dilation_growth=2),
    "rvq of the face": RvqConfig(**SMALL, depth=1, part="face", levels=3),
    "separate": SeparateConfig(**SMALL, depth=2, dilation_growth=3),
    "fsq": FsqConfig(width=8, depth=1, code_dim=6, steps=(4, 4)),
    "mq": MqConfig(**SMALL, depth=2, dilation_growth=3),
    "tm2t": Tm2tConfig(**SMALL, depth=2, dilation_growth=3),
}


@pytest.fixture(scope="module", params=KINDS)
def net(request: pytest.FixtureRequest) -> Tokenizer:
    """A decoder with weights that let every latent show in every frame that it reaches."""
    torch.manual_seed(0)
    made = KINDS[request.param].build(MotionLayout.named("wholebody363")).double().eval()
    for module in made.decoder.modules():
        if isinstance(module, torch.nn.Conv1d):
            torch.nn.init.uniform_(module.weight, 0.1, 0.3)  # positive: no path is closed by a ReLU
    # Codebooks stay in float32; all behind them is float64, so that only the order of sums can differ.
    made.decoder.register_forward_pre_hook(lambda _, given: (given[0].double(), *given[1:]))
    return made.requires_grad_(False)


def tokens(net: Tokenizer, groups: int, seed: int = 0) -> dict[str, Tensor]:
    draws = torch.Generator().manual_seed(seed)
    return {
        s.name: torch.randint(0, s.num_codes, (2, groups * s.per_group), generator=draws) for s in net.streams
    }


def weights(net: Tokenizer, codes: dict[str, Tensor]) -> dict[str, Tensor]:
    """One-hot, so that a gradient says which tokens a frame is made of."""
    return {
        s.name: torch.nn.functional.one_hot(codes[s.name][:1], s.num_codes).double().requires_grad_()
        for s in net.streams
    }


def test_the_reach_is_that_of_the_gradient(net: Tokenizer) -> None:
    soft, middle = weights(net, tokens(net, GROUPS)), GROUPS // 2
    written = net.decode_soft(soft)[:, middle * GROUP_FRAMES : (middle + 1) * GROUP_FRAMES]
    found = torch.autograd.grad(written.sum(), list(soft.values()))
    seen: set[int] = set()
    for stream, gradient in zip(net.streams, found, strict=True):
        used = (gradient.abs().sum(-1)[0] != 0).nonzero()[:, 0] // stream.per_group
        seen |= set(used.tolist())
    assert 0 < net.reach < middle - 1
    assert max(middle - min(seen), max(seen) - middle) == net.reach


@pytest.mark.parametrize("least", [1, 3])
def test_chunks_are_the_whole(net: Tokenizer, least: int) -> None:
    codes, pieces = tokens(net, GROUPS), [1, 1, 4, 1, 9, 2, 1, 7]
    assert sum(pieces) == GROUPS
    decoder, at, made = StreamDecoder(net, least), 0, []
    for count in pieces:
        chunk = {s.name: codes[s.name][:, at * s.per_group : (at + count) * s.per_group] for s in net.streams}
        at += count
        found = decoder.push(chunk)
        kept = max(decoder._codes[s.name].shape[1] / s.per_group for s in net.streams)
        assert kept <= 2 * net.reach + least + count
        final = sum(frames.shape[1] for frames in made) + (0 if found is None else found.shape[1])
        assert final <= max(0, at - net.reach) * GROUP_FRAMES
        assert final > (at - net.reach - least) * GROUP_FRAMES
        made += [] if found is None else [found]
    made.append(decoder.finish())
    assert decoder.finish() is None
    whole = net.decode(codes)
    # Sums of at most 2 000 products of size 1, added in another order: below 1e-12 of their size.
    np.testing.assert_allclose(torch.cat(made, 1).numpy(), whole.numpy(), rtol=0, atol=1e-11 * scale(whole))


def scale(values: Tensor) -> float:
    return max(1.0, float(values.abs().max()))


def test_a_motion_shorter_than_the_reach_comes_at_its_end(net: Tokenizer) -> None:
    decoder, codes = StreamDecoder(net), tokens(net, 1)
    assert decoder.push(codes) is None
    last = decoder.finish()
    assert last is not None and math.isclose(float((last - net.decode(codes)).abs().max()), 0.0)
