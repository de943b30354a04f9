"""Sampling token sequences from an `InterleavedGPT`: KV cache, batches, guidance, requested lengths, seeds.

Notable choices:
- Draws are those of `drawing.py`: a sample's result depends on its text, its seed and the settings, and on
  nothing else in the batch. Batched matrix products round in their own way, so a draw within 1e-6 of a
  boundary of the distribution can still differ.
- Guidance runs the conditional and the unconditional half in one forward.

Legend: B batch, V vocabulary, G groups.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from motionloom.models.gpt.drawing import Drawing, decode, requested_groups, seeds_of, uniform_numbers
from motionloom.models.gpt.frozen import evaluating
from motionloom.models.gpt.network import InterleavedGPT
from motionloom.models.gpt.tokens import Codes, as_codes


@torch.no_grad()
def generate(
    gpt: InterleavedGPT,
    text: Tensor,
    *,
    max_groups: int | None = None,
    groups: Tensor | None = None,
    temperature: float = 1.0,
    top_k: int | None = None,
    top_p: float = 1.0,
    cfg_scale: float = 1.0,
    seed: int | Sequence[int] = 0,
) -> Codes:
    """Sample code streams for text priors (HumanTOMATO section 3.6).

    Args:
        gpt: The model; runs in evaluation mode and is left as it was.
        text: float [B, E].
        max_groups: Longest result in groups (default: what the block size allows).
        groups: int64 [B], requested lengths: End is forbidden before and forced there. None: the model
            decides.
        temperature: 0 is greedy.
        top_p: Keep the smallest set of tokens with this mass.
        cfg_scale: Guidance; 1 is off. Needs a model trained with condition dropout.
        seed: One seed, from which `sample_seeds` makes one per row, or one per sample. Pass slices of
            `sample_seeds` to get the same results whatever the batch size is.

    Returns:
        Codes per stream int64 [B, G * per_group], 0 after each sample's `groups`; G is the longest sample's
        length.
    """
    batch, device = len(text), text.device
    most_groups = gpt.max_groups if max_groups is None else max_groups
    allowed = min(most_groups, gpt.max_groups)
    limit = requested_groups(groups, batch, most=most_groups, limit=allowed, device=device)
    how = Drawing(temperature, top_k, top_p)
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
