"""`InterleavedGPT`: one causal transformer over interleaved code streams (HumanTOMATO sections 3.3-3.4,
appendix B.3).

The first input is the projected text prior; the input at position i + 1 is token i, and the output at
position i is the distribution of token i. Every stream has its own embedding and its own output head.

Notable choices:
- Logits come masked by the grammar of `tokens.py`: an illegal token has probability zero in the loss and in
  sampling alike, and cannot be sampled. Tokens after the first End are certain, so they cost nothing and
  teach nothing.
- `condition_dropout` replaces the projected text by a learned null input, for classifier-free guidance
  [ours].
- Positions are learned embeddings.
- In training, codes of a part that a clip lacks are read as the zero vector, as the tokenizer's decoder reads
  them [ours]. Sampling makes every part.

Legend: B batch, L tokens, D width, E text width, V largest vocabulary (K + 1).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from pydantic import Field
from torch import Tensor, nn

from motionloom.datasets.base.errors import UserError
from motionloom.models.gpt.tokens import TokenNetwork
from motionloom.models.layers.attention import KVCache
from motionloom.models.layers.transformer import StackConfig, Transformer
from motionloom.models.tokenizer.base import Stream


class GptConfig(StackConfig):
    """Sizes and regularisation of a GPT; the defaults are the paper config."""

    layers: int = Field(default=18, ge=1)
    """T2M-GPT's 9 + 9 blocks (base and head)."""
    dim: int = Field(default=1024, ge=2)
    heads: int = Field(default=16, ge=1)
    ff: int = Field(default=4096, ge=1)
    attention_dropout: float = Field(default=0.1, ge=0, lt=1)
    block_size: int = Field(default=150, ge=2)
    """Text input + tokens: 149 + 1."""
    condition_dropout: float = Field(default=0.1, ge=0, lt=1)
    """Share of samples trained without text, for guidance [ours]; 0 turns guidance off."""
    pkeep: float = Field(default=1.0, gt=0, le=1)
    """Probability that an input token is kept; the others become random codes of their stream (T2M-GPT uses
    0.5).
    """


class InterleavedGPT(TokenNetwork):
    """Autoregressive model of token sequences whose slots belong to several codebooks.

    Args:
        pattern: Stream of every slot of a group, e.g. ("body", "body", "hand").
        text_dim: Width of the text prior (256 for TMA).
    """

    def __init__(
        self, config: GptConfig, streams: Sequence[Stream], pattern: Sequence[str], text_dim: int
    ) -> None:
        super().__init__(streams, pattern)
        self.config = config
        self.text_dim = text_dim
        self.max_groups = self._groups_within(config.block_size - 1, "block_size")
        """Longest sequence in groups; its End tokens and the text fit in beside it."""
        self.text_in = nn.Linear(text_dim, config.dim)
        self.null_text = nn.Parameter(torch.randn(config.dim) * 0.02)
        self.positions = nn.Parameter(torch.randn(config.block_size, config.dim) * 0.02)
        self.embeddings = self._tables(config.dim)
        self.dropout = nn.Dropout(config.dropout)
        self.stack = Transformer(config, config.layers, attention_dropout=config.attention_dropout)
        self.heads = self._outputs(config.dim)
        self._start_tables()

    def forward(
        self,
        tokens: Tensor,
        kinds: Tensor,
        text: Tensor,
        *,
        inputs: Tensor | None = None,
        drop_text: Tensor | None = None,
        known: Tensor | None = None,
    ) -> Tensor:
        """Logits of every token given the text and the tokens before it.

        Args:
            tokens: int64 [B, L], padded with -1.
            kinds: int64 [B, L], stream of each token.
            text: float [B, E].
            inputs: What the network reads instead of `tokens` (corrupted tokens); legality follows `tokens`.
            drop_text: Bool [B], samples whose text is replaced by the null input.
            known: Bool [B, L], false at codes of a part that the clip lacks: read as zero. None = all.

        Returns:
            float32 [B, L, V]; -inf where a token is illegal. At padded positions the values mean nothing.
        """
        embedded = self.embed_inputs(tokens, kinds, inputs, known, self.config.block_size)
        x = torch.cat([self.embed_text(text, drop_text), embedded], dim=1)
        return self.logits(self.hidden(x), kinds, self.legal(tokens, kinds))

    def require_guidance(self, scale: float) -> None:
        """Refuse guidance, a `scale` other than 1, of a network that was always trained with its text."""
        if scale != 1 and self.config.condition_dropout == 0:
            raise UserError(
                "guidance needs a GPT trained with condition_dropout > 0; set cfg_scale to 1, for the face's "
                "GPT face_cfg_scale"
            )

    def embed_text(self, text: Tensor, drop: Tensor | None = None) -> Tensor:
        """The first input [B, 1, D] of text [B, E]; null where `drop` [B]."""
        if text.shape[-1] != self.text_dim:
            raise ValueError(f"the GPT was built for {self.text_dim} text features, got {text.shape[-1]}")
        x: Tensor = self.text_in(text.to(self.text_in.weight.dtype))
        if drop is not None:
            x = torch.where(drop[:, None], self.null_text.to(x.dtype), x)
        return x[:, None]

    def hidden(self, x: Tensor, cache: KVCache | None = None) -> Tensor:
        """Causal states [B, L, D] of inputs x [B, L, D]; with a cache, x continues what it holds."""
        places = slice(x.shape[1]) if cache is None else cache.positions(x.shape[1])
        x = self.dropout(x + self.positions[places].to(x.dtype))
        out: Tensor = self.stack(x, causal=True, cache=cache)
        return out
