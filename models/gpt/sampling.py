"""Sampling token sequences: draws and the loop that all token networks share, and `generate` of the GPT.

Notable choices:
- Every sample owns a counter-based random stream (Philox) keyed by its own seed, and the draw of position i
  is the i-th number of that stream; draws invert the cumulative distribution in float64. So a sample's result
  depends on its text, its seed and the settings, and on nothing else in the batch. Batched matrix products
  round in their own way, so a draw within 1e-6 of a boundary of the distribution can still differ.
- Guidance runs the conditional and the unconditional half in one forward.

Legend: B batch, V vocabulary, G groups, P slots of a group.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from motionloom.datasets.schema import UserError
from motionloom.models.gpt.network import InterleavedGPT
from motionloom.models.gpt.tokens import Codes, TokenNetwork, as_codes
from motionloom.models.layers.frozen import evaluating
from motionloom.models.layers.seeds import sample_seeds as sample_seeds


@dataclass(frozen=True)
class Drawing:
    """How one token is taken from a distribution; `UserError` where that is impossible."""

    temperature: float = 1.0
    """0 takes the likeliest."""
    top_k: int | None = None
    """Keep the k most likely tokens."""
    top_p: float = 1.0
    """Keep the smallest set of tokens with this mass."""

    def __post_init__(self) -> None:
        if self.temperature < 0:
            raise UserError(f"temperature {self.temperature} must not be negative; 0 is greedy")
        if self.top_k is not None and self.top_k < 1:
            raise UserError(f"top_k {self.top_k} must be at least 1; leave it out to keep every token")
        if not 0 < self.top_p <= 1:
            raise UserError(f"top_p {self.top_p} must be above 0 and at most 1")

    def __call__(self, logits: Tensor, uniform: Tensor) -> Tensor:
        """Tokens int64 [B] from logits [B, V] and uniform float64 [B]."""
        best = logits.argmax(-1)
        if self.temperature == 0:
            return best
        scaled = filter_logits(logits.double() / self.temperature, top_k=self.top_k, top_p=self.top_p)
        # In whole numbers, which a GPU adds up to the same sums every time.
        mass = (scaled.softmax(-1) * 2**53).long().cumsum(-1)
        at = torch.searchsorted(mass, (uniform[:, None] * mass[:, -1:]).long(), right=True)[:, 0]
        # Rounding can push the last number onto the total; there is no token after it.
        return torch.where(at < logits.shape[-1], at, best)


def guide(logits: Tensor, legal: Tensor, scale: Tensor) -> Tensor:
    """Guided logits [B, V] of the conditional and the unconditional half [2B, V]; -inf where not `legal`
    [B, V].

    `scale` is each row's strength [B]; a row of 1 is as without guidance, to the bit.
    """
    on, off = logits.chunk(2)
    strength = scale.to(logits.dtype)[:, None]
    mixed = torch.where(strength == 1, on, off + strength * (on - off))
    return torch.where(legal, mixed, -torch.inf)


def filter_logits(logits: Tensor, *, top_k: int | None = None, top_p: float = 1.0) -> Tensor:
    """Set all but the `top_k` largest, then all outside the smallest set of mass `top_p`, to -inf; [B, V]."""
    if top_k is not None and top_k < logits.shape[-1]:
        smallest = logits.topk(top_k, dim=-1).values[..., -1:]
        logits = logits.masked_fill(logits < smallest, -torch.inf)
    if top_p < 1:
        ordered, index = logits.sort(dim=-1, descending=True)
        probability = ordered.softmax(-1)
        # A token stays while the mass before it is below top_p, so the largest one always does.
        outside = probability.cumsum(-1) - probability >= top_p
        logits = logits.masked_fill(torch.zeros_like(outside).scatter(-1, index, outside), -torch.inf)
    return logits


def seeds_of(seed: int | Sequence[int], count: int, what: str) -> list[int]:
    """One seed for each of `count` samples of `what`: made of a single one, or as given."""
    seeds = sample_seeds(seed, count) if isinstance(seed, int) else list(seed)
    if len(seeds) != count:
        raise UserError(f"{len(seeds)} seeds were given for {count} {what}")
    return seeds


def uniform_numbers(seeds: Sequence[int], count: int, device: torch.device) -> Tensor:
    """float64 [B, count] in [0, 1), each row by its own seed."""
    if not seeds:
        return torch.zeros(0, 0)
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


def decode(
    network: TokenNetwork,
    hidden: Callable[[int, Tensor], Tensor],
    start: Tensor,
    before: Tensor,
    limit: Tensor,
    *,
    uniform: Tensor,
    free: bool,
    how: Drawing,
    scale: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Draw tokens one by one; all of them int64 [B, N * P], those of `start` included, and the numbers of new
    groups int64 [B].

    Args:
        hidden: The network's output at a position [B, 1, D] ([2B, 1, D] under guidance), given its number and
            the tokens int64 [B, N * P] of which those before it are known. Called with ascending numbers.
        start: Tokens [B, M * P] of `before` [B] groups a row; the others are drawn.
        limit: New groups at which each row must stop, int64 [B].
        uniform: Draws float64 [B, most new tokens] in [0, 1).
        free: Whether rows may draw End before their limit.
        scale: Each row's guidance [B]; None without.
    """
    batch, size = len(limit), len(network.pattern)
    total = int((before + limit).max()) * size if batch else 0
    tokens = functional.pad(start, (0, max(0, total - start.shape[1])))
    counts = torch.zeros_like(limit)
    ended = torch.zeros_like(limit, dtype=torch.bool)
    no = torch.zeros_like(ended)
    for step in range(int(before.min()) * size if batch else 0, total):
        group, slot = divmod(step, size)
        new = group >= before
        # Rows that only read their start are not alive yet, and those behind their End not any more.
        alive = new & (group < before + limit) & ~ended
        if slot == 0 and not bool((alive | ~new).any()):
            break
        # A motion is never empty, so its first group cannot be End.
        may_end = alive & (group > before) if free and slot == 0 else no
        # Numbers count from a row's first new token, whatever it starts from.
        index = (step - before * size).clamp(0, uniform.shape[1] - 1)
        own = uniform.gather(1, index[:, None])[:, 0]
        kind = network.slots[slot]
        legal = network.legal_at(network.ends[kind].expand(batch), may_end, no)
        rows = legal if scale is None else legal.repeat(2, 1)
        logits = network.logits(hidden(step, tokens), kind.expand(len(rows), 1), rows[:, None])[:, 0]
        token = how(logits if scale is None else guide(logits, legal, scale), own)
        if slot == 0:
            stops = alive & (token == network.ends[network.slots[0]])
            ended, alive = ended | stops, alive & ~stops
            counts = counts + alive
        tokens[:, step] = torch.where(new, torch.where(alive, token, 0), tokens[:, step])
    return tokens, counts


