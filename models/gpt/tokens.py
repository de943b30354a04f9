"""Token sequences: several code streams interleaved into one, and back (HumanTOMATO section 3.3, equation 4;
B.4).

A *pattern* names the stream of every slot of one group of frames: ("body", "body", "hand") for H2VQ,
("level0", "level1") for the face RVQ, ("code",) for one codebook. A sequence is the groups one after another,
closed by one End token per stream in order of first appearance: 49 groups of H2VQ are 98 body + 49 hand + 2
End = 149 tokens, the paper's longest.

The End of a stream with K codes is its token K. The grammar that follows, used alike in training and in
sampling:
- End is legal only at the first slot of a group, and only in that slot's stream;
- after it, every remaining token is the End of its own stream;
- a token of a stream is never legal where the pattern names another.

A token's *kind* is the index of its stream in order of first appearance. Padding is -1 in `tokens` and 0 in
`kinds`.

`TokenNetwork` is what networks over such sequences share: tables, and the grammar as masks over the logits.

Legend: B batch, G groups, P slots of a group, L tokens, D width, V largest vocabulary (K + 1).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from motionloom.datasets.base.errors import UserError
from motionloom.models.layers.linear import Linear, product_type
from motionloom.models.tokenizer.base import Stream

PAD = -1


class TokenSequence(NamedTuple):
    """Interleaved tokens of a batch."""

    tokens: Tensor
    """int64 [B, L], `PAD` after `length`."""
    kinds: Tensor
    """int64 [B, L], stream of each token; 0 after `length`."""
    length: Tensor
    """int64 [B], number of tokens, End tokens included."""


class Codes(NamedTuple):
    """Code streams of a batch."""

    codes: dict[str, Tensor]
    """Per stream int64 [B, G * per_group]; 0 after `groups`, so that every entry is a valid code."""
    groups: Tensor
    """int64 [B], number of groups."""


def stream_names(pattern: Sequence[str]) -> tuple[str, ...]:
    """Streams of a pattern in order of first appearance; a token's kind is an index into these."""
    return tuple(dict.fromkeys(pattern))


def kind_of_slot(pattern: Sequence[str]) -> list[int]:
    """Kind of each slot of one group."""
    names = stream_names(pattern)
    return [names.index(name) for name in pattern]


def closing_length(pattern: Sequence[str]) -> int:
    """Number of End tokens that close a sequence."""
    return len(stream_names(pattern))


def slot_codes(codes: Mapping[str, Tensor], pattern: Sequence[str]) -> Tensor:
    """Return codes of every slot, int64 [B, G, P]; `ValueError` if streams differ in groups."""
    # A stream with two tokens in a group fills two slots of the pattern, in turn.
    per_group = {name: list(pattern).count(name) for name in pattern}
    count = codes[pattern[0]].shape[1] // per_group[pattern[0]]
    groups: dict[str, Tensor] = {}
    for name, per in per_group.items():
        if codes[name].shape[1] != count * per:
            raise ValueError(
                f"stream '{name}' holds {codes[name].shape[1]} codes, "
                f"not {count * per}: {count} groups of {per}"
            )
        groups[name] = codes[name].reshape(len(codes[name]), count, per)
    nth = [list(pattern[:slot]).count(name) for slot, name in enumerate(pattern)]
    return torch.stack([groups[name][:, :, k] for name, k in zip(pattern, nth, strict=True)], dim=2)


def interleave(
    codes: Mapping[str, Tensor],
    pattern: Sequence[str],
    *,
    ends: Mapping[str, int] | None = None,
    groups: Tensor | None = None,
    closed: Tensor | None = None,
) -> TokenSequence:
    """Code streams, each [B, G * per_group], -> one sequence.

    Args:
        codes: int64 per stream of the pattern.
        pattern: Stream of every slot of a group.
        ends: End token per stream (its number of codes); None leaves the sequences open, for clips that were
            cropped.
        groups: Valid groups per clip, [B] (default: all G). Codes after them are ignored.
        closed: Bool [B], rows that get their End tokens (default: all); the others are clips that go on.
    """
    names = stream_names(pattern)
    slots = slot_codes(codes, pattern)
    (batch, count) = slots.shape[:2]
    device = slots.device
    body = slots.flatten(1)
    if groups is None:
        groups = torch.full((batch,), count, dtype=torch.int64, device=device)
    kinds = _numbers(kind_of_slot(pattern), device).repeat(count).expand(batch, -1)
    length = groups * len(pattern)
    # Padding lies behind each row's own tokens, not at the end of each stream.
    valid = torch.arange(body.shape[1], device=device)[None] < length[:, None]
    tokens = torch.where(valid, body, PAD)
    kinds = torch.where(valid, kinds, 0)
    if ends is None:
        return TokenSequence(tokens, kinds, length)
    if closed is None:
        closed = torch.ones_like(groups, dtype=torch.bool)
    order = torch.arange(len(names), device=device)
    limits = _numbers([ends[name] for name in names], device)
    # One End a stream follows, in the order of their first slots.
    at = length[:, None] + order  # after each row's own tokens
    more = functional.pad(tokens, (0, len(names)), value=PAD), functional.pad(kinds, (0, len(names)))
    tokens = more[0].scatter(1, at, torch.where(closed[:, None], limits, PAD))
    kinds = more[1].scatter(1, at, torch.where(closed[:, None], order, 0))
    return TokenSequence(tokens, kinds, torch.where(closed, length + len(names), length))


