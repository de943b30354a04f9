"""The UTT's network over a prefix and motion tokens: a transformer, or a GRU (UDE Table 3).

Both take a prefix [B, S, D] whose padding a mask marks, and inputs [B, L, D] that may see the whole prefix
and the inputs up to themselves. `forward` does all at once, for training; `begin` and `extend` do the same
step by step, for sampling, and give the same numbers.

- The transformer lets the prefix see all of itself (full attention) and no motion; motion sees the prefix
  and, causally, motion (section 3.3: "we don't mask the region of conditions").
- The GRU reads prefix and motion one after another, the recurrent reading of the same input. It reads the
  global embedding, the prefix's first position, last, so that a long sequence does not make it forget it
  [ours]; its blocks are pre-norm with a residual path, without which eight of them hardly train [ours].

Legend: B batch, S prefix, L inputs, N inputs so far, D width.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from motionloom.models.layers.attention import KVCache
from motionloom.models.layers.transformer import LayerNorm, Transformer, length_mask


@dataclass
class State:
    """State of step-by-step decoding."""

    mask: Tensor
    """bool [B, S], the prefix's real positions."""
    cache: KVCache | None = None
    hidden: list[Tensor] | None = None
    """Per GRU layer [1, B, D]."""


class PrefixTransformer(nn.Module):
    """The GPT of UDE: full attention within the prefix, causal attention after it."""

    def __init__(self, stack: Transformer) -> None:
        super().__init__()
        self.stack = stack

    def forward(self, prefix: Tensor, mask: Tensor, x: Tensor) -> Tensor:
        """Prefix [B, S, D], mask bool [B, S], x [B, L, D] -> the states of x, [B, L, D]."""
        visible = prefix_mask(mask, x.shape[1])
        out: Tensor = self.stack(torch.cat([prefix, x], dim=1), visible)
        return out[:, prefix.shape[1] :]

    def begin(self, prefix: Tensor, mask: Tensor, size: int) -> State:
        """Read the prefix, with room for `size` inputs."""
        cache = self.stack.cache(prefix.shape[1] + size)
        self.stack(prefix, mask, cache=cache)
        return State(mask, cache=cache)

    def extend(self, x: Tensor, state: State) -> Tensor:
        cache = state.cache
        assert cache is not None  # `begin` made it
        before = cache.length - state.mask.shape[1]
        visible = _behind(state.mask, before, x.shape[1])
        out: Tensor = self.stack(x, visible, cache=cache)
        return out


class PrefixGru(nn.Module):
    """The GRU of Table 3."""

    def __init__(self, layers: int, dim: int, *, dropout: float) -> None:
        super().__init__()
        self.norms = nn.ModuleList(LayerNorm(dim) for _ in range(layers))
        self.layers = nn.ModuleList(nn.GRU(dim, dim, batch_first=True) for _ in range(layers))
        self.dropout = nn.Dropout(dropout)
        self.norm = LayerNorm(dim)

    def forward(self, prefix: Tensor, mask: Tensor, x: Tensor) -> Tensor:
        return self.extend(x, self.begin(prefix, mask, x.shape[1]))

    def begin(self, prefix: Tensor, mask: Tensor, size: int) -> State:
        """Read the prefix; a GRU needs no room, so `size` is ignored."""
        # The first position last, before it the others' real ones, in order; padding goes after them all,
        # where it is not read any more.
        prefix = prefix.roll(-1, dims=1)
        mask = mask.roll(-1, dims=1)
        order = (~mask).long().argsort(dim=1, stable=True)
        x = prefix.gather(1, order[..., None].expand_as(prefix))
        last = (mask.sum(1) - 1).clamp(min=0)[:, None, None].expand(-1, 1, x.shape[2])
        hidden = []
        for norm, layer in zip(self.norms, self.layers, strict=True):
            out, _ = layer(norm(x))
            hidden.append(out.gather(1, last).transpose(0, 1))
            x = x + self.dropout(out)
        return State(mask.roll(1, dims=1), hidden=hidden)

    def extend(self, x: Tensor, state: State) -> Tensor:
        assert state.hidden is not None  # `begin` made it
        after = []
        for norm, layer, before in zip(self.norms, self.layers, state.hidden, strict=True):
            out, end = layer(norm(x), before.contiguous())
            after.append(end)
            x = x + self.dropout(out)
        state.hidden = after
        result: Tensor = self.norm(x)
        return result


def prefix_mask(mask: Tensor, size: int) -> Tensor:
    """Bool [B, S + L, S + L] of what may be seen: mask bool [B, S] of the prefix, `size` = L inputs."""
    batch, prefix = mask.shape
    above = torch.cat([mask, mask.new_zeros(batch, size)], dim=1)[:, None].expand(-1, prefix, -1)
    return torch.cat([above, _behind(mask, 0, size)], dim=1)


def _behind(mask: Tensor, before: int, size: int) -> Tensor:
    """Bool [B, L, S + N + L]: what L inputs see that follow N others."""
    earlier = length_mask(torch.arange(before + 1, before + size + 1, device=mask.device), before + size)
    return torch.cat([mask[:, None].expand(-1, size, -1), earlier.expand(len(mask), -1, -1)], dim=2)
