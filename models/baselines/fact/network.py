"""`Fact`: the full-attention cross-modal transformer of AI Choreographer (section 4).

Some frames of motion and twice as many of music each go through a transformer of their own; a third one lets
all positions of both see each other, and its first outputs are the next frames of the motion. There is no
causal mask: nothing that is to be predicted is read.

As published: LayerNorm before attention and feed-forward and none at the end, no dropout, no bias in the
projections to query, key and value, attention scaled by the width and not by that of a head.

Legend: B batch, T0 frames of motion, T1 of music, N predicted, C columns of motion, E of music, D width.
"""

from __future__ import annotations

from typing import Self

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.models.baselines.fact.columns import Columns, MotionColumns, music_width, read_music
from motionloom.models.layers.transformer import Block, StackConfig, Transformer


class FactConfig(StackConfig):
    """Sizes; the defaults are the published ones, of 60 frames a second."""

    dim: int = Field(default=800, ge=1)
    heads: int = Field(default=10, ge=1)
    ff: int = Field(default=3072, ge=1)
    dropout: float = Field(default=0.0, ge=0, lt=1)
    motion_layers: int = Field(default=2, ge=0)
    music_layers: int = Field(default=2, ge=0)
    layers: int = Field(default=12, ge=1)
    """Of the transformer over both."""
    motion_frames: int = Field(default=120, ge=2)
    """Frames of motion that it goes on from."""
    music_frames: int = Field(default=240, ge=3)
    """Frames of music that it hears, from the first of these on."""
    predicted_frames: int = Field(default=20, ge=1)
    """Frames that it learns to predict; in generation it keeps the first."""
    columns: Columns = "features"
    """Motion as the layout's normalised columns, or SMPL parameters as the paper's 225 numbers."""
    input_noise: float = Field(default=0.0, ge=0)
    """Standard deviation of noise on the motion that is read in training, so that it learns to go on from
    what it has made itself [ours]; the paper has none."""

    @model_validator(mode="after")
    def _within_the_motion(self) -> Self:
        if self.predicted_frames > self.motion_frames:
            raise ValueError(
                f"predicted_frames {self.predicted_frames} are more than motion_frames {self.motion_frames}: "
                f"predictions are the outputs at the first of them"
            )
        return self

    @property
    def clip_frames(self) -> int:
        """Shortest stretch of a dance that teaches anything."""
        return self.motion_frames + self.predicted_frames

    @property
    def window_frames(self) -> int:
        """Frames of a training window."""
        return max(self.clip_frames, self.music_frames)


class FactStack(Transformer):
    """The shared transformer as FACT has it."""

    def __init__(self, config: FactConfig, layers: int) -> None:
        super().__init__(config, layers, attention_dropout=0.0, qkv_bias=False, last_norm=False)
        for block in self.blocks:
            assert isinstance(block, Block)
            block.attention.scale = config.dim**-0.5


class Fact(nn.Module):
    """Motion [B, T0, C] and music [B, T1, E], both normalised -> the next frames [B, N, C].

    Args:
        music_dim: Width of the features of music.
        kept: Motions of the training set that are kept to go on from.
    """

    kept: Tensor
    """[kept, T0, C], normalised."""

    def __init__(
        self, config: FactConfig, layout: MotionLayout, part: Part, *, music_dim: int, kept: int = 8
    ) -> None:
        super().__init__()
        self.config = config
        self.columns = MotionColumns(config.columns, layout, part)
        width, dim = config.dim, self.columns.dim
        self.motion_in = nn.Linear(dim, width)
        self.music_in = nn.Linear(music_width(music_dim), width)
        self.motion_positions = nn.Parameter(0.02 * torch.randn(config.motion_frames, width))
        self.music_positions = nn.Parameter(0.02 * torch.randn(config.music_frames, width))
        self.motion_stack = FactStack(config, config.motion_layers)
        self.music_stack = FactStack(config, config.music_layers)
        self.stack = FactStack(config, config.layers)
        self.out = nn.Linear(width, dim)
        self.register_buffer("kept", torch.zeros(kept, config.motion_frames, len(layout.part(part))))

    def forward(self, motion: Tensor, music: Tensor) -> Tensor:
        """In the columns of `MotionColumns.read` and `read_music`."""
        moved = self.motion_stack(self.motion_in(motion) + self.motion_positions)
        heard = self.music_stack(self.music_in(music) + self.music_positions)
        both = self.stack(torch.cat([moved, heard], dim=1))
        out: Tensor = self.out(both[:, : self.config.predicted_frames])
        return out

    @torch.no_grad()
    def go_on(self, begun: Tensor, music: Tensor, frames: int) -> Tensor:
        """A motion [B, frames, C] that begins with `begun` [B, T0, C], both normalised, to music [B, L, E].

        Each further frame is the first that is predicted from the T0 before it, so that each costs the same.
        After the end of the music there is its mean, which is 0.
        """
        size, window = self.config.motion_frames, self.config.music_frames
        heard = read_music(music)
        heard = nn.functional.pad(heard, (0, 0, 0, max(0, frames + window - heard.shape[1])))
        made = begun.new_empty(len(begun), max(frames, size), self.columns.dim)
        made[:, :size] = self.columns.read(begun)
        for at in range(frames - size):
            made[:, at + size] = self(made[:, at : at + size], heard[:, at : at + window])[:, 0]
        rest = self.columns.write(made[:, size:])
        return torch.cat([begun, rest], dim=1)[:, :frames]