def _numbers(values: Sequence[int], device: torch.device) -> Tensor:
    """int64 [n], made on the device: a list would be sent there, which a GPU is waited for."""
    return torch.stack([torch.full((), value, device=device) for value in values])


def known_tokens(recorded: Tensor, batch: TokenSequence, ends: Tensor) -> Tensor:
    """Bool [B, L]: false at codes of streams that a clip lacks. recorded bool [B, K], ends int64 [K]."""
    return recorded.gather(1, batch.kinds) | (batch.tokens == ends[batch.kinds])


def as_codes(tokens: Tensor, pattern: Sequence[str], groups: Tensor) -> Codes:
    """Tokens int64 [B, N, P] of `groups` [B] groups a row as streams; 0 after a shorter row."""
    longest = int(groups.max()) if len(groups) else 0
    inside = torch.arange(longest, device=tokens.device)[None, :, None] < groups[:, None, None]
    rows = torch.where(inside, tokens[:, :longest], 0)
    kinds = kind_of_slot(pattern)
    names = stream_names(pattern)
    slots = {name: [slot for slot, kind in enumerate(kinds) if names[kind] == name] for name in names}
    return Codes({name: rows[:, :, here].flatten(1) for name, here in slots.items()}, groups)


class TokenNetwork(nn.Module):
    """Base of autoregressive networks whose slots belong to several codebooks.

    Args:
        pattern: Stream of every slot of a group, e.g. ("body", "body", "hand").
    """

    slots: Tensor
    ends: Tensor
    embeddings: nn.ModuleList
    heads: nn.ModuleList

    def __init__(self, streams: Sequence[Stream], pattern: Sequence[str]) -> None:
        super().__init__()
        self.pattern = tuple(pattern)
        sizes = {stream.name: stream.num_codes for stream in streams}
        missing = [name for name in stream_names(pattern) if name not in sizes]
        if missing:
            raise UserError(
                f"the token pattern {self.pattern} names {missing}; the streams are {list(sizes)}"
            )
        self.names = stream_names(pattern)
        self.num_codes = {name: sizes[name] for name in self.names}
        """Codes per stream, which is also the stream's End token."""
        self.vocabulary = max(self.num_codes.values()) + 1
        self.register_buffer("slots", torch.tensor(kind_of_slot(pattern)), persistent=False)
        self.register_buffer("ends", torch.tensor(list(self.num_codes.values())), persistent=False)

    def _groups_within(self, size: int, setting: str) -> int:
        """Return the groups of the longest closed sequence of `size` tokens; `UserError` if none."""
        groups = (size - closing_length(self.pattern)) // len(self.pattern)
        if groups < 1:
            needed = len(self.pattern) + closing_length(self.pattern)
            raise UserError(
                f"net.{setting} holds no motion: a group and its End tokens are {needed} tokens, "
                f"and there is room for {size}; raise it"
            )
        return groups

    def _tables(self, dim: int) -> nn.ModuleList:
        """One embedding of codes and End a stream."""
        return nn.ModuleList(nn.Embedding(k + 1, dim) for k in self.num_codes.values())

    def _outputs(self, dim: int) -> nn.ModuleList:
        return nn.ModuleList(Linear(dim, k + 1) for k in self.num_codes.values())

    def _start_tables(self) -> None:
        """Fresh weights for embeddings and heads."""
        for layer in (*self.embeddings, *self.heads):
            nn.init.normal_(layer.weight, std=0.02)

    def joint_embeddings(self) -> Tensor:
        """The embeddings of all streams [S, V, D], V rounded up to a multiple of 8."""
        return self._joint(table.weight for table in self.embeddings)

    def joint_heads(self) -> tuple[Tensor, Tensor]:
        """Weights [S * V, D] and biases [S * V] of all heads, V as above, in the type of their products; a
        bias of -inf where a stream has no token.
        """
        weight = self._joint(head.weight for head in self.heads).flatten(0, 1)
        bias = self._joint((head.bias for head in self.heads), -torch.inf).flatten()
        return weight.to(product_type(weight)), bias.to(product_type(weight))

    def _joint(self, tables: Iterable[Tensor | nn.Module], value: float = 0.0) -> Tensor:
        """Tables [K + 1, ...] of the streams as one [S, V, ...], filled up with `value`."""
        filled = []
        for table in tables:
            assert isinstance(table, Tensor)
            # Even rows, which kernels for half precision need.
            more = -(-self.vocabulary // 8) * 8 - len(table)
            filled.append(functional.pad(table, (0, 0) * (table.dim() - 1) + (0, more), value=value))
        return torch.stack(filled)

    def illegal(self) -> Tensor:
        """Bool [2 * S, V], V as above: what cannot be drawn before End of a stream's token; row 2 s where it
        cannot be End, row 2 s + 1 where it can.
        """
        may_end = torch.arange(2 * len(self.ends), device=self.ends.device) % 2 == 1
        legal = self.legal_at(self.ends.repeat_interleave(2), may_end, torch.zeros_like(may_end))
        return ~functional.pad(legal, (0, -self.vocabulary % 8))

    def embed(self, tokens: Tensor, kinds: Tensor) -> Tensor:
        """Token embeddings [B, L, D]; each stream looks up its own table, padding reads as any code."""
        # What is not a stream's own looks up all its rows in turn: a GPU that repeats its bytes adds the
        # gradients of one row one behind the other, a quarter of a step where all those were row 0.
        others = torch.arange(tokens.numel(), device=tokens.device).view(tokens.shape)
        out: Tensor | None = None
        for kind, table in enumerate(self.embeddings):
            assert isinstance(table, nn.Embedding)
            here = kinds == kind
            vectors = table(torch.where(here & (tokens != PAD), tokens, others % table.num_embeddings))
            out = vectors if out is None else torch.where(here[..., None], vectors, out)
        assert out is not None  # a pattern has at least one stream
        return out

    def embed_inputs(
        self, tokens: Tensor, kinds: Tensor, inputs: Tensor | None, known: Tensor | None, block_size: int
    ) -> Tensor:
        """Return the inputs before each token but the first in training: embeddings [B, L - 1, D].

        Args:
            tokens: int64 [B, L], padded with -1.
            kinds: int64 [B, L], stream of each token.
            inputs: Read instead of `tokens`; None reads those.
            known: Bool [B, L], false where zeros are read. None = all.
        """
        size = tokens.shape[1]
        if size > block_size:
            raise UserError(
                f"a sequence of {size} tokens is longer than net.block_size {block_size}; raise it or "
                "shorten max_frames"
            )
        out = self.embed((tokens if inputs is None else inputs)[:, :-1], kinds[:, :-1])
        return out if known is None else out.masked_fill(~known[:, :-1, None], 0.0)

    def logits(self, hidden: Tensor, kinds: Tensor, legal: Tensor) -> Tensor:
        """Hidden states [B, L, D], kinds [B, L], legal [B, L, V] -> float32 [B, L, V], -inf where illegal."""
        hidden = hidden.to(product_type(hidden))  # once, not for each head
        out = torch.full((*kinds.shape, self.vocabulary), -torch.inf, device=hidden.device)
        for kind, head in enumerate(self.heads):
            values = head(hidden).float()
            padded = nn.functional.pad(values, (0, self.vocabulary - values.shape[-1]), value=-torch.inf)
            out = torch.where((kinds == kind)[..., None], padded, out)
        return out.masked_fill(~legal, -torch.inf)

    def legal(self, tokens: Tensor, kinds: Tensor) -> Tensor:
        """Bool [B, L, V]: what the grammar allows at each position of sequences [B, L]."""
        batch, size = tokens.shape
        end = self.ends[kinds]
        is_end = tokens == end
        closing = (is_end.cumsum(1) - is_end.long()) > 0
        first = (torch.arange(size, device=tokens.device) % len(self.pattern) == 0).expand(batch, size)
        return self.legal_at(end, first, closing)

    def legal_at(self, end: Tensor, first: Tensor, closing: Tensor) -> Tensor:
        """Bool [..., V] for positions with End token `end`, at a group's first slot, after an End."""
        code = torch.arange(self.vocabulary, device=end.device)
        codes = (code < end[..., None]) & ~closing[..., None]
        ending = (code == end[..., None]) & (first | closing)[..., None]
        return codes | ending
