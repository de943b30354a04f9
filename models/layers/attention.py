"""Scaled-dot-product attention of all transformers, and the keys and values that decoding step by step keeps.

- It is always `F.scaled_dot_product_attention`, so fused kernels are used wherever the device has them.
- GPUs' fastest kernels take no mask: keys that all queries of a clip may not see are hidden by a further
  coordinate there.
- Dropout acts on the attention weights; CPUs have no fused kernel for it, so small CPU configs set it to 0.

Legend: B batch, L positions, S visible positions, D width, H heads.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

HIDDEN = -(2.0**15)
"""Product with a hidden key: exact in float16 and bfloat16, and nothing beside others behind the softmax."""


def attention(
    query: Tensor,
    key: Tensor,
    value: Tensor,
    mask: Tensor | None,
    *,
    dropout: float = 0.0,
    causal: bool = False,
    scale: float | None = None,
) -> Tensor:
    """Attention [B, H, L, D/H] of queries to keys and values [B, H, S, D/H]; mask added, or `causal`."""
    half = query.dtype in (torch.float16, torch.bfloat16)  # the fused kernel knows no other type
    if query.is_cuda and half and mask is not None and mask.shape[1] == mask.shape[2] == 1:
        return unmasked_attention(query, key, value, mask, dropout, scale)
    return F.scaled_dot_product_attention(
        query, key, value, mask, dropout_p=dropout, is_causal=causal, scale=scale
    )


def unmasked_attention(
    query: Tensor, key: Tensor, value: Tensor, mask: Tensor, dropout: float, scale: float | None
) -> Tensor:
    """Attention with a mask [B, 1, 1, S] of keys, 0 or -inf, that the kernel is not given.

    Eight more coordinates, as kernels read rows of a multiple of eight numbers, are 1 in every query; in keys
    they are 0 but for one, by which a hidden key is far from all queries. Values have as many for the kernel.
    """
    width = query.shape[-1]
    far = F.pad((mask < 0).to(key.dtype).mT * HIDDEN, (0, 7))
    out = F.scaled_dot_product_attention(
        F.pad(query, (0, 8), value=1.0),
        torch.cat([key, far.expand(*key.shape[:3], 8)], dim=-1),
        F.pad(value, (0, 8)),
        dropout_p=dropout,
        scale=width**-0.5 if scale is None else scale,
    )
    return out[..., :width]


class LayerCache:
    """Keys and values [B, H, size, D/H] of the positions one layer has seen; allocated once, at the first
    append.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self.length = 0
        self.keys: Tensor | None = None
        self.values: Tensor | None = None

    def append(self, keys: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
        """Store [B, H, L, D/H] more positions; return everything stored so far."""
        if self.keys is None or self.values is None:
            shape = (keys.shape[0], keys.shape[1], self.size, keys.shape[3])
            self.keys, self.values = keys.new_empty(shape), values.new_empty(shape)
        end = self.length + keys.shape[2]
        if end > self.size:
            raise ValueError(f"the cache holds {self.size} positions, {end} were asked for")
        self.keys[:, :, self.length : end] = keys
        self.values[:, :, self.length : end] = values
        self.length = end
        return self.keys[:, :, :end], self.values[:, :, :end]


class KVCache:
    """One `LayerCache` a layer, for step-by-step decoding without gradient."""

    def __init__(self, layers: int, size: int) -> None:
        self.layers = [LayerCache(size) for _ in range(layers)]

    @property
    def length(self) -> int:
        return self.layers[0].length


class SelfAttention(nn.Module):
    """Multi-head self-attention."""

    def __init__(self, dim: int, heads: int, attention_dropout: float, qkv_bias: bool = True) -> None:
        super().__init__()
        self.heads = heads
        self.attention_dropout = attention_dropout
        self.scale: float | None = None
        """Factor of the products of queries and keys; None is the width of a head to the power of -1/2."""
        self.qkv = nn.Linear(dim, 3 * dim, bias=qkv_bias)
        self.out = nn.Linear(dim, dim)

    def forward(
        self, x: Tensor, mask: Tensor | None = None, causal: bool = False, cache: LayerCache | None = None
    ) -> Tensor:
        """x [B, L, D]; mask bool or added, broadcastable to [B, H, L, S], or `causal`; with a cache x goes on
        behind it.
        """
        batch, length, dim = x.shape
        # Cut along the last dimension: the gradients of the three are put together by one copy, not by two.
        query, key, value = (self._heads(part) for part in self.qkv(x).chunk(3, dim=-1))
        if cache is not None:
            before = cache.length
            key, value = cache.append(key, value)
            if causal and before and length > 1:
                seen = torch.ones(length, before + length, dtype=torch.bool, device=x.device)
                mask = seen.tril(diagonal=before)
            # A single new position sees everything stored; a first block is plainly causal.
            causal = causal and before == 0 and length > 1
        rate = self.attention_dropout if self.training else 0.0
        causal = causal and mask is None
        out = attention(query, key, value, mask, dropout=rate, causal=causal, scale=self.scale)
        merged: Tensor = self.out(out.transpose(1, 2).reshape(batch, length, dim))
        return merged

    def _heads(self, x: Tensor) -> Tensor:
        return x.view(*x.shape[:2], self.heads, -1).transpose(1, 2)


class CrossAttention(SelfAttention):
    """Multi-head attention to another sequence of the same width; the weights are laid out as its base's."""

    def attend(self, x: Tensor, memory: Tensor, mask: Tensor | None = None) -> Tensor:
        """x [B, L, D], memory [B, S, D]; mask bool or added, broadcastable to [B, H, L, S]."""
        sizes = [x.shape[2], 2 * x.shape[2]]
        parts = (torch.split(whole, sizes) for whole in (self.qkv.weight, self.qkv.bias))
        of_query, of_pairs = zip(*parts, strict=True)
        query = self._heads(F.linear(x, *of_query))
        pairs = F.linear(memory, *of_pairs)
        key, value = (self._heads(half) for half in pairs.chunk(2, dim=-1))
        rate = self.attention_dropout if self.training else 0.0
        out = attention(query, key, value, mask, dropout=rate)
        merged: Tensor = self.out(out.transpose(1, 2).reshape(x.shape))
        return merged
