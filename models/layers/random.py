"""Random numbers for training: from torch's generators, or from a hash of the sample that they are for.

`train.draws` chooses between two ways:

- `rank`: torch's generators, seeded from (seed, step, rank) before each step. Fast, but each process has a
  stream of its own, so the numbers depend on how many processes share a batch.
- `sample`: every number is a pure function of (seed, step, turn of a player, site, index of the sample in
  the global batch, position within the sample). Any number of processes, splitting the batch in any way,
  draws the same numbers on every device, so training can resume with another number of processes.

Networks and losses draw through the functions here. In evaluation and with `rank` they are torch's own. A
*site* is the number of a call among the calls of one step, which is the same on every rank.

The hash is splitmix64 (Steele, Lea and Flood 2014): word n of a stream is the finaliser of key + n * gamma.
The key of a stream chains the finaliser over site, sample and row; n is the position, with 2^20 values for
each dimension after the first, so that the padding of a batch changes no draw. A word gives two draws of 32
bits each. Codebooks, whose draws are about rows of the global batch, use `hash32` (`quantize/base.py`).

Where a network concatenates padded sequences, `positions` tells which position each column has.

Legend: R rows, a multiple of the B samples of this process; rows of one sample are neighbours.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

import torch
import torch.nn.functional as F
from torch import Tensor, nn

POSITION_BITS = 20
"""Bits of a position in each dimension."""

_GAMMA = 0x9E3779B97F4A7C15
_MUL_1 = 0xBF58476D1CE4E5B9
_MUL_2 = 0x94D049BB133111EB


def _signed(x: int) -> int:
    """A 64-bit word as int64 has it."""
    x &= 2**64 - 1
    return x - 2**64 if x >= 2**63 else x


class _Step:
    """What the draws of the current step depend on."""

    def __init__(self) -> None:
        self.keys: Tensor | None = None
        """int64 [B], one per sample of this process; None: torch's generators draw."""
        self.site = 0
        self.positions: Tensor | None = None
        """int64 [L], the position of each column of a sequence; None: column l has position l."""


_step = _Step()


def by_sample() -> bool:
    """Whether draws are currently keyed by sample."""
    return _step.keys is not None


@contextmanager
def keyed(seed: int, step: int, samples: Tensor, turn: int = 0) -> Iterator[None]:
    """Key the draws inside by sample: `samples` int64 [B] are indices into the global batch of the step."""
    begin(seed, step, samples, turn)
    try:
        yield
    finally:
        end()


def begin(seed: int, step: int, samples: Tensor, turn: int = 0) -> None:
    """Key draws by these samples until `end`; a backward pass that repeats the forward pass is inside."""
    key = samples.new_full((), _signed(seed))
    for part in (step, turn):
        key = _mix(key + _signed((part + 1) * _GAMMA))
    _step.keys = _mix(key + (samples + 1) * _signed(_GAMMA))
    _step.site, _step.positions = 0, None


def end() -> None:
    """Draw from torch's generators again."""
    _step.keys, _step.positions = None, None


@contextmanager
def positions(values: Tensor | None) -> Iterator[None]:
    """Inside, column l of a sequence has position `values[l]` (int64 [L]); None: position l."""
    before, _step.positions = _step.positions, values
    try:
        yield
    finally:
        _step.positions = before


def checkpoint_contexts() -> tuple[AbstractContextManager[None], AbstractContextManager[None]]:
    """For activation checkpointing: contexts of a block's first run and of its repetition, which draws the
    same numbers.
    """
    return nullcontext(), _repeated(_step.site, _step.positions)


@contextmanager
def _repeated(site: int, values: Tensor | None) -> Iterator[None]:
    before, _step.site = _step.site, site
    try:
        with positions(values):
            yield
    finally:
        _step.site = before