@torch.no_grad()
def generate(
    gpt: InterleavedGPT,
    text: Tensor,
    *,
    groups: Tensor | None = None,
    how: Drawing = Drawing(),
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
    batch, device = len(text), text.device
    limit = requested_groups(groups, batch, most=gpt.max_groups, limit=gpt.max_groups, device=device)
    gpt.require_guidance(cfg_scale)
    size, most = len(gpt.pattern), int(limit.max()) if batch else 0
    # All numbers are drawn before the loop, so that a row does not depend on the others' lengths.
    uniform = uniform_numbers(seeds_of(seed, batch, "texts"), most * size, device)
    scale = torch.full((batch,), cfg_scale, device=device) if cfg_scale != 1 else None
    cache = gpt.stack.cache(max(1, most * size))

    def hidden(step: int, tokens: Tensor) -> Tensor:
        if step:
            x = gpt.embed(tokens[:, step - 1 : step], gpt.slots[(step - 1) % size].expand(batch, 1))
            # Both passes of guidance read the tokens that were drawn under guidance.
            x = x if scale is None else torch.cat([x, x])
        else:
            x = gpt.embed_text(text)
            if scale is not None:
                x = torch.cat([x, gpt.embed_text(text, torch.ones(batch, dtype=torch.bool, device=device))])
        return gpt.hidden(x, cache)

    start, before = torch.zeros(batch, 0, dtype=torch.int64, device=device), torch.zeros_like(limit)
    with evaluating(gpt):
        tokens, counts = decode(
            gpt, hidden, start, before, limit, uniform=uniform, free=groups is None, how=how, scale=scale
        )
    return as_codes(tokens.view(batch, most, size), gpt.pattern, counts)
