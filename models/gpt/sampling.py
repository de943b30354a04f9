"""Sampling token sequences: numbers and lengths that all token networks share, and `generate` of the GPT.

Notable choices:
- Every sample owns a counter-based random stream (Philox) keyed by its own seed, and the draw of position i
  is the i-th number of that stream; draws invert the cumulative distribution in float64. So a sample's result
  depends on its text, its seed and the settings, and on nothing else in the batch. Batched matrix products
  round in their own way, so a draw within 1e-6 of a boundary of the distribution can still differ.
- Guidance runs the conditional and the unconditional half in one forward.
- Once half of the rows have ended, the others go on without them.
- On a GPU each token of the GPT is one CUDA graph (`decoding.py`). Matrix products are computed in the type
  of the weights, float32 in every bundle, or as `torch.autocast` around the call says. Half precision is not
  the default: with it, the same seed makes another motion than on a CPU.

Legend: B batch, V vocabulary, G groups, P slots of a group, D width.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from motionloom.datasets.base.errors import UserError
from motionloom.models.gpt.decoding import ROOM, advance, run_fixed
from motionloom.models.gpt.network import InterleavedGPT
from motionloom.models.gpt.rows import Drawing, Rows
from motionloom.models.gpt.tokens import Codes, as_codes
from motionloom.models.layers.frozen import evaluating
from motionloom.models.layers.seeds import sample_seeds as sample_seeds

_PLAIN = Drawing()

_FIXED = {"cuda"}
"""Kinds of devices on which a step has the same shapes all along. Elsewhere attention is over the positions
so far: that is less to compute, and a CPU's sums would be rounded otherwise with hidden places among them."""


def seeds_of(seed: int | Sequence[int], count: int, what: str) -> list[int]:
    """One seed for each of `count` samples of `what`: made of a single one, or as given."""
    seeds = sample_seeds(seed, count) if isinstance(seed, int) else list(seed)
    if len(seeds) != count:
        raise UserError(f"{len(seeds)} seeds were given for {count} {what}")
    return seeds


def uniform_numbers(seeds: Sequence[int], count: int, device: torch.device) -> Tensor:
    """float64 [B, count] in [0, 1), each row by its own seed."""
    if not seeds:
        return torch.zeros(0, count, dtype=torch.float64, device=device)
    rows = [np.random.Generator(np.random.Philox(key=seed)).random(count) for seed in seeds]
    return torch.from_numpy(np.stack(rows)).to(device)


def requested_groups(
    groups: Tensor | None, batch: int, *, most: int, limit: int | None, device: torch.device
) -> Tensor:
    """Where each of `batch` rows stops at the latest, int64 [B].

    Args:
        groups: Requested lengths [B]; None takes `most` for all.
        limit: Longest length that is possible; None without a limit.
    """
    if groups is None:
        found = torch.full((batch,), most, dtype=torch.int64, device=device)
    else:
        found = groups.to(device=device, dtype=torch.int64)
        if found.shape != (batch,):
            raise UserError(f"{tuple(found.shape)} requested lengths were given for {batch} texts")
    low, high = (int(found.min()), int(found.max())) if batch else (1, 1)
    if low < 1 or (limit is not None and high > limit):
        span = "1 or more" if limit is None else f"1 to {limit}"
        raise UserError(f"requested lengths must be {span} groups; got {low} to {high}")
    return found


@torch.no_grad()
def generate(
    gpt: InterleavedGPT,
    text: Tensor,
    *,
    groups: Tensor | None = None,
    how: Drawing = _PLAIN,
    cfg_scale: float = 1.0,
    seed: int | Sequence[int] = 0,
) -> Codes:
    """Sample code streams for text priors (HumanTOMATO section 3.6).

    Args:
        gpt: The model; runs in evaluation mode and is left as it was.
        text: float [B, E].
        groups: int64 [B], requested lengths: End is forbidden before and forced there. None: the model
            decides.
        how: How each token is drawn.
        cfg_scale: Guidance; 1 is off. Needs a model trained with condition dropout.
        seed: One seed, from which `sample_seeds` makes one per row, or one per sample. Pass slices of
            `sample_seeds` to get the same results whatever the batch size is.

    Returns:
        Codes per stream int64 [B, G * per_group], 0 after each sample's `groups`; G is the longest sample's
        length.
    """
    batch = len(text)
    device = text.device
    limit = requested_groups(groups, batch, most=gpt.max_groups, limit=gpt.max_groups, device=device)
    gpt.require_guidance(cfg_scale)
    size = len(gpt.pattern)
    most = int(limit.max()) if batch else 0
    fixed = device.type in _FIXED and batch > 0
    room = -(-most * size // ROOM) * ROOM if fixed else most * size
    # All numbers are drawn before the loop, so that a row does not depend on the others' lengths.
    uniform = uniform_numbers(seeds_of(seed, batch, "texts"), room, device)
    scale = torch.full((batch,), cfg_scale, device=device) if cfg_scale != 1 else None
    start = torch.zeros(batch, room, dtype=torch.int64, device=device)
    before = torch.zeros_like(limit)
    with evaluating(gpt):
        first = gpt.embed_text(text)
        if scale is not None:
            nothing = torch.ones(batch, dtype=torch.bool, device=device)
            first = torch.cat([first, gpt.embed_text(text, nothing)])
        rows = Rows(
            gpt, start, before, limit, first=first, uniform=uniform, free=groups is None, how=how, scale=scale
        )
        if fixed:
            tokens, counts = run_fixed(gpt, rows)
        else:
            cache = gpt.stack.cache(max(1, room))
            tokens, counts = rows.run(lambda _: advance(gpt, rows, cache), cache.keep)
    return as_codes(tokens[:, : most * size].reshape(batch, most, size), gpt.pattern, counts)
