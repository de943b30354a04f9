"""Whether the shares of ranks and parts, one after another, are the batches of a single process."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

from motionloom.datasets.loading.plan import ALONE, Share


def require_shares(
    build: Callable[[Share], Any], batches: Iterable[int] = (0, 4, 9), worlds: Iterable[int] = (2, 3)
) -> None:
    """`build` gives the batches by number."""
    for k in batches:
        whole = build(ALONE)[k]
        for world, parts in [(1, 2), *((world, 1) for world in worlds), (2, 2)]:
            shares = [
                build(Share(rank, world, parts))[k * parts + part]
                for part in range(parts)
                for rank in range(world)
            ]
            require_rows(whole, shares)


def require_rows(whole: Any, parts: list[Any]) -> None:
    """Tensors, lists, tuples and dicts of them; a share is padded to its own longest row."""
    if isinstance(whole, dict):
        for name in whole:
            require_rows(whole[name], [part[name] for part in parts])
    elif isinstance(whole, tuple):
        for values in zip(whole, *parts, strict=True):
            require_rows(values[0], list(values[1:]))
    elif isinstance(whole, list):
        assert whole == [row for part in parts for row in part]
    elif isinstance(whole, Tensor):
        rows = whole.split([len(part) for part in parts])
        for ours, part in zip(rows, parts, strict=True):
            assert torch.equal(ours[tuple(slice(size) for size in part.shape)], part)
