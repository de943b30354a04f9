"""Bailando's GPT over codes, and the critic of its actor-critic training (sections 3.2 and 3.3).

`CrossGpt` predicts the next codes of both halves of the body from those before and from music. Music, upper
and lower codes are three blocks of one sequence. A position sees those of all three blocks that are not later
than it. Music is one code ahead: the music that a code is danced to is there when it is predicted. The
outputs at the upper block give the next upper code, those at the lower one the next lower.

Legend: B batch, L codes in the context, E features of music, D width, K codes.
"""

from __future__ import annotations

from typing import Literal

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from motionloom.datasets.base.config import Config
from motionloom.models.gpt.rows import Drawing
from motionloom.models.layers.transformer import StackConfig, Transformer


class CrossGptConfig(StackConfig):
    """Sizes; the defaults are the published ones."""

    dim: int = Field(default=768, ge=1)
    heads: int = Field(default=12, ge=1)
    ff: int = Field(default=3072, ge=1)
    layers: int = Field(default=6, ge=1)
    """Layers that actor and critic share, and as many again before the codes' logits."""
    context: int = Field(default=29, ge=1)
    """Codes of each half that it sees."""
    music: Literal["mean", "first"] = "mean"
    """How the music of a code's frames is pooled: the mean [ours], or the first row, as the release hears
    one row a code."""


