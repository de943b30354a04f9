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

from motionloom.models.layers.linear import product_type

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
    several = query.shape[2] > 1  # for one query, copying all keys would cost more than the mask does
    if query.is_cuda and half and several and mask is not None and mask.shape[1] == mask.shape[2] == 1:
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


def added_mask(mask: Tensor, x: Tensor) -> Tensor:
    """A mask of visible positions, bool [B, S] or [B, L, S], as attention adds it to the products of heads,
    in the type in which they are computed on x.
    """
    mask = mask[:, None, None, :] if mask.dim() == 2 else mask[:, None]
    kind = product_type(x)
    size = mask.shape[-1]
    # Kernels of GPUs read rows that begin at multiples of 8, and copy others in every layer.
    hidden = F.pad(~mask, (0, -size % 8), value=True)
    return torch.zeros(hidden.shape, dtype=kind, device=x.device).masked_fill_(hidden, -torch.inf)[..., :size]


def to_front(x: Tensor, rows: Tensor, dim: int = 0) -> Tensor:
    """Copy these rows [b] of x to its front; return the front, b rows that share x's memory."""
    front = x.narrow(dim, 0, len(rows))
    front.copy_(x.index_select(dim, rows))
    return front


class LayerCache:
    """Keys and values [2, B, H, size, D/H] of the positions one layer has seen, made at the first append.
    Later appends may be of the first rows only.

    `at` int64 [1] is where the next position is stored, by whoever decodes; without it the cache counts.
    """

    def __init__(self, size: int, at: Tensor | None = None) -> None:
        self.size = size
        self.seen = size
        """Places that a position sees with `at`."""
        self.at = at
        self.length = 0
        self.pairs: Tensor | None = None

    def append(self, pairs: Tensor) -> tuple[Tensor, Tensor]:
        """Store keys and values [2, B, H, L, D/H] of L more positions; return those of all stored so far, or
        with `at` those of `seen` places.
        """
        if self.pairs is None:
            # Zeros, since what a mask hides is still multiplied, by 0.
            self.pairs = pairs.new_zeros((*pairs.shape[:3], self.size, pairs.shape[4]))
        own = self.pairs[:, : pairs.shape[1]]
        if self.at is not None:
            own.index_copy_(3, self.at, pairs)
            return own[0, :, :, : self.seen], own[1, :, :, : self.seen]
        end = self.length + pairs.shape[3]
        if end > self.size:
            raise ValueError(f"the cache holds {self.size} positions, {end} were asked for")
        own[:, :, :, self.length : end] = pairs
        self.length = end
        return own[0, :, :, :end], own[1, :, :, :end]


class KVCache:
    """One `LayerCache` a layer, for step-by-step decoding without gradient.

    With `at` nothing depends on how many positions are stored but for values on the device: each step has the
    same shapes, and attention is over as many places as `see` says, of which a mask hides those behind `at`.
    """

    def __init__(self, layers: int, size: int, at: Tensor | None = None) -> None:
        self.size = size
        self.at = at
        self.layers = [LayerCache(size, at) for _ in range(layers)]
        self._masks: Tensor | None = None

    @property
    def length(self) -> int:
        return self.layers[0].length

    def positions(self, count: int) -> slice | Tensor:
        """Return the indices of the next `count` positions; 1 with `at`."""
        return slice(self.length, self.length + count) if self.at is None else self.at

    def mask(self, x: Tensor) -> Tensor | None:
        """Return the mask that is added at position `at`, [1, 1, 1, seen]; None where all stored is seen."""
        if self.at is None:
            return None
        if self._masks is None:
            visible = torch.ones(self.size, self.size, dtype=torch.bool, device=x.device).tril()
            self._masks = added_mask(visible, x)
        return self._masks.index_select(0, self.at)[..., : self.layers[0].seen]

    def see(self, count: int) -> None:
        """Attend to the first `count` places from here on, with `at`."""
        for layer in self.layers:
            layer.seen = count

    def keep(self, rows: Tensor) -> None:
        """Move these rows [b] to the front; what follows is appended to them alone."""
        for layer in self.layers:
            if layer.pairs is not None:
                to_front(layer.pairs, rows, dim=1)

    def clear(self) -> None:
        """Forget what is stored at the places of `at`."""
        for layer in self.layers:
            if layer.pairs is not None:
                layer.pairs.zero_()


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
        merged: Tensor = self.out(self.mix(self.qkv(x), mask, causal, cache))
        return merged

    def mix(
        self,
        projected: Tensor,
        mask: Tensor | None = None,
        causal: bool = False,
        cache: LayerCache | None = None,
    ) -> Tensor:
        """Attention's sums of values [B, L, D] by queries, keys and values [B, L, 3D]; else as `forward`."""
        batch, length = projected.shape[:2]
        dim = projected.shape[2] // 3
        # Cut along the last dimension: the gradients of the three are put together by one copy, not by two.
        query, key, value = (self._heads(part) for part in projected.chunk(3, dim=-1))
        if cache is not None:
            before = cache.length
            pairs = projected[..., dim:].view(batch, length, 2, self.heads, -1)
            key, value = cache.append(pairs.permute(2, 0, 3, 1, 4))
            if causal and before and length > 1:
                seen = torch.ones(length, before + length, dtype=torch.bool, device=projected.device)
                mask = seen.tril(diagonal=before)
            # A single new position sees everything stored; a first block is plainly causal.
            causal = causal and before == 0 and length > 1
        rate = self.attention_dropout if self.training else 0.0
        causal = causal and mask is None
        out = attention(query, key, value, mask, dropout=rate, causal=causal, scale=self.scale)
        return out.transpose(1, 2).reshape(batch, length, dim)

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