def uniform(*size: int, device: torch.device | None = None) -> Tensor:
    """`torch.rand(R, ...)`: float32 in [0, 1)."""
    if _step.keys is None:
        return torch.rand(*size, device=device)
    return _unit(_bits(size))


def uniforms(count: int, rows: int, device: torch.device | None = None) -> tuple[Tensor, ...]:
    """`torch.rand(count, R)`, its rows."""
    if _step.keys is None:
        return torch.rand(count, rows, device=device).unbind()
    return _unit(_bits((rows, count))).unbind(1)


def normal(*size: int, device: torch.device | None = None) -> Tensor:
    """`torch.randn(R, ...)`: float32, standard normal."""
    if _step.keys is None:
        return torch.randn(*size, device=device)
    return _normal(size)


def normal_like(x: Tensor) -> Tensor:
    """`torch.randn_like` of x [R, ...]."""
    if _step.keys is None:
        return torch.randn_like(x)
    return _normal(tuple(x.shape)).to(x.dtype)


def integers(high: int, rows: int, device: torch.device | None = None) -> Tensor:
    """`torch.randint(0, high, [R])`, for `high` below 2^31."""
    if _step.keys is None:
        return torch.randint(0, high, (rows,), device=device)
    return ((_bits((rows,)).long() + 2**31) * high) >> 32


def seeds(rows: int) -> list[int]:
    """`torch.randint(2**62, [R])` as numbers, for generators of their own."""
    if _step.keys is None:
        return [int(seed) for seed in torch.randint(2**62, (rows,)).tolist()]
    high, low = _bits((rows, 2)).long().unbind(1)
    return [int(seed) for seed in (((high & (2**30 - 1)) << 32) | (low & (2**32 - 1))).tolist()]


def dropout(x: Tensor, rate: float, training: bool = True, *, along: tuple[int, ...] = (1,)) -> Tensor:
    """`F.dropout` of x [R, ...]; `along` are the dimensions that `positions` is about."""
    if _step.keys is None or not training or rate == 0:
        return F.dropout(x, rate, training)
    kept = _bits(tuple(x.shape), along) >= _threshold(rate)
    return torch.where(kept, x * (1 / (1 - rate)), 0.0)


def gumbel_softmax(logits: Tensor, temperature: float) -> Tensor:
    """`F.gumbel_softmax` of logits [R, ..., K]: one-hot, differentiable straight through."""
    if _step.keys is None:
        return F.gumbel_softmax(logits, tau=temperature, hard=True)
    unit = (_bits(tuple(logits.shape)).float() + (2.0**31 + 0.5)) * 2.0**-32
    # Neither logarithm may be of 0; where the float32 above rounds to 1, take the number before.
    gumbel = -(-unit.clamp(max=1 - 2.0**-24).log()).log()
    soft = ((logits + gumbel.to(logits.dtype)) / temperature).softmax(-1)
    hard = torch.zeros_like(soft).scatter(-1, soft.argmax(-1, keepdim=True), 1.0)
    return hard - soft.detach() + soft


def attention(
    query: Tensor, key: Tensor, value: Tensor, mask: Tensor | None, causal: bool, rate: float
) -> Tensor:
    """`F.scaled_dot_product_attention` of [R, H, L, D/H], with dropout of the weights.

    By sample the weights are computed, as no fused kernel takes a mask of what is dropped.
    """
    if _step.keys is None or rate == 0:
        return F.scaled_dot_product_attention(
            query, key, value, attn_mask=mask, is_causal=causal and mask is None, dropout_p=rate
        )
    if causal and mask is None:
        mask = torch.ones(query.shape[2], key.shape[2], dtype=torch.bool, device=query.device).tril()
    score = query @ key.transpose(-1, -2) * (1 / math.sqrt(query.shape[-1]))
    if mask is not None:
        score = score.masked_fill(~mask, torch.finfo(score.dtype).min)
    weight = score.softmax(-1).to(value.dtype)
    if mask is not None:
        weight = weight.masked_fill(~mask, 0.0)
    return dropout(weight, rate, along=(2, 3)) @ value


