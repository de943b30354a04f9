"""`TokenStream`: tokens of an `InterleavedGPT` group by group, without an end, under texts that may change.

The network reads [text, token 0, token 1, ...], as many as its block has room for. When the block is full,
or another text comes, a new block begins with the text and the last `context` groups [ours]: the network goes
on from them as from the beginning of a clip. Its cache is one block, whatever the length of the motion.

Where the network would draw End the clip is over, and a new block begins with the text alone [ours]: beyond
the length of its training clips it knows nothing, and a walk would stand still after one of them. From what a
clip ends with, which is often a figure that slows down, it would go on no better. Clips that a text begins
alone have their first groups in common: what it leaves open, such as how fast, stays as it was drawn.

Draws are those of `sampling.generate`, in the same order: as long as the text stays and no
block is over, the tokens are those of a motion of a requested length.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from motionloom.models.gpt.network import InterleavedGPT
from motionloom.models.gpt.sampling import Drawing, next_token
from motionloom.models.layers.transformer import KVCache

OPENING = 2
"""Groups that a text's clips have in common: of ten minutes of `synthetic`'s walk each is then 0.93 to 1.04
times as fast as the first ten seconds (three seeds), without them 0.88 to 1.15."""


class TokenStream:
    """One motion's tokens.

    Args:
        how: How a token is taken.
        context: Groups that a new block goes on from; at most one less than a block has.
        cfg_scale: Guidance; 1 is off. Needs a model trained with condition dropout.
    """

    def __init__(
        self, gpt: InterleavedGPT, *, how: Drawing, context: int, cfg_scale: float = 1.0, seed: int = 0
    ) -> None:
        gpt.require_guidance(cfg_scale)
        self.gpt, self.how = gpt.eval(), how
        self.context = min(context, gpt.max_groups - 1)
        self._scale = cfg_scale
        self._numbers = np.random.Generator(np.random.Philox(key=seed))
        self._text: Tensor | None = None
        self._cache: KVCache | None = None
        self._inputs = gpt.null_text.new_zeros(1, 0, gpt.config.dim)
        """Embeddings that the network has not read yet, [1 or 2, L, D]."""
        self._block = torch.zeros(1, 0, dtype=torch.int64, device=gpt.null_text.device)
        """Tokens of this block, those that it goes on from included, [1, L]."""
        self._drawn = 0
        """Groups of this block that it does not go on from."""
        self._opening: list[Tensor] = []
        """Groups that the clips of this text begin with, [1, P] each."""
        self._clip = 0
        """Groups of this clip; one that goes on from another text's begins behind the opening."""

    def condition(self, text: Tensor) -> None:
        """The text prior [1, E] of all that is drawn from now on."""
        self._text, self._cache = text, None
        self._opening, self._clip = [], OPENING

    @torch.no_grad()
    def draw(self) -> Tensor:
        """The tokens of one more group, int64 [1, P]."""
        gpt, size = self.gpt, len(self.gpt.pattern)
        if self._cache is None or self._block.shape[1] >= gpt.max_groups * size:
            self._begin(self.context)
        device = self._block.device
        uniform = torch.from_numpy(self._numbers.random(size)).to(device)
        no = torch.zeros(1, dtype=torch.bool, device=device)
        drawn = []
        for slot in range(size):
            hidden = gpt.hidden(self._inputs, self._cache)[:, -1:]
            scale = hidden.new_full((1,), self._scale) if len(hidden) == 2 else None
            draw = uniform[slot : slot + 1]
            # A stream goes on where a clip would end: the network begins a new clip of the same text.
            if slot == 0 and self._drawn and self._is_over(hidden, draw, scale):
                self._begin(0)
                hidden = gpt.hidden(self._inputs, self._cache)[:, -1:]
            if self._clip < len(self._opening):
                token = self._opening[self._clip][:, slot : slot + 1]
            else:
                made = next_token(gpt, hidden, slot, may_end=no, how=self.how, uniform=draw, scale=scale)
                token = made[:, None]
            drawn.append(token)
            self._inputs = gpt.embed(token, gpt.slots[slot].expand(1, 1)).expand(len(hidden), -1, -1)
        group = torch.cat(drawn, dim=1)
        if self._clip == len(self._opening) < OPENING:
            self._opening.append(group)
        self._clip += 1
        self._block = torch.cat([self._block, group], dim=1)
        self._drawn += 1
        return group

    def _is_over(self, hidden: Tensor, draw: Tensor, scale: Tensor | None) -> bool:
        """Whether the network would end the clip here."""
        slot = self.gpt.slots[0]
        may_end = torch.ones(1, dtype=torch.bool, device=hidden.device)
        token = next_token(self.gpt, hidden, 0, may_end=may_end, how=self.how, uniform=draw, scale=scale)
        return bool(token == self.gpt.ends[slot])

    def _begin(self, context: int) -> None:
        """A new block: the text, and the last `context` groups of the one before."""
        if self._text is None:
            raise ValueError("nothing to draw from: give a text by `condition` first")
        gpt, size = self.gpt, len(self.gpt.pattern)
        kept = min(context, self._block.shape[1] // size)
        self._clip = self._clip if kept else 0
        self._block = self._block[:, self._block.shape[1] - kept * size :]
        first = gpt.embed_text(self._text)
        if self._scale != 1:
            first = torch.cat([first, gpt.embed_text(self._text, first.new_ones(1, dtype=torch.bool))])
        before = gpt.embed(self._block, gpt.slots.repeat(kept)[None])
        self._inputs = torch.cat([first, before.expand(len(first), -1, -1)], dim=1)
        self._drawn = 0
        self._cache = gpt.stack.cache(gpt.max_groups * size)
