"""`Utt`: UDE's unified token transformer (section 3.3).

The input is [glob + MLP(z), seq, start, token 0, token 1, ...]: what MATE made of the conditions, then motion
tokens shifted by one; the output at token i - 1 (at `start` for the first) is the distribution of token i.

Notable choices:
- Any streams and pattern of `tokens.py`, with its grammar and End tokens; UDE's own is one stream. A learned
  `start` vector takes the place of the SOS token in the public code.
- MATE's embeddings become the network's width by one linear layer for glob and seq alike [ours]: the paper's
  numbers, 256 for MATE and 512 here, leave a step open.
- Motion positions are learned and counted from the first token, independent of padding in the prefix; the
  prefix has MATE's positions.
- `frame_condition` adds to the input that predicts a motion token MATE's embedding of the music of the
  token's own frames [ours]. In the paper music is in the prefix alone, and attention has to learn which of
  its frames belong to a token.
- Without conditions (MATE's unconditional embedding) the same network is the unconditional model that
  guidance needs; `condition_dropout` is the share of rows that training makes so.

Legend: B batch, L tokens, G groups, S prefix, D width, E MATE's width, V largest vocabulary (K + 1).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Literal

import torch
from pydantic import Field
from torch import Tensor, nn

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError
from motionloom.models.condition.mate import Encoded, Mate, MateConfig
from motionloom.models.discriminator.patch import AdversarialConfig, DiscriminatorConfig
from motionloom.models.gpt.tokens import TokenNetwork
from motionloom.models.layers.transformer import StackConfig, Transformer
from motionloom.models.tokenizer.base import GROUP_FRAMES, Stream
from motionloom.models.training.optim import OptimConfig
from motionloom.models.utt.backbone import PrefixGru, PrefixTransformer, State


class UttLossConfig(Config):
    """The loss of MATE and UTT."""

    adversarial: AdversarialConfig = AdversarialConfig()
    adversarial_start: int = Field(0, ge=0)
    """First step with the adversarial term, and the discriminator's first step."""
    adversarial_ramp: int = Field(0, ge=0)
    """Steps over which its weight rises from 0."""
    discriminator: DiscriminatorConfig = DiscriminatorConfig()
    discriminator_optim: OptimConfig = OptimConfig(optimizer="adam", betas=(0.5, 0.99))

    def weight(self, step: int) -> float:
        since = step - self.adversarial_start
        if since < 0:
            return 0.0
        rise = 1.0 if self.adversarial_ramp == 0 else min(1.0, (since + 1) / self.adversarial_ramp)
        return self.adversarial.weight * rise


class UttConfig(StackConfig):
    """Sizes; the defaults are the paper's (section 4.2), at the public demo's width of 512."""

    kind: Literal["gpt", "gru"] = "gpt"
    """Transformer, or the GRU of Table 3."""
    layers: int = Field(default=8, ge=1)
    dim: int = Field(default=512, ge=2)
    attention_dropout: float = Field(default=0.1, ge=0, lt=1)
    block_size: int = Field(default=160, ge=2)
    """Motion tokens that the network sees at once, End tokens included; longer motions slide."""
    z_dim: int = Field(default=256, ge=0)
    """Width of the noise z; 0 = a network without it."""
    frame_condition: bool = False
    """Add the music of its own frames to each motion token [ours]; false is the paper: in the prefix only."""
    condition_dropout: float = Field(default=0.1, ge=0, lt=1)
    """Share of samples trained without conditions, for guidance [ours]; 0 turns guidance off."""
    pkeep: float = Field(default=1.0, gt=0, le=1)
    """Probability that an input token is kept; the others become random codes of their stream [ours]."""

    @property
    def width(self) -> tuple[str, int] | None:
        """A GRU has no heads."""
        return ("dim", self.dim) if self.kind == "gpt" else None


