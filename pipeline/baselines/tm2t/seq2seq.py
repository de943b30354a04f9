"""`Seq2Seq`: words to motion tokens by a GRU that attends to the words (TM2T section 3.2).

A bidirectional GRU reads the states of the caption's words; the decoder's GRU reads, for each token, the one
before it joined with what it attends to among the words ("early" fusion). The output is tied to the embedding
of the tokens. Words are the token states of a frozen text encoder where TM2T has GloVe's vectors [ours].

Legend: B batch, L tokens, S words, E their width, H hidden width of the reader, D of the decoder, V codes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from motionloom.datasets.base.config import Config
from motionloom.models.gpt.rows import Drawing, Rows
from motionloom.models.gpt.sampling import requested_groups, uniform_numbers
from motionloom.models.gpt.tokens import Codes, TokenNetwork, as_codes
from motionloom.models.layers.frozen import evaluating
from motionloom.models.layers.transformer import LayerNorm
from motionloom.models.tokenizer.base import Stream


class Seq2SeqConfig(Config):
    """Sizes; the defaults are TM2T's."""

    reader: int = Field(default=512, ge=1)
    """Width of the GRU over words, each way."""
    dim: int = Field(default=1024, ge=1)
    """Width of the decoder."""
    max_tokens: int = Field(default=55, ge=2)
    """Longest sequence, its End tokens included."""


class EncodedWords(NamedTuple):
    """Encoded words, as the decoder reads them."""

    keys: Tensor
    """[B, S, D]."""
    values: Tensor
    """[B, S, D]."""
    mask: Tensor
    """Bool [B, S]."""


NextInput = Callable[[int, Tensor], Tensor]
"""The token's number and its logits [B, V] -> what is read of it [B, D]."""


class _Tied(nn.Module):
    """An output whose weights are a table of embeddings, kept there alone."""

    def __init__(self, table: nn.Module) -> None:
        super().__init__()
        self._table = [table]  # in a list, so that it is no child of this module too

    @property
    def weight(self) -> Tensor:
        weight = self._table[0].weight
        assert isinstance(weight, Tensor)
        return weight

    @property
    def bias(self) -> Tensor:
        """Zeros, as `TokenNetwork.joint_heads` asks for a bias."""
        return self.weight.new_zeros(len(self.weight))

    def forward(self, x: Tensor) -> Tensor:
        return functional.linear(x, self.weight)


