"""Steps of the GPT that draw a token: `advance`, and `run_fixed` by steps of fixed shapes, which a GPU
records as CUDA graphs.

Notable choices:
- There is one graph for each number of rows and each `ROOM` places: attention is over those that exist, up to
  `ROOM - 1` more. Rows that have ended leave halves of the batch; the others move to the front of the same
  tensors.
- In half precision torch.compile fuses a step (`advance_fused`), since a kernel of one row takes as long to
  start as to compute: casts, sums and LayerNorms are one kernel, and products of few rows are sums, which
  take LayerNorm, bias, GELU and residual along. The same code serves all blocks, so that compiling takes as
  long as for one. Sums are rounded in another order than the plain step's, so float32, by which a seed's
  motion is known, is not fused.

Legend: B batch, D width.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from typing import Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor, nn
from torch.nn import functional

from motionloom.models.gpt.network import InterleavedGPT
from motionloom.models.gpt.rows import Rows
from motionloom.models.layers.attention import KVCache
from motionloom.models.layers.graphs import recorded
from motionloom.models.layers.linear import product_type
from motionloom.models.layers.transformer import Block

ROOM = 32
"""Places of a cache of fixed size are a multiple of this, so that few lengths have a graph of their own."""

FEW = 2
"""Rows up to which a product is a sum: one motion, and its pass without text."""

_FUSED = {torch.float16, torch.bfloat16}
"""Types of products with which a step is fused."""

_KINDS = 64
"""Ways in which a function is compiled, by network, rows and drawing; of torch's eight a server runs out."""


def advance(gpt: InterleavedGPT, rows: Rows, cache: KVCache) -> None:
    """Draw the next token of each row behind those that the cache holds."""
    assert rows.x is not None
    rows.draw(gpt.hidden(rows.x, cache))


def advance_fused(gpt: InterleavedGPT, rows: Rows, cache: KVCache) -> None:
    """`advance` of a network without dropout by few kernels; the cache has `at`."""
    assert rows.x is not None and cache.at is not None
    x = rows.x
    more = gpt.positions[cache.at].expand(x.shape).contiguous()
    mask = cache.mask(rows.weight)
    for block, layer in zip(gpt.stack.blocks, cache.layers, strict=True):
        assert isinstance(block, Block)
        projected = _compiled(_project)(block, x, more)
        attended = block.attention.mix(projected, mask, cache=layer)
        x, more = _compiled(_feed)(block, x, more, attended)
    _compiled(_finish)(gpt, rows, x, more)


@cache
def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    return torch.compile(function, fullgraph=True)


def _project(block: Block, x: Tensor, more: Tensor) -> Tensor:
    """Queries, keys and values [B, 1, 3D] of the residual stream x + more [B, 1, D]."""
    qkv = block.attention.qkv
    return product(qkv.weight, qkv.bias, x + more, block.norm_attention).to(qkv.weight.dtype)


def _feed(block: Block, x: Tensor, more: Tensor, attended: Tensor) -> tuple[Tensor, Tensor]:
    """The residual stream behind attention [B, 1, D], and what is yet to be added: the next kernel does."""
    out = block.attention.out
    x = x + more + product(out.weight, out.bias, attended)
    inner = functional.gelu(product(block.ff_in.weight, block.ff_in.bias, x, block.norm_ff))
    return x, product(block.ff_out.weight, block.ff_out.bias, inner)


def _finish(gpt: InterleavedGPT, rows: Rows, x: Tensor, more: Tensor) -> None:
    rows.draw_by(product(rows.weight, rows.bias, x + more, gpt.stack.norm)[:, 0])


def product(weight: Tensor, bias: Tensor, x: Tensor, norm: nn.Module | None = None) -> Tensor:
    """A linear layer [B, 1, E] of x [B, 1, D], behind LayerNorm where one is given."""
    if len(x) > FEW:
        return functional.linear((x if norm is None else norm(x)).to(weight.dtype), weight, bias)
    # Each number of the result normalises x again: there are as many threads as weights, and x is near.
    rows = x.to(torch.promote_types(weight.dtype, torch.float32)).expand(-1, len(weight), -1)
    rows = rows if norm is None else norm(rows)
    return ((weight * rows).sum(-1) + bias)[:, None]