class Dropout(nn.Dropout):
    """`nn.Dropout` of [R, L, ...] that follows `train.draws`."""

    def forward(self, input: Tensor) -> Tensor:
        return dropout(input, self.p, self.training)


def _threshold(rate: float) -> int:
    """Draws of 32 bits below it are as frequent as `rate`."""
    return round(rate * 2**32) - 2**31


def _unit(bits: Tensor) -> Tensor:
    """Float32 in [0, 1) of int32: its upper 24 bits."""
    return ((bits >> 8) + 2**23).float() * 2.0**-24


def _normal(size: tuple[int, ...]) -> Tensor:
    """Box-Muller, two numbers from each word; in float64, so that they are equal on every device and in every
    row of a batch.
    """
    many = size[-1] if len(size) > 1 else 1
    bits = _bits((*(size[:-1] if len(size) > 1 else size), many + many % 2)).double()
    # In (0, 1]: the logarithm may not be of 0.
    radius = ((bits[..., ::2] + (2.0**31 + 1)) * 2.0**-32).log().mul(-2).sqrt()
    angle = bits[..., 1::2] * (math.pi * 2.0**-31)
    pairs = torch.stack([radius * angle.cos(), radius * angle.sin()], dim=-1)
    return pairs.flatten(-2)[..., :many].reshape(size).float()


def _bits(size: tuple[int, ...], along: tuple[int, ...] = (1,)) -> Tensor:
    """The next site's draws: int32 [R, ...] of this size, all 32 bits random."""
    keys = _step.keys
    assert keys is not None
    rows, *inner = size
    each = rows // len(keys)
    if each * len(keys) != rows or len(inner) > 3:
        raise ValueError(f"draws of size {list(size)} are not for {len(keys)} samples")
    _step.site += 1
    key = _mix(keys + _signed(_step.site * _GAMMA))
    if each > 1:
        row = torch.arange(each, device=keys.device)
        key = _mix(key[:, None] + row * _signed(_GAMMA)).flatten()
    if not inner:
        return _mix(key + _signed(_GAMMA)).view(torch.int32)[::2]
    place = torch.zeros((), dtype=torch.int64, device=keys.device)
    pairs = (inner[-1] + 1) // 2
    # Two draws share a word, unless the columns of the last dimension have positions of their own: their
    # neighbours differ from batch to batch, so each needs a word for itself.
    split = _step.positions is not None and len(inner) in along
    for number, count in enumerate(inner, start=1):
        last = number == len(inner)
        at = torch.arange(pairs if last and not split else count, device=keys.device)
        if _step.positions is not None and number in along:
            at = _step.positions
        place = (place << POSITION_BITS)[..., None] + at
    word = _mix(key.view(-1, *(1 for _ in inner)) + (place + 1) * _signed(_GAMMA))
    return word.view(torch.int32)[..., ::2] if split else word.view(torch.int32)[..., : inner[-1]]


def _mix(x: Tensor) -> Tensor:
    """splitmix64's finaliser on int64, which wraps like uint64; the masks make its shifts logical."""
    x = (x ^ ((x >> 30) & (2**34 - 1))) * _signed(_MUL_1)
    x = (x ^ ((x >> 27) & (2**37 - 1))) * _signed(_MUL_2)
    return x ^ ((x >> 31) & (2**33 - 1))


def hash32(x: Tensor) -> Tensor:
    """Avalanche of the low 32 bits of int64 (the finaliser of MurmurHash3): uniform in 0 .. 2^32 - 1."""
    x = x & 0xFFFFFFFF
    x = ((x ^ (x >> 16)) * 0x85EBCA6B) & 0xFFFFFFFF
    x = ((x ^ (x >> 13)) * 0xC2B2AE35) & 0xFFFFFFFF
    return x ^ (x >> 16)
