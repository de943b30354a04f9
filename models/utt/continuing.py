"""Tokens before the first new one: their last groups, where a full block slides to, joining of segments.

Legend: B batch, G groups, P slots of a group.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from motionloom.models.gpt.tokens import Codes


def window_start(count: int, block: int, size: int) -> int:
    """First token that is seen when token number `count` is drawn: 0 while the start vector and all tokens
    before fit into `block` inputs, then by whole halves of the block's groups further.
    """
    if count < block:
        return 0
    hop = max(1, block // size // 2) * size
    return -(-(count + 1 - block) // hop) * hop


def join(first: Codes, second: Codes, pattern: Sequence[str]) -> Codes:
    """The groups of `first`, then those of `second`, row by row; codes after `groups` are 0."""
    groups = first.groups + second.groups
    longest = int(groups.max()) if len(groups) else 0
    codes = {}
    for name, a in first.codes.items():
        per = list(pattern).count(name)
        pool = torch.cat([a, second.codes[name], a.new_zeros(len(a), 1)], dim=1)
        at = torch.arange(longest * per, device=a.device)[None]
        end = first.groups[:, None] * per
        index = torch.where(at < end, at, at - end + a.shape[1])
        index = torch.where(at < groups[:, None] * per, index, pool.shape[1] - 1)
        codes[name] = pool.gather(1, index)
    return Codes(codes, groups)


def last_groups(codes: Codes, pattern: Sequence[str], count: int | None = None) -> tuple[Tensor, Tensor]:
    """The last `count` groups of each row (None: all) as interleaved tokens int64 [B, G * P], 0 after a
    row's own, and their numbers int64 [B].
    """
    groups = codes.groups
    kept = groups if count is None else groups.clamp(max=count)
    most = int(kept.max()) if len(kept) else 0
    at = (groups - kept)[:, None] + torch.arange(most, device=groups.device)
    slots = []
    for slot, name in enumerate(pattern):
        per = list(pattern).count(name)
        groups_of = codes.codes[name].reshape(len(groups), codes.codes[name].shape[1] // per, per)
        here = groups_of[:, :, list(pattern[:slot]).count(name)]
        slots.append(here.gather(1, at.clamp(max=max(0, here.shape[1] - 1))))
    rows = torch.stack(slots, dim=2)
    valid = torch.arange(most, device=groups.device)[None] < kept[:, None]
    return torch.where(valid[..., None], rows, 0).flatten(1), kept