class FixedSteps:
    """Steps of rows of one shape, or of the first rows of it: a network, a cache and rows that stay where
    they are, and are filled for each call.

    The network is a copy, so that weights in training may lie anywhere. Its matrices have the type in which
    their products are computed, as autocast would cast them at each use.
    """

    def __init__(self, shape: object, gpt: InterleavedGPT, rows: Rows) -> None:
        self.shape = shape
        self.gpt, self.rows = copy.deepcopy((gpt, rows))
        for module in self.gpt.requires_grad_(False).modules():
            if isinstance(module, nn.Linear):
                module.to(product_type(module.weight))
        self.cache = self.gpt.stack.cache(self.rows.tokens.shape[1], self.rows.at)
        self.whole = {name: value for name, value in vars(self.rows).items() if isinstance(value, Tensor)}
        """Tensors of all rows."""
        self.advance = advance_fused if product_type(gpt.positions) in _FUSED else advance
        advance(self.gpt, self.rows, self.cache)  # the cache gets its tensors, which no graph could hold
        self.graphs: dict[tuple[int, int], Callable[[], None]] = {}
        """By rows and places."""

    def run(self, gpt: InterleavedGPT, rows: Rows) -> tuple[Tensor, Tensor]:
        """Draw rows of this shape; return as `Rows.run` does."""
        torch._foreach_copy_(list(self.gpt.parameters()), list(gpt.parameters()))
        vars(self.rows).update(self.whole)
        for name, value in self.whole.items():
            value.copy_(getattr(rows, name))
        self.rows.first = rows.first
        self.rows.last = rows.last
        self.cache.clear()
        return self.rows.run(self.step, self.cache.keep)

    def step(self, number: int) -> None:
        """Draw token `number` of all rows that go on."""
        shape = len(self.rows.tokens), (number // ROOM + 1) * ROOM
        if shape not in self.graphs:
            self.graphs[shape] = self.record(partial(self.take, shape[1]))
        self.graphs[shape]()

    def take(self, places: int) -> None:
        self.cache.see(places)
        self.advance(self.gpt, self.rows, self.cache)

    def record(self, step: Callable[[], None]) -> Callable[[], None]:
        """The step as a graph. Where torch.compile fails there is a warning, and it goes on without."""
        from torch._dynamo import config, exc

        if self.advance is advance_fused:
            try:
                with self.unchanged(), config.patch(recompile_limit=_KINDS):
                    step()
            except (exc.TorchDynamoException, exc.FailOnRecompileLimitHit) as error:
                reason = str(getattr(error, "inner_exception", error)).strip() or type(error).__name__
                warnings.warn(
                    f"torch.compile failed, tokens are drawn without: {reason.splitlines()[0]}", stacklevel=2
                )
                self.advance = advance
        with self.unchanged():
            return recorded(step, self.rows.at.device)

    @contextmanager
    def unchanged(self) -> Iterator[None]:
        """Context after which what a step writes is as before; the next fills its place of the cache."""
        assert self.rows.x is not None
        written = self.rows.at, self.rows.tokens, self.rows.x
        before = [one.clone() for one in written]
        yield
        torch._foreach_copy_(written, before)


_KEPT: WeakKeyDictionary[InterleavedGPT, FixedSteps] = WeakKeyDictionary()
"""The steps that a network took last, for the next call of the same shape."""


@torch.inference_mode(False)  # what is kept is written again, which tensors of that mode do not bear outside
@torch.no_grad()
def run_fixed(gpt: InterleavedGPT, rows: Rows) -> tuple[Tensor, Tensor]:
    """Draw rows by steps of fixed shapes; return as `Rows.run` does."""
    assert rows.x is not None
    types = rows.x.dtype, gpt.positions.dtype, product_type(gpt.positions)
    shape = rows.x.shape, rows.tokens.shape, rows.scale is None, rows.how, rows.x.device, types
    # Taken out meanwhile: another thread with the same network makes its own.
    steps = _KEPT.pop(gpt, None)
    if steps is None or steps.shape != shape:
        steps = None  # so that its memory is free for the next
        steps = FixedSteps(shape, gpt, rows)
    made = steps.run(gpt, rows)
    _KEPT[gpt] = steps
    return made