class Seq2Seq(TokenNetwork):
    """Autoregressive model of token sequences whose slots belong to several codebooks.

    Args:
        pattern: Stream of every slot of a group, e.g. ("body", "body", "hand").
        text_dim: Width of the words' states.
    """

    def __init__(
        self, config: Seq2SeqConfig, streams: Sequence[Stream], pattern: Sequence[str], text_dim: int
    ) -> None:
        super().__init__(streams, pattern)
        self.config = config
        self.text_dim = text_dim
        self.max_groups = self._groups_within(config.max_tokens, "max_tokens")
        """Longest motion in groups."""
        hidden = config.reader
        dim = config.dim
        self.text_in = nn.Linear(text_dim, hidden)
        self.reader, self.back = (nn.GRU(hidden, hidden, batch_first=True) for _ in range(2))
        self.first = nn.Parameter(torch.randn(2, 1, hidden))
        self.begin = nn.Linear(2 * hidden, dim)
        self.query = nn.Linear(dim, dim)
        self.value = nn.Linear(2 * hidden, dim)
        self.key = nn.Linear(2 * hidden, dim, bias=False)
        self.fuse = nn.Sequential(nn.Linear(2 * dim, dim), LayerNorm(dim), nn.LeakyReLU(0.2))
        self.cell = nn.GRUCell(dim, dim)
        self.start = nn.Parameter(torch.randn(dim) * 0.02)
        self.embeddings = self._tables(dim)
        self.heads = nn.ModuleList(_Tied(table) for table in self.embeddings)
        for table in self.embeddings.parameters():
            nn.init.normal_(table, std=dim**-0.5)

    def read(self, text: Tensor, mask: Tensor) -> tuple[EncodedWords, Tensor]:
        """Words [B, S, E], `mask` bool [B, S] -> memory of the decoder, and its first state [B, D]."""
        x = self.text_in(text.to(self.text_in.weight.dtype))
        last = mask.sum(1).clamp(min=1)[:, None] - 1
        # Backwards from each row's last word; padding is read after all words, and looked at nowhere.
        order = (last - torch.arange(x.shape[1], device=x.device)).clamp(min=0)[..., None]
        backwards = x.gather(1, order.expand(-1, -1, x.shape[2]))
        begin = self.first.expand(-1, len(x), -1).contiguous()
        forth, _ = self.reader(x, begin[:1])
        back, _ = self.back(backwards, begin[1:])
        at = last[..., None].expand(-1, -1, forth.shape[2])
        state = self.begin(torch.cat([forth.gather(1, at), back.gather(1, at)], dim=-1)[:, 0])
        states = torch.cat([forth, back.gather(1, order.expand(-1, -1, back.shape[2]))], dim=-1)
        return EncodedWords(self.key(states), self.value(states), mask), state

    def step(self, x: Tensor, state: Tensor, read: EncodedWords) -> Tensor:
        """The next state [B, D] after a token's embedding [B, D]."""
        scores = (read.keys @ self.query(state)[..., None])[..., 0] / self.config.dim**0.5
        weights = scores.masked_fill(~read.mask, -torch.inf).softmax(-1)
        seen = (weights[:, None] @ read.values)[:, 0]
        out: Tensor = self.cell(self.fuse(torch.cat([seen, x], dim=-1)), state)
        return out

    def roll(self, text: Tensor, mask: Tensor, kinds: Tensor, legal: Tensor, read_next: NextInput) -> Tensor:
        """Logits [B, L, V] of L tokens in a row; `read_next` says what is read of each.

        Args:
            kinds: int64 [B, L], stream of each token.
            legal: Bool [B, L, V], what may be drawn.
        """
        read, state = self.read(text, mask)
        x = self.start.expand(len(text), -1)
        out = []
        for at in range(kinds.shape[1]):
            state = self.step(x, state, read)
            here = slice(at, at + 1)
            out.append(self.logits(state[:, None], kinds[:, here], legal[:, here]))
            if at < kinds.shape[1] - 1:
                x = read_next(at, out[-1][:, 0])
        return torch.cat(out, dim=1)

    def embed_at(self, tokens: Tensor, kinds: Tensor) -> Tensor:
        """Embeddings [B, D] of one token of each row; `tokens` and `kinds` int64 [B]."""
        return self.embed(tokens[:, None], kinds[:, None])[:, 0]


@torch.no_grad()
def draw_tokens(
    net: Seq2Seq, text: Tensor, mask: Tensor, groups: Tensor | None, seeds: Sequence[int], how: Drawing
) -> Codes:
    """Tokens for captions [B, S, E], of `groups` [B] or until End; rows depend on their own seed alone."""
    batch = len(text)
    device = text.device
    size = len(net.pattern)
    limit = requested_groups(groups, batch, most=net.max_groups, limit=net.max_groups, device=device)
    most = int(limit.max()) if batch else 0
    uniform = uniform_numbers(seeds, most * size, device)
    start = torch.zeros(batch, 0, dtype=torch.int64, device=device)
    before = torch.zeros_like(limit)
    first = net.start.expand(batch, 1, -1)
    rows = Rows(
        net, start, before, limit, first=first, uniform=uniform, free=groups is None, how=how, scale=None
    )
    with evaluating(net):
        read, state = net.read(text, mask)

        def draw(_: int) -> None:
            nonlocal state
            assert rows.x is not None
            state = net.step(rows.x[:, 0], state, read)
            rows.draw(state[:, None])

        tokens, counts = rows.run(draw)
    return as_codes(tokens.view(batch, most, size), net.pattern, counts)
