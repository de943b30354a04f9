"""Rows of tokens that are being drawn, one token of all at a time: what the token networks share.

Legend: B batch, V vocabulary, G groups, P slots of a group, D width.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from motionloom.datasets.base.errors import UserError
from motionloom.models.gpt.tokens import TokenNetwork
from motionloom.models.layers.attention import to_front

_LOOK = 16
"""Tokens after which a GPU is asked whether all rows have ended: it is waited for then."""


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
        if self.temperature == 0:
            return logits.argmax(-1)
        scaled = logits.double() if self.temperature == 1 else logits.double() / self.temperature
        scaled = filter_logits(scaled, top_k=self.top_k, top_p=self.top_p)
        # In whole numbers, which a GPU adds up to the same sums every time. Of 2^52, so that no uniform
        # number, a multiple of 2^-53 below 1, is rounded up to the whole sum: no token begins there.
        mass = (scaled.softmax(-1) * 2**52).long().cumsum(-1)
        at = (mass <= (uniform[:, None] * mass[:, -1:]).long()).sum(-1)
        return at.clamp(max=logits.shape[-1] - 1)  # of NaN all are passed; on a GPU no index may lie outside


def guide(logits: Tensor, scale: Tensor) -> Tensor:
    """Guided logits [B, V] of the conditional and the unconditional half [2B, V].

    `scale` is each row's strength [B]; a row of 1 is as without guidance, to the bit.
    """
    on, off = logits.chunk(2)
    strength = scale.to(logits.dtype)[:, None]
    return torch.where(strength == 1, on, off + strength * (on - off))


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


class Rows:
    """Rows of tokens that are being drawn. All that a step reads and writes stays in the same tensors; what
    follows from a token's number is looked up, since a GPU takes as long for a number as for a thousand.

    Args:
        start: Tokens [B, M * P] of `before` [B] groups a row; the others are drawn.
        limit: New groups at which each row must stop, int64 [B].
        first: Read before token 0 [B, 1, D], of guidance [2B, 1, D]; None where the caller embeds tokens.
        uniform: Draws float64 [B, most new tokens] in [0, 1).
        free: Whether rows may draw End before their limit.
        scale: Each row's guidance [B]; None without.
    """

    def __init__(
        self,
        network: TokenNetwork,
        start: Tensor,
        before: Tensor,
        limit: Tensor,
        *,
        first: Tensor | None = None,
        uniform: Tensor,
        free: bool,
        how: Drawing,
        scale: Tensor | None,
    ) -> None:
        self.how = how
        self.size = len(network.pattern)
        self.first = 0
        self.last = 0
        if len(limit):
            self.first, self.last = int(before.min()) * self.size, int((before + limit).max()) * self.size
        self.at = torch.full((1,), self.first, device=limit.device)
        """Number of the token to draw, int64 [1]."""
        self.tokens = functional.pad(start, (0, max(0, self.last - start.shape[1])))
        """int64 [B, N * P]; behind a row's End or limit they mean nothing."""
        self.before = before.clone()  # rows move in these
        self.limit = limit.clone()
        self.scale = scale
        number = torch.arange(self.tokens.shape[1], device=limit.device)
        group = number // self.size
        slot = number % self.size
        self.new = group >= before[:, None]
        # Draws count from a row's first new token, whatever it starts from.
        index = (number - before[:, None] * self.size).clamp(0, max(0, uniform.shape[1] - 1))
        self.draws = uniform.gather(1, index)
        self.kinds = network.slots[slot]
        self.end = network.ends[network.slots[0]]
        # A motion is never empty, so its first group cannot be End.
        may_end = (slot == 0) & (group > before[:, None]) & free
        self.rules = self.kinds * 2 + may_end
        """Row of `illegal` for each token, int64 [B, N * P]."""
        self.illegal = network.illegal()
        self.weight, self.bias = network.joint_heads()
        self.x = self.embeddings = None
        if first is not None:
            self.embeddings = network.joint_embeddings()
            self.x = first.to(self.embeddings.dtype, copy=True)
            """Input of the next step, of `first`'s shape."""

    def draw(self, hidden: Tensor) -> None:
        """Draw token number `at` of each row by the network's output there: [B, 1, D], with guidance 2B."""
        # One product for all streams' heads, of which one is taken.
        self.draw_by(functional.linear(hidden[:, 0].to(self.weight.dtype), self.weight, self.bias))

    def draw_by(self, heads: Tensor) -> None:
        """Draw token number `at` by the outputs of all heads [B, S * V], of guidance [2B, S * V].

        Nothing here waits for the device, and no shape depends on what lies there.
        """
        at = self.at
        kind = self.kinds.index_select(0, self.at)
        logits = heads.view(len(heads), -1, self.illegal.shape[1]).index_select(1, kind)[:, 0].float()
        logits = logits if self.scale is None else guide(logits, self.scale)
        illegal = self.illegal[self.rules.index_select(1, at)[:, 0]]
        own = self.draws.index_select(1, at)[:, 0]
        drawn = self.how(logits.masked_fill(illegal, -torch.inf), own)[:, None]
        token = torch.where(self.new.index_select(1, at), drawn, self.tokens.index_select(1, at))
        self.tokens.index_copy_(1, at, token)
        if self.x is not None and self.embeddings is not None:
            # Both passes of guidance read the tokens that were drawn under guidance.
            self.x.view(-1, *token.shape, self.x.shape[2]).copy_(self.embeddings[kind, token])
        self.at += 1

    def counts(self) -> Tensor:
        """New groups of each row as far as they are drawn: up to its End, at most its limit; int64 [B]."""
        heads = self.tokens[:, :: self.size]
        new = self.new[:, :: self.size]
        ended = (new & (heads == self.end)).cumsum(1) > 0
        return torch.minimum((new & ~ended).sum(1), self.limit)

    def going(self) -> Tensor:
        """Bool [B], rows that still draw or read their start."""
        return self.at // self.size < self.before + self.counts()

    def run(
        self, step: Callable[[int], None], leave: Callable[[Tensor], None] | None = None
    ) -> tuple[Tensor, Tensor]:
        """Take `step`, which calls `draw`, for each number in order; all tokens int64 [B, N * P], those of
        the start included, and the numbers of new groups int64 [B].

        Args:
            step: Takes the number of the token.
            leave: Moves to the front what belongs to these rows, int64 [b], of guidance [2b], of all that a
                step reads besides; the others have ended. None keeps all rows to the end.
        """
        every = _LOOK if self.at.is_cuda else self.size
        tokens = self.tokens.clone()
        counts = self.counts()
        place = torch.arange(len(tokens), device=tokens.device)

        def write() -> None:
            tokens.index_copy_(0, place, self.tokens)
            counts.index_copy_(0, place, self.counts())

        for number in range(self.first, self.last):
            if (number - self.first) % every == 0:
                going = self.going()
                count = int(going.sum())
                if count == 0:
                    break
                # Halves, so that steps come in few shapes and rows are moved a few times only.
                size = len(place)
                while size > 1 and (half := (size + 1) // 2) >= count:
                    size = half
                if leave is not None and size < len(place):
                    write()
                    rows = going.int().argsort(descending=True, stable=True)[:size]
                    place = place[rows]
                    leave(self.keep(rows))
            step(number)
        write()
        return tokens, counts

    def keep(self, rows: Tensor) -> Tensor:
        """Go on with these rows [b] alone; return their places in a step's input, int64 [b], of guidance
        [2b].
        """
        inputs = rows if self.scale is None else torch.cat([rows, rows + len(self.tokens)])
        for name in ("tokens", "before", "limit", "scale", "new", "draws", "rules"):
            value = getattr(self, name)
            setattr(self, name, value if value is None else to_front(value, rows))
        self.x = None if self.x is None else to_front(self.x, inputs)
        return inputs
