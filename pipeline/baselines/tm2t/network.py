"""`Captioner`: motion tokens to words by a transformer of encoder and decoder (TM2T section 3.3).

The encoder reads a Start and the tokens of a clip, streams interleaved as the GPT reads them; the decoder
writes words, one after another. Layers are those of Vaswani et al. (2017): ReLU, LayerNorm after each sum,
fixed sinusoids, embeddings times sqrt(dim), the output tied to the embedding of the words.

A word of its `Vocabulary` is letters and digits with inner hyphens and apostrophes, in lower case;
punctuation is none. Numbers 0 to 3 are padding, Start, End and a word that is not in the vocabulary, which is
read and never written.

Legend: B batch, L tokens, S = 1 + L, W words, D width, V size of the vocabulary, H heads.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from motionloom.datasets.base.config import Config
from motionloom.models.gpt.tokens import TokenNetwork
from motionloom.models.layers.transformer import LayerNorm, StackConfig, sinusoid
from motionloom.models.metrics.captions import words_of
from motionloom.models.tokenizer.base import Stream

PAD, START, END, UNKNOWN = range(4)
FIRST = 4
"""Number of the first word."""


@dataclass(frozen=True)
class Vocabulary:
    """Words in the order of their numbers."""

    words: tuple[str, ...]

    @staticmethod
    def of(captions: Iterable[str], *, most: int, least_uses: int) -> Vocabulary:
        """The `most` frequent words of captions, of those that `least_uses` different captions have."""
        uses = Counter(word for caption in dict.fromkeys(captions) for word in set(words_of(caption)))
        order = sorted(uses, key=lambda word: (-uses[word], word))
        return Vocabulary(tuple(word for word in order if uses[word] >= least_uses)[:most])

    def __len__(self) -> int:
        """Words and the four others."""
        return FIRST + len(self.words)

    @cached_property
    def _numbers(self) -> dict[str, int]:
        return {word: FIRST + number for number, word in enumerate(self.words)}

    def encode(self, captions: Sequence[str], longest: int) -> Tensor:
        """Captions -> int64 [n, W]: words and End, padded; only the first `longest` words are kept."""
        rows = [
            [*(self._numbers.get(word, UNKNOWN) for word in words_of(caption)[:longest]), END]
            for caption in captions
        ]
        out = torch.full((len(rows), max(map(len, rows), default=1)), PAD)
        for row, numbers in enumerate(rows):
            out[row, : len(numbers)] = torch.tensor(numbers)
        return out

    def decode(self, numbers: Iterable[int]) -> str:
        """A sentence of words' numbers."""
        return " ".join(self.words[number - FIRST] for number in numbers)


EPS = 1e-6
"""Epsilon of LayerNorm."""
KeysValues = tuple[Tensor, Tensor]
"""Each [B, H, S, D / H]."""


class CaptionerConfig(StackConfig):
    """Sizes of a captioner; the defaults are TM2T's."""

    layers: int = Field(default=4, ge=1)
    """Layers of the encoder, and as many of the decoder."""
    dim: int = Field(default=512, ge=2, multiple_of=2)
    ff: int = Field(default=2048, ge=1)
    attention_dropout: float = Field(default=0.1, ge=0, lt=1)
    block_size: int = Field(default=150, ge=2)
    """Start + tokens: of longer clips a part is drawn in training, and the first part captioned."""
    max_words: int = Field(default=40, ge=1)
    """Longest sentence; of longer captions the first words are learnt."""


