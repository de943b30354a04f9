"""The text-motion evaluator of Guo et al. (CVPR 2022, "Generating Diverse and Natural 3D Human Motions from
Text"): HumanTOMATO and UDE measure FID, R-Precision, Matching score, Diversity and MModality in its latents.

A motion is cut into units of four frames by two strided convolutions that an autoencoder has learnt; a
bidirectional GRU reads the units, another the words, and each ends in a latent. Distances between latents are
plain Euclidean ones.

Notable choices:
- Foot contacts are not read, as published (`dim - 4`); the autoencoder reconstructs them.
- `root_gain` multiplies the root's columns and the contacts after the normalisation. The published code
  divides their deviations by 5 instead, which is the same.
- Frames after the last whole unit are 0, the mean, and a motion shorter than `max_frames` is followed by
  such frames, as in the published evaluation, which pads all motions to one length. Only the four frames
  after a motion reach its last unit, so no more are added, and a motion's result is independent of its batch.
- The backward GRU reads each sequence reversed within its own length instead of packed sequences: equal, and
  no length has to be known on the CPU.
- GRUs compute in the type of their weights, autocast or not: a state is carried over a whole motion.

Legend: B batch, T frames, D motion features, U units, S words, E word features, G word classes, Z latent
width.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor, nn

from motionloom.datasets.base.config import Config
from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.models.layers.transformer import length_mask

PART: Part = "bodyhand"
"""The columns that are judged; a face has no counterpart in the published evaluator."""

UNIT = 4
"""Frames of a unit."""

_SLOPE = 0.2
"""Slope of the leaky ReLUs below zero."""

_GAINED = ("root_yaw_velocity", "root_xz_velocity", "root_height", "foot_contacts")
_UNREAD = "foot_contacts"


class EvaluatorConfig(Config):
    """Sizes; the defaults are the published ones."""

    movement_hidden: int = Field(default=512, ge=1)
    movement: int = Field(default=512, ge=1)
    """Width of a unit of four frames."""
    motion_hidden: int = Field(default=1024, ge=1)
    text_hidden: int = Field(default=512, ge=1)
    latent: int = Field(default=512, ge=1)
    dropout: float = Field(default=0.2, ge=0, lt=1)
    """Dropout of the movement encoder while it is trained."""
    root_gain: float = Field(default=5.0, gt=0)
    """Weight of the root's columns and foot contacts relative to others."""


class MovementEncoder(nn.Module):
    """Motion to units: two convolutions of stride two and a linear layer."""

    def __init__(self, config: EvaluatorConfig, dim: int) -> None:
        super().__init__()
        self.rate = config.dropout
        self.first = nn.Conv1d(dim, config.movement_hidden, 4, 2, 1)
        self.second = nn.Conv1d(config.movement_hidden, config.movement, 4, 2, 1)
        self.out = nn.Linear(config.movement, config.movement)
        _start(self)

    def forward(self, x: Tensor, *, dropout: bool = False) -> Tensor:
        """[B, T, D] -> units [B, T // 4, C]; `dropout` in training mode alone, of the autoencoder."""
        x = x.mT
        drop = dropout and self.training
        for layer in (self.first, self.second):
            x = F.leaky_relu(F.dropout(layer(x), self.rate, drop), _SLOPE)
        out: Tensor = self.out(x.mT)
        return out


class MovementDecoder(nn.Module):
    """Units back to motion, which the movement encoder is trained with; no latent needs it."""

    def __init__(self, config: EvaluatorConfig, dim: int) -> None:
        super().__init__()
        self.first = nn.ConvTranspose1d(config.movement, config.movement_hidden, 4, 2, 1)
        self.second = nn.ConvTranspose1d(config.movement_hidden, dim, 4, 2, 1)
        self.out = nn.Linear(dim, dim)
        _start(self)

    def forward(self, units: Tensor) -> Tensor:
        x = units.mT
        for layer in (self.first, self.second):
            x = F.leaky_relu(layer(x), _SLOPE)
        out: Tensor = self.out(x.mT)
        return out


class SequenceEncoder(nn.Module):
    """A sequence to one latent: the last states of a bidirectional GRU whose first state is learnt."""

    def __init__(self, dim: int, hidden: int, latent: int) -> None:
        super().__init__()
        self.project = nn.Linear(dim, hidden)
        self.ahead = nn.GRU(hidden, hidden, batch_first=True)
        self.back = nn.GRU(hidden, hidden, batch_first=True)
        self.start = nn.Parameter(torch.randn(2, hidden))
        self.narrow = nn.Linear(2 * hidden, hidden)
        self.norm = nn.LayerNorm(hidden)
        self.out = nn.Linear(hidden, latent)
        _start(self)

    def forward(self, x: Tensor, length: Tensor) -> Tensor:
        """x [B, L, dim], length int64 [B] of at least 1 -> [B, Z] in the type of the weights."""
        with torch.autocast(x.device.type, enabled=False):
            x = self.project(x.to(self.project.weight.dtype))
            position = torch.arange(x.shape[1], device=x.device)[None]
            mirrored = torch.where(position < length[:, None], length[:, None] - 1 - position, position)
            reverse = x.gather(1, mirrored[..., None].expand_as(x))
            last = (length - 1)[:, None, None].expand(-1, 1, self.start.shape[1])
            ends = []
            for gru, sequence, first in ((self.ahead, x, self.start[0]), (self.back, reverse, self.start[1])):
                states, _ = gru(sequence, first.expand(1, len(x), -1).contiguous())
                ends.append(states.gather(1, last)[:, 0])
            hidden = self.norm(self.narrow(torch.cat(ends, dim=-1)))
            out: Tensor = self.out(F.leaky_relu(hidden, _SLOPE))
            return out


