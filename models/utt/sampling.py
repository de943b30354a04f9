"""Sampling motion tokens from a `Utt`: cached, guided, of any length, and continuing other tokens.

Notable choices:
- Noise and draws come from counter-based streams keyed by each sample's own seed, as in `gpt/sampling.py`: a
  sample depends on its conditions, its seed and the settings, and on nothing else in the batch.
- `start` gives tokens that come before the first new one, e.g. those of a segment with other conditions, so
  that a motion goes on across a change from text to music (UDE section 4.4) [ours].
- When the block is full, the older half of the groups in it is dropped and the rest is read again from the
  first position on [ours]. Where that happens depends on the number of tokens alone.

Legend: B batch, G groups, P slots of a group.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from motionloom.datasets.base.errors import UserError
from motionloom.models.condition.mate import Encoded
from motionloom.models.gpt.rows import Drawing, Rows
from motionloom.models.gpt.sampling import requested_groups, seeds_of, uniform_numbers
from motionloom.models.gpt.tokens import Codes, as_codes, slot_codes
from motionloom.models.layers.frozen import evaluating
from motionloom.models.utt.backbone import State
from motionloom.models.utt.network import Utt


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
    slots = slot_codes(codes.codes, pattern)
    rows = slots.gather(1, at.clamp(max=max(0, slots.shape[1] - 1))[..., None].expand(-1, -1, slots.shape[2]))
    valid = torch.arange(most, device=groups.device)[None] < kept[:, None]
    return torch.where(valid[..., None], rows, 0).flatten(1), kept


def draw_z(seeds: Sequence[int], dim: int) -> Tensor:
    """z ~ N(0, I), float32 [B, dim], each row from its own seed; not the numbers its tokens are drawn by."""
    rows = [
        np.random.Generator(np.random.Philox(key=seed + (1 << 64))).standard_normal(dim) for seed in seeds
    ]
    return torch.from_numpy(np.stack(rows)).float() if rows else torch.zeros(0, dim)


@torch.no_grad()
def generate(
    utt: Utt,
    condition: Encoded,
    *,
    null: Encoded | None = None,
    inject_z: bool = True,
    z: Tensor | None = None,
    start: Codes | None = None,
    context: int | None = None,
    max_groups: int | None = None,
    groups: Tensor | None = None,
    how: Drawing = Drawing(),  # noqa: B008 - frozen
    cfg_scale: float | Sequence[float] = 1.0,
    seed: int | Sequence[int] = 0,
) -> Codes:
    """Sample code streams for embedded conditions (UDE section 3.3).

    Args:
        utt: The model; runs in evaluation mode and is left as it was.
        condition: MATE's embeddings of B rows.
        null: MATE's unconditional embeddings of B rows; guidance needs them.
        inject_z: Draw z by each sample's seed; False generates without noise (Tables 3 and 5).
        z: Noise [B, z_dim] in its place, such as that of the segment before.
        start: Tokens before the first new one, B rows.
        context: Groups of `start` that count, the last ones (default: all).
        max_groups: Most new groups (default: what one block holds). Longer ones slide.
        groups: int64 [B], requested numbers of new groups: End is forbidden before and forced there. None:
            the model decides.
        how: How each token is drawn.
        cfg_scale: Guidance, one for all rows or one each; 1 is off. Needs a model trained with condition
            dropout.
        seed: One seed, from which `sample_seeds` makes one per row, or one per sample.

    Returns:
        The new codes per stream int64 [B, G * per_group], 0 after each sample's `groups`.
    """
    batch = len(condition.glob)
    device = condition.glob.device
    scales = [cfg_scale] * batch if isinstance(cfg_scale, (int, float)) else list(cfg_scale)
    if len(scales) != batch:
        raise UserError(f"{len(scales)} strengths of guidance were given for {batch} conditions")
    guided = any(scale != 1 for scale in scales)
    _check(utt, guided, null, max_groups, context)
    most_groups = max_groups or utt.max_groups
    limit = requested_groups(groups, batch, most=most_groups, limit=max_groups, device=device)
    seeds = seeds_of(seed, batch, "conditions")
    if start is None:
        none = torch.zeros(batch, 0, dtype=torch.int64, device=device)
        start = Codes(dict.fromkeys(utt.names, none), torch.zeros_like(limit))
    if len(start.groups) != batch:
        raise UserError(f"{len(start.groups)} starts were given for {batch} conditions")
    # Only the last groups of the start fit into the block beside what is new.
    given, before = last_groups(start, utt.pattern, context)
    size = len(utt.pattern)
    most = int(limit.max()) * size if batch else 0
    uniform = uniform_numbers(seeds, most, device)
    if not (inject_z and utt.config.z_dim):
        z = None
    elif z is None:
        z = draw_z(seeds, utt.config.z_dim).to(device)
    scale = torch.tensor(scales, device=device) if guided else None
    # Under guidance both passes are rows of one batch: the network is called once a token.
    if guided and null is not None:
        condition = _stacked(condition, null)
        z = None if z is None else torch.cat([z, z])
    frame_condition = utt.frame_condition(condition)
    rows = Rows(utt, given, before, limit, uniform=uniform, free=groups is None, how=how, scale=scale)
    state: State | None = None
    seen = opened = 0

    def draw(step: int) -> None:
        nonlocal state, seen, opened
        # Where the window has moved on, its positions are numbered anew and the cache is of no use.
        first = window_start(step, utt.config.block_size, size)
        fresh = state is None or first != opened
        if state is None or fresh:
            state = utt.begin(condition, z)
            seen = first
            opened = first
        kinds = utt.slots[torch.arange(seen, step, device=device) % size].expand(batch, -1)
        x = utt.embed(rows.tokens[:, seen:step], kinds)
        at = 0 if fresh else seen - first + 1
        x = utt.motion_inputs(x.repeat(2, 1, 1) if guided else x, at, frame_condition, first=first)
        seen = step
        rows.draw(utt.backbone.extend(x, state)[:, -1:])

    with evaluating(utt):
        tokens, counts = rows.run(draw)
    longest = int(counts.max()) if batch else 0
    # Rows start behind starts of different lengths; the result begins with each row's first new group.
    at = before[:, None] * size + torch.arange(longest * size, device=device)
    new = tokens.gather(1, at.clamp(max=max(0, tokens.shape[1] - 1))).view(batch, longest, size)
    return as_codes(new, utt.pattern, counts)


def _stacked(condition: Encoded, null: Encoded) -> Encoded:
    """Conditional rows, then the unconditional ones, padded to the longer sequence."""
    size = condition.seq.shape[1] - null.seq.shape[1]
    first, second = (
        Encoded(c.glob, pad(c.seq, (0, 0, 0, max(0, more))), pad(c.mask, (0, max(0, more))), c.timed)
        for c, more in ((condition, -size), (null, size))
    )
    timed = first.timed
    if timed is not None:
        # Guidance goes away from no music at all.
        timed = torch.cat([timed, torch.zeros_like(timed)])
    glob, seq, mask = (torch.cat(both) for both in zip(first[:3], second[:3], strict=True))
    return Encoded(glob, seq, mask, timed)


def _check(utt: Utt, guided: bool, null: Encoded | None, max_groups: int | None, context: int | None) -> None:
    if max_groups is not None and max_groups < 1:
        raise UserError(f"max_groups {max_groups} must be at least 1")
    if context is not None and context < 0:
        raise UserError(f"context {context} must not be negative; 0 starts afresh")
    if guided and (utt.config.condition_dropout == 0 or null is None):
        raise UserError(
            "guidance needs a UTT trained with condition_dropout > 0 and its unconditional embedding; set "
            "cfg_scale to 1"
        )
