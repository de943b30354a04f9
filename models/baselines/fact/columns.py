"""How FACT reads motion and music.

Motion: the normalised columns of a layout as they are, or, of SMPL parameters, the paper's 225 numbers: six
zeros, the translation in metres and 24 rotation matrices, not normalised.

Music: of the 438 published features (`datasets/audio/features.py`) those that the paper's 35 are: onset
strength, 20 MFCC, 12 of chroma, note onsets, beats. Chroma is of the harmonic part and onset strength of the
percussive part here, and note onsets are the tops of the onset strength [ours]. Other features are read as
they are.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.datasets.schema import UserError

Columns = Literal["features", "matrices"]

_PUBLISHED, _BASELINE = 438, 35
_MFCC, _CHROMA, _ONSET, _BEAT = slice(0, 20), slice(40, 52), slice(52, 53), slice(53, 54)
_ZEROS = 6


class MotionColumns(nn.Module):
    """Normalised columns [..., C] of a part of a layout <-> what the network reads [..., `dim`]."""

    mean: Tensor
    std: Tensor

    def __init__(self, kind: Columns, layout: MotionLayout, part: Part) -> None:
        super().__init__()
        self.matrices, self.dim = kind == "matrices", len(layout.part(part))
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
        """How columns are normalised, [C] each."""
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