class Evaluator(nn.Module):
    """Movement encoder, motion encoder and text encoder over one latent space.

    Args:
        layout: Of the motions; the columns of `PART` are read, normalised.
        text_dim: E.
        max_frames: Frames that every motion is padded to, a multiple of four; longer ones are refused.
        classes: G, of words that come with a class each (part of speech); 0 = none.
    """

    read_columns: Tensor
    gain: Tensor

    def __init__(
        self,
        config: EvaluatorConfig,
        layout: MotionLayout,
        text_dim: int,
        max_frames: int,
        *,
        classes: int = 0,
    ) -> None:
        super().__init__()
        if max_frames < UNIT or max_frames % UNIT:
            raise ValueError(f"max_frames {max_frames} is no multiple of {UNIT}")
        self.config = config
        self.text_dim = text_dim
        self.classes = classes
        self.max_frames = max_frames
        columns = layout.part(PART)
        self.motion_dim = len(columns)
        unread = np.arange(layout.dim)[layout.slice(_UNREAD)] if layout.has(_UNREAD) else columns[:0]
        gained = [np.arange(layout.dim)[layout.slice(name)] for name in _GAINED if layout.has(name)]
        gain = np.where(np.isin(columns, np.concatenate([*gained, unread])), config.root_gain, 1.0)
        read = np.flatnonzero(~np.isin(columns, unread))
        self.register_buffer("gain", torch.from_numpy(gain).float(), persistent=False)
        self.register_buffer("read_columns", torch.from_numpy(read), persistent=False)
        self.movement_encoder = MovementEncoder(config, len(read))
        self.motion_encoder = SequenceEncoder(config.movement, config.motion_hidden, config.latent)
        self.class_embedding = nn.Linear(classes, text_dim) if classes else None
        if self.class_embedding is not None:
            _start(self.class_embedding)
        self.text_encoder = SequenceEncoder(text_dim, config.text_hidden, config.latent)

    def decoder(self) -> MovementDecoder:
        return MovementDecoder(self.config, self.motion_dim)

    def whole_units(self, x: Tensor, length: Tensor, present: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Motions [B, T, D] with the gains on and 0 after whole units and where `present` bool [B, D] is
        false, followed by as many frames of 0 as can matter; and their numbers of units, int64 [B].
        """
        if x.shape[-1] != self.motion_dim:
            raise ValueError(f"this evaluator was built for {self.motion_dim} features, got {x.shape[-1]}")
        if x.shape[1] > self.max_frames:
            raise ValueError(f"{x.shape[1]} frames, and at most {self.max_frames} can be judged")
        units = (length // UNIT).clamp(min=1)
        known = length_mask(torch.minimum(units * UNIT, length), x.shape[1])[..., None]
        x = torch.where(known, x * self.gain.to(x.dtype), 0.0)
        x = x if present is None else x.masked_fill(~present[:, None], 0.0)
        return F.pad(x, (0, 0, 0, min(x.shape[1] + UNIT, self.max_frames) - x.shape[1])), units

    def encode_motion(self, x: Tensor, length: Tensor, present: Tensor | None = None) -> Tensor:
        """x [B, T, D] normalised features, length int64 [B] frames, `present` bool [B, D] (None = all) ->
        latents [B, Z]. The movement encoder is fixed here: no gradient reaches it, nothing is dropped.
        """
        frames = x.shape[1]
        x, units = self.whole_units(x, length, present)
        with torch.no_grad():
            movements = self.movement_encoder(x[..., self.read_columns])[:, : max(1, frames // UNIT)]
        latent: Tensor = self.motion_encoder(movements, units)
        return latent

    def encode_text(self, words: Tensor, mask: Tensor, classes: Tensor | None = None) -> Tensor:
        """words [B, S, E], mask bool [B, S], `classes` one-hot [B, S, G] or None -> latents [B, Z]."""
        if words.shape[-1] != self.text_dim:
            raise ValueError(
                f"this evaluator was built for {self.text_dim} text features, got {words.shape[-1]}"
            )
        if self.class_embedding is not None:
            if classes is None:
                raise ValueError(f"this evaluator reads words with their classes, {self.classes} of them")
            kind = self.class_embedding.weight.dtype
            words = words.to(kind) + self.class_embedding(classes.to(kind))
        latent: Tensor = self.text_encoder(words, mask.sum(1))
        return latent


def _start(module: nn.Module) -> None:
    """First weights as published: Xavier's, biases 0; GRUs keep torch's."""
    for layer in module.modules():
        if isinstance(layer, nn.Conv1d | nn.ConvTranspose1d | nn.Linear):
            nn.init.xavier_normal_(layer.weight)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
