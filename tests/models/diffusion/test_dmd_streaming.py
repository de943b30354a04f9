"""Windows of a diffusion decoder as tokens come: beside a slow version that has all tokens at once."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor
from toy_gpt import PATTERN, STREAMS, random_codes

from motionloom.models.diffusion.dmd import Dmd, DmdConfig
from motionloom.models.diffusion.dmd_streaming import DmdStream
from motionloom.models.diffusion.sampling import decode_window
from motionloom.models.diffusion.schedule import Sampler

PER = {stream.name: stream.per_group for stream in STREAMS}
WINDOW, OVERLAP, SEED, STEPS = 24, 8, 2**63 + 11, 3


@pytest.fixture(scope="module")
def net() -> Dmd:
    torch.manual_seed(0)
    config = DmdConfig(dim=16, ff=16, heads=2, encoder_layers=1, decoder_layers=1)
    made = Dmd(config, STREAMS, PATTERN, 6).eval()
    torch.nn.init.normal_(made.motion_out.weight, std=0.5)
    return made


def cut(codes: dict[str, Tensor], first: int, last: int) -> dict[str, Tensor]:
    return {name: values[:, first * PER[name] : last * PER[name]] for name, values in codes.items()}


def streamed(net: Dmd, codes: dict[str, Tensor], pieces: list[int], sampler: Sampler) -> Tensor:
    stream = DmdStream(net, PER, seed=SEED, sampler=sampler, steps=STEPS, window=WINDOW, overlap=OVERLAP)
    at, made = 0, []
    for count in pieces:
        found = stream.push(cut(codes, at, at + count))
        at += count
        made += [] if found is None else [found]
        assert max(v.shape[1] / PER[n] for n, v in stream._codes.items()) <= 2 * WINDOW // 4 + max(pieces)
    last = stream.finish()
    assert last is not None and stream.finish() is None
    return torch.cat([*made, last])


def slow(net: Dmd, codes: dict[str, Tensor], groups: int, sampler: Sampler) -> Tensor:
    """Every window from all tokens, then the fades."""
    total, hop = groups * 4, WINDOW - OVERLAP
    noise = np.stack(
        [
            np.random.Generator(
                np.random.Philox(key=SEED + (2 << 64), counter=[0, 0, 0, frame])
            ).standard_normal(6)
            for frame in range(total)
        ]
    )
    bounds = [0]
    while bounds[-1] + WINDOW < total:
        bounds.append(bounds[-1] + hop)
    out = torch.zeros(total, 6)
    for number, bound in enumerate(bounds):
        last = number == len(bounds) - 1
        start = min(bound, max(0, total - WINDOW)) if last else bound
        end = total if last else start + WINDOW
        seed = int(np.random.SeedSequence([SEED, start]).generate_state(1, np.uint64)[0] >> 1)
        x = torch.from_numpy(noise[start:end]).float()
        made = decode_window(
            net, cut(codes, start // 4, end // 4), x, seed=seed, sampler=sampler, steps=STEPS
        )
        for frame in range(bound, end):
            old = number > 0 and frame < bound + OVERLAP
            share = (frame - bound + 1) / (OVERLAP + 1) if old else 1.0
            out[frame] = share * made[frame - start] + (1 - share) * out[frame]
    return out


@pytest.mark.parametrize("sampler", ["dpm++", "ddpm"])
@pytest.mark.parametrize("groups", [1, 5, 6, 7, 10, 11, 23])
def test_pieces_are_the_slow_version(net: Dmd, groups: int, sampler: Sampler) -> None:
    codes = random_codes([groups]).codes
    wanted = slow(net, codes, groups, sampler)
    for size in (1, 4, groups):
        pieces = [min(size, groups - at) for at in range(0, groups, size)]
        made = streamed(net, codes, pieces, sampler)
        assert made.shape == (groups * 4, 6)
        # Some roundings of float32, in the fades alone.
        near = 5e-7 * float(wanted.abs().max())
        np.testing.assert_allclose(made.numpy(), wanted.numpy(), rtol=0, atol=near)


def test_frames_come_before_the_end(net: Dmd) -> None:
    stream = DmdStream(net, PER, seed=1, sampler="dpm++", steps=STEPS, window=WINDOW, overlap=OVERLAP)
    codes = random_codes([60]).codes
    came = [found for at in range(60) if (found := stream.push(cut(codes, at, at + 1))) is not None]
    assert [len(frames) for frames in came] == [WINDOW - OVERLAP] * 14
