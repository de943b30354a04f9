"""`Fact`: the full-attention cross-modal transformer of AI Choreographer (Li et al. 2021, section 4).

Some frames of motion and twice as many of music each go through a transformer of their own; a third one lets
all positions of both see each other, and its first outputs are the next frames of the motion. There is no
causal mask: nothing that is to be predicted is read.

As published: LayerNorm before attention and feed-forward and none at the end, no dropout, no bias in the
projections to query, key and value, attention scaled by the width and not by that of a head.

Motion is the normalised columns of a layout, or, of SMPL parameters, the paper's 225 numbers: six zeros, the
translation in metres and 24 rotation matrices, not normalised. Music is, of the 438 published features
(`datasets/audio/features.py`), the paper's 35: onset strength, 20 MFCC, 12 of chroma, note onsets, beats.
Chroma is of the harmonic part and onset strength of the percussive part here, and note onsets are the maxima
of the onset strength [ours]. Other features are read as they are.

Legend: B batch, T0 frames of motion, T1 of music, N predicted, C columns of motion, E of music, D width.
"""

from __future__ import annotations

from typing import Literal, Self

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.models.layers.transformer import Block, StackConfig, Transformer

Columns = Literal["features", "matrices"]

_PUBLISHED = 438
_BASELINE = 35
_MFCC, _CHROMA, _ONSET, _BEAT = slice(0, 20), slice(40, 52), slice(52, 53), slice(53, 54)
_ZEROS = 6


class MotionColumns(nn.Module):
    """Normalised columns [..., C] of a part of a layout <-> what the network reads [..., `dim`]."""

    mean: Tensor
    std: Tensor

    def __init__(self, kind: Columns, layout: MotionLayout, part: Part) -> None:
        super().__init__()
        self.matrices = kind == "matrices"
        self.dim = len(layout.part(part))
        if not self.matrices:
            return
        if not layout.has("pose") or part not in ("all", "bodyhand", "body"):
            raise UserError(
                f"net.columns matrices are made of SMPL parameters (layout smpl75), and layout {layout.name} "
                f"has none; set net.columns: features"
            )
        self.register_buffer("mean", torch.zeros(self.dim))
        self.register_buffer("std", torch.ones(self.dim))
        self.dim = _ZEROS + 3 + 9 * ((self.dim - 3) // 3)

    def learn(self, mean: Tensor, std: Tensor) -> None:
        """Statistics that normalise the columns, [C] each."""
        if self.matrices:
            self.mean.copy_(mean)
            self.std.copy_(std)

    def read(self, motion: Tensor) -> Tensor:
        """Normalised columns to the network's."""
        if not self.matrices:
            return motion
        import roma

        own = motion * self.std + self.mean
        turns = roma.rotvec_to_rotmat(own[..., 3:].reshape(*own.shape[:-1], -1, 3)).flatten(-3)
        return torch.cat([own.new_zeros(*own.shape[:-1], _ZEROS), own[..., :3], turns], dim=-1)

    def write(self, read: Tensor) -> Tensor:
        """The network's columns to normalised ones; matrices become the nearest rotations."""
        if not self.matrices:
            return read
        import roma

        turns = roma.special_procrustes(read[..., _ZEROS + 3 :].reshape(*read.shape[:-1], -1, 3, 3))
        own = torch.cat([read[..., _ZEROS : _ZEROS + 3], roma.rotmat_to_rotvec(turns).flatten(-2)], dim=-1)
        return (own - self.mean) / self.std


def music_width(features: int) -> int:
    """Columns that are read of so many features of music."""
    return _BASELINE if features == _PUBLISHED else features


def read_music(features: Tensor) -> Tensor:
    """Normalised features [B, T, E] -> what the network reads, [B, T, 35] of the published ones."""
    if features.shape[-1] != _PUBLISHED:
        return features
    onset = features[..., _ONSET]
    before, after = (torch.roll(onset, shift, dims=1) for shift in (1, -1))
    # Above its mean, which normalised features have at 0; a crop's ends have no neighbour.
    top = ((onset > before) & (onset >= after) & (onset > 0)).to(onset.dtype)
    top = torch.cat([torch.zeros_like(top[:, :1]), top[:, 1:-1], torch.zeros_like(top[:, :1])], dim=1)
    return torch.cat([onset, features[..., _MFCC], features[..., _CHROMA], top, features[..., _BEAT]], dim=-1)


class FactConfig(StackConfig):
    """Sizes; the defaults are the published ones, of 60 frames a second."""

    dim: int = Field(default=800, ge=1)
    heads: int = Field(default=10, ge=1)
    ff: int = Field(default=3072, ge=1)
    dropout: float = Field(default=0.0, ge=0, lt=1)
    motion_layers: int = Field(default=2, ge=0)
    music_layers: int = Field(default=2, ge=0)
    layers: int = Field(default=12, ge=1)
    """Layers of the transformer over both."""
    motion_frames: int = Field(default=120, ge=2)
    """Frames of motion that it goes on from."""
    music_frames: int = Field(default=240, ge=3)
    """Frames of music that it hears, from the first of these on."""
    predicted_frames: int = Field(default=20, ge=1)
    """Frames that it learns to predict; in generation it keeps the first."""
    columns: Columns = "features"
    """Motion as the layout's normalised columns, or SMPL parameters as the paper's 225 numbers."""

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
        width = config.dim
        dim = self.columns.dim
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
        size = self.config.motion_frames
        window = self.config.music_frames
        heard = read_music(music)
        heard = nn.functional.pad(heard, (0, 0, 0, max(0, frames + window - heard.shape[1])))
        made = begun.new_empty(len(begun), max(frames, size), self.columns.dim)
        made[:, :size] = self.columns.read(begun)
        for at in range(frames - size):
            made[:, at + size] = self(made[:, at : at + size], heard[:, at : at + window])[:, 0]
        rest = self.columns.write(made[:, size:])
        return torch.cat([begun, rest], dim=1)[:, :frames]
