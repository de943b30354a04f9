"""`TokenNetwork`: what networks over interleaved code streams share (HumanTOMATO section 3.3, UDE 3.3).

Embeddings and output heads of each stream, and the grammar of `tokens.py` as masks over the logits. Whoever
inherits makes the tables, `embeddings` and `heads`, with the helpers here, and everything between them.

Legend: B batch, L tokens, D width, V largest vocabulary (K + 1).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from motionloom.datasets.schema import UserError
from motionloom.models.gpt.tokens import kind_of_slot, stream_names
from motionloom.models.tokenizer.base import Stream


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

    def _tables(self, dim: int) -> nn.ModuleList:
        """One embedding of codes and End a stream."""
        return nn.ModuleList(nn.Embedding(k + 1, dim) for k in self.num_codes.values())

    def _outputs(self, dim: int) -> nn.ModuleList:
        return nn.ModuleList(nn.Linear(dim, k + 1) for k in self.num_codes.values())

    def _start_tables(self) -> None:
        """Fresh weights for embeddings and heads."""
        for layer in (*self.embeddings, *self.heads):
            nn.init.normal_(layer.weight, std=0.02)

    def embed(self, tokens: Tensor, kinds: Tensor) -> Tensor:
        """Token embeddings [B, L, D]; each stream looks up its own table, padding reads as code 0."""
        out: Tensor | None = None
        for kind, table in enumerate(self.embeddings):
            here = kinds == kind
            vectors = table(torch.where(here, tokens, 0).clamp(min=0))
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
        """Hidden states [B, L, D], kinds [B, L], legal bool [B, L, V] -> float32 [B, L, V], -inf where
        illegal.
        """
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
        """Bool [..., V] for positions with End token `end`, at a group's first slot or not, after an End or
        not.
        """
        code = torch.arange(self.vocabulary, device=end.device)
        codes = (code < end[..., None]) & ~closing[..., None]
        ending = (code == end[..., None]) & (first | closing)[..., None]
        return codes | ending