class Attention(nn.Module):
    """Multi-head attention, added to what asks and normalised."""

    def __init__(self, config: CaptionerConfig) -> None:
        super().__init__()
        dim = config.dim
        self.heads = config.heads
        self.rate = config.attention_dropout
        self.query, self.key, self.value, self.out = (nn.Linear(dim, dim) for _ in range(4))
        self.dropout = nn.Dropout(config.dropout)
        self.norm = LayerNorm(dim, eps=EPS)

    def read(self, x: Tensor) -> KeysValues:
        """Keys and values of x [B, S, D]."""
        return self._split(self.key(x)), self._split(self.value(x))

    def forward(
        self, x: Tensor, source: KeysValues, mask: Tensor | None = None, causal: bool = False
    ) -> Tensor:
        """x [B, L, D] asks; mask bool [B, S] of what may be seen."""
        rate = self.rate if self.training else 0.0
        seen = None if mask is None else mask[:, None, None]
        query = self._split(self.query(x))
        found = functional.scaled_dot_product_attention(
            query, *source, seen, dropout_p=rate, is_causal=causal
        )
        out: Tensor = self.norm(x + self.dropout(self.out(found.transpose(1, 2).flatten(2))))
        return out

    def _split(self, x: Tensor) -> Tensor:
        batch, length, dim = x.shape
        return x.view(batch, length, self.heads, dim // self.heads).transpose(1, 2)


class Feed(nn.Module):
    """Two linear layers, added to their input and normalised."""

    def __init__(self, config: CaptionerConfig) -> None:
        super().__init__()
        self.enter = nn.Linear(config.dim, config.ff)
        self.leave = nn.Linear(config.ff, config.dim)
        self.dropout = nn.Dropout(config.dropout)
        self.norm = LayerNorm(config.dim, eps=EPS)

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.norm(x + self.dropout(self.leave(functional.relu(self.enter(x)))))
        return out


class EncoderLayer(nn.Module):
    """Attention to itself, feed-forward."""

    def __init__(self, config: CaptionerConfig) -> None:
        super().__init__()
        self.own = Attention(config)
        self.feed = Feed(config)

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        out: Tensor = self.feed(self.own(x, self.own.read(x), mask))
        return out


class DecoderLayer(nn.Module):
    """Attention to the words so far, to the tokens, feed-forward."""

    def __init__(self, config: CaptionerConfig) -> None:
        super().__init__()
        self.own = Attention(config)
        self.other = Attention(config)
        self.feed = Feed(config)


@dataclass
class Reading:
    """Sentences on their way: what each layer of the decoder sees of the tokens and of the words so far."""

    tokens: list[KeysValues]
    mask: Tensor
    """Bool [B, S]."""
    words: list[KeysValues | None] = field(default_factory=list)
    length: int = 0

    def take(self, rows: Tensor) -> Reading:
        """The sentences with the numbers `rows`."""
        pick = [None if pair is None else (pair[0][rows], pair[1][rows]) for pair in self.words]
        return Reading([(k[rows], v[rows]) for k, v in self.tokens], self.mask[rows], pick, self.length)


class Captioner(TokenNetwork):
    """Words of token sequences whose slots belong to several codebooks.

    Args:
        pattern: Stream of every slot of a group, e.g. ("body", "body", "hand").
        words: Size of the vocabulary, the four special numbers included.
    """

    sinusoids: Tensor

    def __init__(
        self, config: CaptionerConfig, streams: Sequence[Stream], pattern: Sequence[str], words: int
    ) -> None:
        super().__init__(streams, pattern)
        self.config = config
        self.words = words
        self.max_groups = self._groups_within(config.block_size - 1, "block_size")
        """Longest clip in groups."""
        self.embeddings = self._tables(config.dim)
        self.heads = nn.ModuleList()
        self.start = nn.Parameter(torch.zeros(1, config.dim))
        self.word_table = nn.Embedding(words, config.dim, padding_idx=PAD)
        longest = max(config.block_size, 1 + config.max_words)
        self.register_buffer("sinusoids", sinusoid(longest, config.dim), persistent=False)
        self.encoder = nn.ModuleList(EncoderLayer(config) for _ in range(config.layers))
        self.decoder = nn.ModuleList(DecoderLayer(config) for _ in range(config.layers))
        for parameter in self.parameters():
            if parameter.dim() > 1:
                nn.init.xavier_uniform_(parameter)
        nn.init.normal_(self.start, std=0.02)

    def forward(
        self, tokens: Tensor, kinds: Tensor, words: Tensor, visible: Tensor, known: Tensor | None = None
    ) -> Tensor:
        """Logits of every word given the tokens and the words before it, float32 [B, W, V].

        Args:
            tokens: int64 [B, L], padded with -1.
            kinds: int64 [B, L], stream of each token.
            words: int64 [B, W] as `Vocabulary.encode` gives them.
            visible: Bool [B, L], tokens that may be seen.
            known: Bool [B, L], false at codes of a part that the clip lacks: read as zero. None = all.
        """
        return self.write(self.embedded(tokens, kinds, known), visible, words)

    def embedded(self, tokens: Tensor, kinds: Tensor, known: Tensor | None = None) -> Tensor:
        """Return the encoder's inputs of tokens, [B, L, D]."""
        x = self.embed(tokens, kinds)
        return x if known is None else x.masked_fill(~known[..., None], 0.0)

    def write(self, embedded: Tensor, visible: Tensor, words: Tensor) -> Tensor:
        """As `forward`, of embedded tokens [B, L, D], which may be soft."""
        source, mask = self.encode(embedded, visible)
        before = functional.pad(words[:, :-1], (1, 0), value=START)
        x = self._enter(self.word_table(before))
        for layer in self.decoder:
            assert isinstance(layer, DecoderLayer)
            x = layer.own(x, layer.own.read(x), causal=True)
            x = layer.feed(layer.other(x, layer.other.read(source), mask))
        return self._logits(x)

    def encode(self, embedded: Tensor, visible: Tensor) -> tuple[Tensor, Tensor]:
        """Embedded tokens [B, L, D] and their Start, encoded [B, S, D]; which may be seen, bool [B, S]."""
        x = torch.cat([self.start.to(embedded.dtype).expand(len(embedded), 1, -1), embedded], dim=1)
        mask = functional.pad(visible, (1, 0), value=True)
        x = self._enter(x)
        for layer in self.encoder:
            x = layer(x, mask)
        return x, mask

    def begin(self, embedded: Tensor, visible: Tensor) -> Reading:
        """Sentences that have no word yet."""
        source, mask = self.encode(embedded, visible)
        seen = [layer.other.read(source) for layer in self.decoder if isinstance(layer, DecoderLayer)]
        return Reading(seen, mask, [None] * len(seen))

    def next(self, words: Tensor, reading: Reading) -> Tensor:
        """Log-probabilities of the next word [B, V] after `words` [B] (Start at first); `reading` goes on.

        Padding, Start and the unknown word have none.
        """
        x = self._enter(self.word_table(words[:, None]), reading.length)
        for at, layer in enumerate(self.decoder):
            assert isinstance(layer, DecoderLayer)
            pair = layer.own.read(x)
            before = reading.words[at]
            if before is not None:
                pair = torch.cat([before[0], pair[0]], dim=2), torch.cat([before[1], pair[1]], dim=2)
            reading.words[at] = pair
            x = layer.feed(layer.other(layer.own(x, pair), reading.tokens[at], reading.mask))
        reading.length += 1
        logits = self._logits(x)[:, 0]
        logits[:, [PAD, START, UNKNOWN]] = -torch.inf
        return logits.log_softmax(-1)

    def _enter(self, x: Tensor, first: int = 0) -> Tensor:
        return x * math.sqrt(self.config.dim) + self.sinusoids[first : first + x.shape[1]].to(x.dtype)

    def _logits(self, x: Tensor) -> Tensor:
        return functional.linear(x, self.word_table.weight).float()


class CriticConfig(Config):
    """The adversarial term."""

    weight: float = Field(0.5, gt=0)
    """Weight of the adversarial term in the tokenizer's loss."""
    start: int = Field(10_000, ge=0)
    """First step with the term, and the critic's first step; the release begins with its tenth epoch."""
    width: int = Field(512, ge=2, multiple_of=2)
    """Channels of the first convolution; the second has half."""


class CaptionLossConfig(Config):
    """Weights of words, and shares of tokens that are masked."""

    summed: bool = False
    """Add the words' errors of a batch up, as TM2T does: then all gradients are cut to `optim.grad_clip`."""
    hide: float = Field(default=1 / 3, ge=0, le=1)
    """Share of the draws in which the first or the last group of a clip is not seen (TM2T leaves out a
    token at either end)."""
    hide_hands: float = Field(default=0.0, ge=0, le=1)
    """Share of the draws that are read as clips without hands, as most recordings are; for captions that say
    nothing of fingers."""


class Seq2SeqLossConfig(Config):
    """Teacher forcing and inverse alignment."""

    forced: tuple[float, float] = (0.9, 0.1)
    """Share of the clips of which the true tokens are read, in the first and in the last step; the likeliest
    ones are read of the others."""
    inverse_weight: float = Field(default=1.0, ge=0)
    """Weight of the captioner's cross-entropy; 0 turns it off, and no captioner is needed."""
    gumbel_temperature: float = Field(default=1.0, gt=0)
    summed: bool = False
    """Add errors of a batch up, as TM2T does."""


def word_errors(logits: Tensor, words: Tensor) -> Tensor:
    """Cross-entropy of each word [B, W]; 0 at padding."""
    each = functional.cross_entropy(logits.flatten(0, 1), words.flatten(), ignore_index=PAD, reduction="none")
    return each.view_as(words)


def hidden_ends(groups: Tensor, size: int, group: int, share: float) -> Tensor:
    """Bool [B, size]: the first or the last group of `group` tokens of a `share` of rows; `groups` [B]."""
    drawn = torch.rand(len(groups), device=groups.device)
    first = torch.where(torch.rand_like(drawn) < 0.5, 0, groups - 1) * group
    place = torch.arange(size, device=groups.device) - first[:, None]
    # A clip of one group would have nothing left.
    return ((drawn < share) & (groups > 1))[:, None] & (place >= 0) & (place < group)