class CrossGpt(nn.Module):
    """Codes [B, L, 2] of both halves and music [B, L, E] -> logits [B, L, 2, K] of the next codes."""

    kept: Tensor
    """int64 [kept, 2]: first codes of training dances, to go on from where no motion is given."""

    def __init__(self, config: CrossGptConfig, num_codes: int, music_dim: int, kept: int = 8) -> None:
        super().__init__()
        self.config = config
        self.num_codes = num_codes
        self.music_dim = music_dim
        dim = config.dim
        self.codes = nn.ModuleList(nn.Embedding(num_codes, dim) for _ in range(2))
        self.music = nn.Linear(music_dim, dim)
        self.positions = nn.Parameter(0.02 * torch.randn(3 * config.context, dim))
        self.dropout = nn.Dropout(config.dropout)
        self.base = Transformer(config, config.layers, last_norm=False)
        self.head = Transformer(config, config.layers)
        self.out = nn.ModuleList(nn.Linear(dim, num_codes, bias=False) for _ in range(2))
        for layer in (*self.codes, *self.out, self.music):
            nn.init.normal_(layer.weight, std=0.02)
        self.register_buffer("kept", torch.zeros(kept, 2, dtype=torch.int64))

    def heard(self, music: Tensor, code_frames: int, codes: int | None = None) -> Tensor:
        """The music [B, L, E] of so many codes; music [B, T, E] of frames, after its end 0."""
        return music_of_codes(music, code_frames, codes, first=self.config.music == "first")

    def forward(self, codes: Tensor, music: Tensor) -> Tensor:
        """`music[:, t]` is that of the code after `codes[:, t]`."""
        return self.logits(self.states(codes, music))

    def states(self, codes: Tensor, music: Tensor) -> Tensor:
        """Return the states that actor and critic share, [B, 3 L, D] in the order music, upper, lower."""
        size = codes.shape[1]
        context = self.config.context
        blocks = [self.music(music), *(embed(codes[..., k]) for k, embed in enumerate(self.codes))]
        places = self.positions.view(3, context, -1)[:, :size].flatten(0, 1)
        x = self.dropout(torch.cat(blocks, dim=1) + places)
        out: Tensor = self.base(x, tiled_causal(size, x.device))
        return out

    def logits(self, states: Tensor) -> Tensor:
        """[B, 3 L, D] -> [B, L, 2, K]."""
        x = self.head(states, tiled_causal(states.shape[1] // 3, states.device))
        blocks = three_blocks(x)
        return torch.stack([out(blocks[:, k + 1]) for k, out in enumerate(self.out)], dim=2)

    @torch.no_grad()
    def dance(self, first: Tensor, music: Tensor, temperature: float = 0.0) -> Tensor:
        """Codes [B, L, 2] that begin with `first` [B, S, 2], one for each row of the music [B, L, E].

        The likeliest codes, or with a `temperature` drawn ones. The context slides: it is always the last
        codes that fit.
        """
        codes = first[:, : music.shape[1]]
        for end in range(codes.shape[1], music.shape[1]):
            begin = max(0, end - self.config.context)
            logits = self(codes[:, begin:], music[:, begin + 1 : end + 1])[:, -1].flatten(0, 1)
            uniform = torch.rand(len(logits), dtype=torch.float64, device=logits.device)
            new = Drawing(temperature)(logits, uniform).view(-1, 1, 2)
            codes = torch.cat([codes, new], dim=1)
        return codes


def three_blocks(x: Tensor) -> Tensor:
    """[B, 3 L, D] -> [B, 3, L, D]: music, upper and lower half."""
    return x.view(len(x), 3, -1, x.shape[2])


def tiled_causal(size: int, device: torch.device) -> Tensor:
    """Bool [1, 3 L, 3 L] of what three blocks may see of each other: what is not later, in each."""
    causal = torch.ones(size, size, dtype=torch.bool, device=device).tril()
    return causal.repeat(3, 3)[None]


def code_errors(logits: Tensor, codes: Tensor) -> Tensor:
    """Cross-entropy [B, L, 2] of codes int64 [B, L, 2]; logits [B, L, 2, K]."""
    each = functional.cross_entropy(logits.float().flatten(0, 2), codes.flatten(), reduction="none")
    return each.view(codes.shape)


def music_of_codes(
    music: Tensor, code_frames: int, codes: int | None = None, *, first: bool = False
) -> Tensor:
    """Mean music [B, L, E] of each code's frames, or of their `first`; music [B, T, E] is 0 after its end."""
    count = -(-music.shape[1] // code_frames) if codes is None else codes
    rows = functional.pad(
        music[:, : count * code_frames], (0, 0, 0, max(0, count * code_frames - music.shape[1]))
    )
    frames = rows.reshape(len(music), count, code_frames, -1)
    return frames[:, :, 0] if first else frames.mean(2)


class RewardConfig(Config):
    """Rewards of dances, and the turns of actor and critic; the defaults are the published ones."""

    critic_layers: int = Field(default=3, ge=1)
    scale: float = Field(default=10.0, gt=0)
    """A code with both beats is worth half of this, any other the negative half."""
    discount: float = Field(default=1.0, ge=0, le=1)
    actor_steps: int = Field(default=5, ge=1)
    critic_steps: int = Field(default=5, ge=1)
    """Steps of a turn."""
    temperature: float = Field(default=0.0, ge=0)
    """Temperature of the codes drawn in training; 0 takes the likeliest."""
    contexts: int = Field(default=4, ge=1)
    """Contexts that a clip's dance in training goes on for at most [ours]; pieces whole are published."""


class Critic(nn.Module):
    """Shared states [B, 3 L, D] -> what is still to come [B, L, 2], by half."""

    def __init__(self, config: CrossGptConfig, layers: int) -> None:
        super().__init__()
        self.stack = Transformer(config, layers)
        self.out = nn.ModuleList(nn.Linear(config.dim, 1, bias=False) for _ in range(2))

    def forward(self, states: Tensor, visible: Tensor) -> Tensor:
        """`visible` as of `tiled_causal`."""
        blocks = three_blocks(self.stack(states, visible))
        return torch.cat([out(blocks[:, k + 1]) for k, out in enumerate(self.out)], dim=-1)


class ActorCritic(nn.Module):
    """Both."""

    def __init__(self, gpt: CrossGpt, critic_layers: int) -> None:
        super().__init__()
        self.gpt = gpt
        self.critic = Critic(gpt.config, critic_layers)
