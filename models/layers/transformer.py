"""Transformer blocks shared by all networks: GELU, attention, optional KV cache.

Notable choices:
- LayerNorm comes before attention and feed-forward ("pre"), as in the GPTs. With "post" it comes after their
  sums, as in torch's own encoder, which TEMOS, TMR and MDM are made of.
- Masks are boolean and mark what *may* be attended (True = visible). A stack turns its masks into the numbers
  that are added to the products once; SDPA would in every layer.
- A causal stack needs no padding mask when sequences are padded on the right: real positions never see
  padding.
- Dropout acts on the residual branches (`dropout`), of "post" also inside the feed-forward as torch's does,
  and on the attention weights (`attention_dropout`).

Legend: B batch, L positions, S visible positions, D width, H heads.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal, Self

import torch
import torch.nn.functional as F
from pydantic import Field, model_validator
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from motionloom.datasets.base.config import Config
from motionloom.models.layers.attention import CrossAttention, KVCache, LayerCache, SelfAttention, added_mask
from motionloom.models.layers.linear import product_type

Norm = Literal["pre", "post"]
"""Position of LayerNorm: before attention and feed-forward, or after their sums."""


def length_mask(length: Tensor, size: int) -> Tensor:
    """Bool [B, size], True at the first `length[b]` positions of row b."""
    return torch.arange(size, device=length.device)[None, :] < length[:, None]


def sinusoid(size: int, dim: int, device: torch.device | None = None) -> Tensor:
    """Fixed sine/cosine position codes, float32 [size, dim]."""
    return waves(torch.arange(size, device=device), dim)


def waves(position: Tensor, dim: int) -> Tensor:
    """Codes of positions [L] or time steps: sine and cosine in turn, float32 [L, dim]."""
    rate = torch.arange(0, dim, 2, device=position.device, dtype=torch.float32)
    angle = position[:, None].float() * torch.exp(rate * (-math.log(10000.0) / dim))
    return torch.stack([angle.sin(), angle.cos()], dim=-1).flatten(1)[:, :dim]


class StackConfig(Config):
    """Sizes of a transformer; subclasses choose defaults and have a width `dim`."""

    heads: int = Field(default=8, ge=1)
    ff: int = Field(default=1024, ge=1)
    """Width of the feed-forward layers."""
    dropout: float = Field(default=0.1, ge=0, lt=1)

    @property
    def width(self) -> tuple[str, int] | None:
        """Name and value of the width that `heads` must divide; None where there are no heads."""
        return "dim", int(getattr(self, "dim"))  # noqa: B009 - not every width is a field of this name

    @model_validator(mode="after")
    def _heads_divide(self) -> Self:
        if self.width is not None and self.width[1] % self.heads:
            name, value = self.width
            raise ValueError(f"{name} {value} must be a multiple of heads {self.heads}")
        return self


class LayerNorm(nn.LayerNorm):
    """Computes in the type of its weights under autocast too, as CUDA's autocast has it: a CPU's kernel for
    mixed types adds up the gradients of the weights in bfloat16, which leaves half of them wrong.
    """

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x.to(self.weight.dtype))


class Block(nn.Module):
    """Transformer block: attention, attention to a memory where there is one, then a GELU feed-forward."""

    def __init__(
        self,
        dim: int,
        heads: int,
        ff: int,
        dropout: float,
        attention_dropout: float,
        norm: Norm = "pre",
        memory: bool = False,
        qkv_bias: bool = True,
    ) -> None:
        super().__init__()
        self.post = norm == "post"
        self.norm_attention = LayerNorm(dim)
        self.attention = SelfAttention(dim, heads, attention_dropout, qkv_bias)
        if memory:
            self.norm_memory = LayerNorm(dim)
            self.memory = CrossAttention(dim, heads, attention_dropout)
        self.norm_ff = LayerNorm(dim)
        self.ff_in = nn.Linear(dim, ff)
        self.ff_out = nn.Linear(ff, dim)
        self.dropout = nn.Dropout(dropout)

    def forward(
        self,
        x: Tensor,
        mask: Tensor | None = None,
        causal: bool = False,
        cache: LayerCache | None = None,
        memory: Tensor | None = None,
        memory_mask: Tensor | None = None,
    ) -> Tensor:
        if self.post:
            x = self.norm_attention(x + self.dropout(self.attention(x, mask, causal, cache)))
            if memory is not None:
                x = self.norm_memory(x + self.dropout(self.memory.attend(x, memory, memory_mask)))
            last: Tensor = self.norm_ff(x + self.dropout(self._feed(x)))
            return last
        x = x + self.dropout(self.attention(self.norm_attention(x), mask, causal, cache))
        if memory is not None:
            x = x + self.dropout(self.memory.attend(self.norm_memory(x), memory, memory_mask))
        out: Tensor = x + self.dropout(self._feed(self.norm_ff(x)))
        return out

    def _feed(self, x: Tensor) -> Tensor:
        inner = F.gelu(self.ff_in(x))
        out: Tensor = self.ff_out(self.dropout(inner) if self.post else inner)
        return out


def name_in_torch(name: str, *, memory: bool = False) -> str:
    """Name of a block's tensor in torch's encoder layer; of a block with `memory` in its decoder layer."""
    part, _, kind = name.rpartition(".")
    if part.endswith("qkv"):
        return f"{'multihead_attn' if part == 'memory.qkv' else 'self_attn'}.in_proj_{kind}"
    known = {
        "attention.out": "self_attn.out_proj", "memory.out": "multihead_attn.out_proj", "ff_in": "linear1",
        "ff_out": "linear2", "norm_attention": "norm1", "norm_memory": "norm2",
        "norm_ff": "norm3" if memory else "norm2",
    }  # fmt: skip
    return f"{known[part]}.{kind}"


class Transformer(nn.Module):
    """A stack of blocks and, of pre-norm blocks, a last LayerNorm. With `memory` each block also attends to
    another sequence, which `forward` then takes.

    Weights start at N(0, 2 / (5 dim)), which is GPT-2's 0.02 at width 1024 and grows with narrower stacks so
    that attention carries signal from the first step; outputs into the residual stream are smaller by sqrt(2
    layers).
    """

    def __init__(
        self,
        config: StackConfig,
        layers: int,
        *,
        attention_dropout: float | None = None,
        norm: Norm = "pre",
        memory: bool = False,
        qkv_bias: bool = True,
        last_norm: bool = True,
    ) -> None:
        super().__init__()
        assert config.width is not None
        dim = config.width[1]
        drop = config.dropout
        inner = drop if attention_dropout is None else attention_dropout
        self.blocks = nn.ModuleList(
            Block(dim, config.heads, config.ff, drop, inner, norm, memory, qkv_bias) for _ in range(layers)
        )
        self.norm = LayerNorm(dim) if norm == "pre" and last_norm else nn.Identity()
        self.checkpointed = False
        """Compute the inside of each block again in the backward pass instead of keeping it."""
        self.half_residual = False
        """Sum the blocks' outputs in bfloat16 where products are computed in it."""
        std = math.sqrt(2 / (5 * dim))
        for name, parameter in self.named_parameters():
            if parameter.dim() == 2:
                residual = name.endswith((".out.weight", "ff_out.weight"))
                nn.init.normal_(parameter, std=std / math.sqrt(2 * layers) if residual else std)
            elif name.endswith("bias"):
                nn.init.zeros_(parameter)

    def forward(
        self,
        x: Tensor,
        mask: Tensor | None = None,
        causal: bool = False,
        cache: KVCache | None = None,
        memory: Tensor | None = None,
        memory_mask: Tensor | None = None,
    ) -> Tensor:
        """x [B, L, D]; mask bool [B, L] of visible positions or [B, L, S], or `causal`; cache to decode;
        memory [B, M, D] and its mask [B, M] or [B, L, M].
        """
        added, beside = (None if one is None else added_mask(one, x) for one in (mask, memory_mask))
        if mask is None and cache is not None:
            added = cache.mask(x)
        if self.half_residual:
            x = x.to(product_type(x))
        given = (added, causal)
        seen = (memory, beside)

        def step(index: int, x: Tensor) -> Tensor:
            if cache is None:
                return self.through(self.blocks[index], x, *given, None, *seen)
            out: Tensor = self.blocks[index](x, *given, cache.layers[index], *seen)
            return out

        out: Tensor = self.norm(self.walk(x, step))
        return out

    def walk(self, x: Tensor, step: Callable[[int, Tensor], Tensor]) -> Tensor:
        """Through all blocks; `step` goes through one, by its number."""
        for index in range(len(self.blocks)):
            x = step(index, x)
        return x

    def through(self, block: nn.Module, x: Tensor, *given: object) -> Tensor:
        """One block, whose inside may be computed again in the backward pass."""
        if self.checkpointed and torch.is_grad_enabled():
            again: Tensor = checkpoint(block, x, *given, use_reentrant=False)
            return again
        out: Tensor = block(x, *given)
        return out

    def cache(self, size: int, at: Tensor | None = None) -> KVCache:
        """An empty cache of `size` positions for this stack; with `at` int64 [1] they are stored there."""
        return KVCache(len(self.blocks), size, at)


class SkipTransformer(Transformer):
    """Post-norm blocks in a U and a last LayerNorm: what the blocks of the first half make is merged, last
    one first, into what those of the second half read (MLD).

    Weights start as by Glorot.
    """

    def __init__(self, config: StackConfig, layers: int, **kind: Any) -> None:
        if layers % 2 == 0:
            raise ValueError(f"a U of {layers} layers has no middle; take an odd number")
        super().__init__(config, layers, norm="post", **kind)
        dim = config.width[1] if config.width else 0
        self.merge = nn.ModuleList(nn.Linear(2 * dim, dim) for _ in range(layers // 2))
        self.norm = LayerNorm(dim)
        for parameter in self.parameters():
            if parameter.dim() == 2:
                nn.init.xavier_uniform_(parameter)

    def walk(self, x: Tensor, step: Callable[[int, Tensor], Tensor]) -> Tensor:
        half = len(self.merge)
        kept: list[Tensor] = []  # `list[Tensor]()` is none of torch.compile's words
        for index in range(len(self.blocks)):
            if index > half:
                x = self.merge[index - half - 1](torch.cat([x, kept.pop()], dim=-1))
            x = step(index, x)
            if index < half:
                kept.append(x)
        return x