class Utt(TokenNetwork):
    """Autoregressive model of motion tokens given MATE's embeddings and noise.

    Args:
        pattern: Stream of every slot of a group.
        glob_dim: E, width of MATE's embeddings.
        stride: Frames of music that one of them is about.
    """

    def __init__(
        self,
        config: UttConfig,
        streams: Sequence[Stream],
        pattern: Sequence[str],
        glob_dim: int,
        stride: int = 1,
    ) -> None:
        super().__init__(streams, pattern)
        self.config = config
        self.glob_dim = glob_dim
        self.max_groups = self._groups_within(config.block_size, "block_size")
        """Longest closed sequence that one block holds, in groups."""
        self.condition_in = nn.Linear(glob_dim, config.dim)
        self.z_in: nn.Module | None = None
        if config.z_dim:
            self.z_in = nn.Sequential(
                nn.Linear(config.z_dim, glob_dim), nn.GELU(), nn.Linear(glob_dim, glob_dim)
            )
        self.per_group = GROUP_FRAMES // stride
        """Embeddings of music for one group of tokens."""
        self.frame_condition_in: nn.Module | None = None
        if config.frame_condition:
            self.frame_condition_in = nn.Linear(self.per_group * glob_dim, config.dim, bias=False)
        self.start = nn.Parameter(torch.randn(config.dim) * 0.02)
        self.positions = nn.Parameter(torch.randn(config.block_size, config.dim) * 0.02)
        self.embeddings = self._tables(config.dim)
        self.dropout = nn.Dropout(config.dropout)
        self.backbone: PrefixTransformer | PrefixGru
        if config.kind == "gpt":
            stack = Transformer(config, config.layers, attention_dropout=config.attention_dropout)
            self.backbone = PrefixTransformer(stack)
        else:
            self.backbone = PrefixGru(config.layers, config.dim, dropout=config.dropout)
        self.heads = self._outputs(config.dim)
        self._start_tables()

    def forward(
        self,
        tokens: Tensor,
        kinds: Tensor,
        condition: Encoded,
        z: Tensor | None = None,
        *,
        inputs: Tensor | None = None,
        known: Tensor | None = None,
    ) -> Tensor:
        """Logits of every token given the conditions, the noise and the tokens before it.

        Args:
            tokens: int64 [B, L], padded with -1.
            kinds: int64 [B, L], stream of each token.
            condition: MATE's embeddings of B rows.
            z: Noise [B, z_dim]; None injects none.
            inputs: What the network reads instead of `tokens` (corrupted tokens); legality follows `tokens`.
            known: Bool [B, L], false at codes of a stream that the clip lacks: read as zero. None = all.

        Returns:
            float32 [B, L, V]; -inf where a token is illegal. At padded positions the values mean nothing.
        """
        embedded = self.embed_inputs(tokens, kinds, inputs, known, self.config.block_size)
        prefix, mask = self.prefix(condition, z)
        motion = self.motion_inputs(embedded, 0, self.frame_condition(condition))
        hidden = self.backbone(prefix, mask, motion)
        return self.logits(hidden, kinds, self.legal(tokens, kinds))

    def prefix(self, condition: Encoded, z: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """[glob + MLP(z), seq] as inputs [B, 1 + S, D], and which of them are real, bool [B, 1 + S]."""
        if condition.glob.shape[-1] != self.glob_dim:
            raise ValueError(f"the UTT was built for width {self.glob_dim}, got {condition.glob.shape[-1]}")
        dtype = self.condition_in.weight.dtype
        glob = condition.glob.to(dtype)
        if z is not None:
            if self.z_in is None:
                raise UserError("this UTT has no z: it was built with z_dim 0")
            glob = glob + self.z_in(z.to(dtype))
        x = self.condition_in(torch.cat([glob[:, None], condition.seq.to(dtype)], dim=1))
        mask = torch.cat([condition.mask.new_ones(len(x), 1), condition.mask], dim=1)
        return self.dropout(x), mask

    def frame_condition(self, condition: Encoded) -> Tensor | None:
        """Music embedding for each group of motion tokens, [B, G, D]; None if the network has none."""
        if self.frame_condition_in is None:
            return None
        timed = condition.timed
        if timed is None or not timed.shape[1]:
            # Zeros go through the layer nevertheless: DDP needs the same parameters used on every rank.
            timed = condition.glob.new_zeros(len(condition.glob), self.per_group, self.glob_dim)
        whole = nn.functional.pad(timed, (0, 0, 0, -timed.shape[1] % self.per_group))
        groups = whole.shape[1] // self.per_group
        out: Tensor = self.frame_condition_in(whole.to(self.start.dtype).reshape(len(whole), groups, -1))
        return out

    def motion_inputs(
        self, embedded: Tensor, at: int, frame_condition: Tensor | None = None, *, first: int = 0
    ) -> Tensor:
        """Embedded tokens [B, L, D] with their positions from `at` on; at 0 the start vector comes first.

        Args:
            embedded: Tokens at the positions before those that they help to predict.
            frame_condition: [B, G, D] or None, from the method of that name.
            first: Index of the token that position 0 predicts; above 0 after a long motion has slid.
        """
        if at == 0:
            start = self.start.to(embedded.dtype).expand(len(embedded), 1, -1)
            embedded = torch.cat([start, embedded], dim=1)
        x = embedded + self.positions[at : at + embedded.shape[1]].to(embedded.dtype)
        if frame_condition is not None:
            # Position p predicts token first + p, and a token's group tells which frames it is about.
            token = first + at + torch.arange(x.shape[1], device=x.device)
            group = token // len(self.pattern)
            last = frame_condition.shape[1] - 1
            music = frame_condition[:, group.clamp(max=last)]
            # End tokens and motion that outlasts its music have none.
            x = x + music.masked_fill((group > last)[:, None], 0.0).to(x.dtype)
        out: Tensor = self.dropout(x)
        return out

    def begin(self, condition: Encoded, z: Tensor | None = None) -> State:
        """Read the conditions for step-by-step decoding of up to `block_size` inputs."""
        prefix, mask = self.prefix(condition, z)
        return self.backbone.begin(prefix, mask, self.config.block_size)


class ConditionedUtt(nn.Module):
    """MATE and UTT as one network, trained end to end: from conditions to motion tokens.

    Args:
        widths: Modality -> width of its features.
        pattern: Stream of every slot of a group.
        timed: Modalities whose positions are the motion's frames.
    """

    def __init__(
        self,
        mate: MateConfig,
        utt: UttConfig,
        widths: Mapping[str, int],
        streams: Sequence[Stream],
        pattern: Sequence[str],
        *,
        timed: Collection[str],
    ) -> None:
        super().__init__()
        self.mate = Mate(mate, widths, timed=timed)
        self.utt = Utt(utt, streams, pattern, mate.dim, mate.stride)
