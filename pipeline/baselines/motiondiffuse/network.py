"""`MotionDiffuse`: a denoiser whose layers attend in linear time and are styled by text and time step.

Written from the paper (Zhang et al., "MotionDiffuse", arXiv 2208.15001). A trainable encoder reads the frozen
token states of a caption. Each layer attends to the frames, then to the caption, then feeds forward; each of
the three ends in a `Stylization` that the time step and the caption's last token modulate, and which adds
nothing at first: its last weights start at zero.

Linear attention (Shen et al., "Efficient attention"): queries are normalised over the channels of a head and
keys over the positions, so that keys and values make one small matrix which every query reads. Padding of
captions is not attended to [ours]: a motion does not depend on its batch.

Legend: B batch, T frames, D motion features, L tokens, E their width, C width, S style width (4 C).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from pydantic import Field
from torch import Tensor, nn

from motionloom.datasets.conditions import Condition
from motionloom.models.diffusion.network import step_waves
from motionloom.models.diffusion.schedule import ScheduleConfig
from motionloom.models.layers.linear import product_type
from motionloom.models.layers.transformer import LayerNorm, StackConfig, Transformer


class CaptionConfig(StackConfig):
    """The encoder of captions."""

    dim: int = Field(default=256, ge=1)
    layers: int = Field(default=4, ge=1)
    heads: int = Field(default=4, ge=1)
    ff: int = Field(default=2048, ge=1)
    dropout: float = Field(default=0.0, ge=0, lt=1)


class MotionDiffuseConfig(StackConfig):
    """Sizes; the defaults are the paper's. Noise passes only through networks as wide as there are columns:
    narrower ones need `schedule: {betas: linear, predicts: sample}` [ours].
    """

    dim: int = Field(default=512, ge=2, multiple_of=2)
    layers: int = Field(default=8, ge=1)
    dropout: float = Field(default=0.0, ge=0, lt=1)
    caption: CaptionConfig = CaptionConfig()
    schedule: ScheduleConfig = ScheduleConfig(betas="linear", predicts="epsilon")


class Words(NamedTuple):
    """Captions as the layers read them."""

    states: Tensor
    """[B, L, C of captions]"""
    mask: Tensor
    """bool [B, L]"""
    whole: Tensor
    """[B, S]: each in one vector."""

    def rows(self, chosen: list[int]) -> Words:
        """Some of them."""
        return Words(*(value[chosen] for value in self))


def linear_attention(query: Tensor, key: Tensor, value: Tensor, mask: Tensor) -> Tensor:
    """Attention in linear time, [B, H, T, c]: query [B, H, T, c], key and value [B, H, S, c], mask [B, S]."""
    seen = mask[:, None, :, None]
    key = key.masked_fill(~seen, -1e6).softmax(dim=2)
    return query.softmax(dim=3) @ (key.transpose(2, 3) @ (value * seen))


class Attend(nn.Module):
    """Frames that attend to themselves, or to `memory_dim` wide states."""

    def __init__(self, config: MotionDiffuseConfig, memory_dim: int | None = None) -> None:
        super().__init__()
        dim = config.dim
        self.heads = config.heads
        self.norm = LayerNorm(dim)
        self.norm_memory = None if memory_dim is None else LayerNorm(memory_dim)
        self.query = nn.Linear(dim, dim)
        self.key = nn.Linear(memory_dim or dim, dim)
        self.value = nn.Linear(memory_dim or dim, dim)

    def forward(self, x: Tensor, mask: Tensor, memory: Tensor | None = None) -> Tensor:
        """x [B, T, C] and what `mask` [B, S] shows: of x itself, or of a memory [B, S, M] -> [B, T, C]."""
        x = self.norm(x).to(product_type(x))  # once, not for each of the three
        read = x if self.norm_memory is None or memory is None else self.norm_memory(memory).to(x.dtype)
        query, key, value = (self._split(part) for part in (self.query(x), self.key(read), self.value(read)))
        return linear_attention(query, key, value, mask).transpose(1, 2).flatten(2)

    def _split(self, x: Tensor) -> Tensor:
        return x.view(*x.shape[:2], self.heads, -1).transpose(1, 2)


class Stylization(nn.Module):
    """Scale and shift of normalised frames by a style [B, S]; what it returns is added to the frames."""

    def __init__(self, dim: int, style: int, dropout: float) -> None:
        super().__init__()
        self.modulate = nn.Sequential(nn.SiLU(), nn.Linear(style, 2 * dim))
        self.norm = LayerNorm(dim)
        self.out = nn.Sequential(nn.SiLU(), nn.Dropout(dropout), zeroed(nn.Linear(dim, dim)))

    def forward(self, x: Tensor, style: Tensor) -> Tensor:
        """x [B, T, C]."""
        scale, shift = self.modulate(style)[:, None].chunk(2, dim=-1)
        out: Tensor = self.out(self.norm(x) * (1 + scale) + shift)
        return out


class Layer(nn.Module):
    """Attention to frames, to the caption, and a feed-forward, each styled."""

    def __init__(self, config: MotionDiffuseConfig) -> None:
        super().__init__()
        dim = config.dim
        self.frames = Attend(config)
        self.caption = Attend(config, config.caption.dim)
        self.feed = nn.Sequential(
            nn.Linear(dim, config.ff),
            nn.GELU(),
            nn.Dropout(config.dropout),
            zeroed(nn.Linear(config.ff, dim)),
        )
        self.styles = nn.ModuleList(Stylization(dim, 4 * dim, config.dropout) for _ in range(3))

    def forward(self, x: Tensor, mask: Tensor, words: Words, style: Tensor) -> Tensor:
        """x [B, T, C], mask bool [B, T], style [B, S]."""
        first, second, third = self.styles
        x = x + first(self.frames(x, mask), style)
        x = x + second(self.caption(x, words.mask, words.states), style)
        out: Tensor = x + third(self.feed(x), style)
        return out


class MotionDiffuse(nn.Module):
    """Denoiser of normalised motions [B, T, D], T at most `max_frames`, given the tokens of a caption each.

    Args:
        motion_dim: D.
        text_dim: E.
    """

    def __init__(
        self, config: MotionDiffuseConfig, motion_dim: int, text_dim: int, max_frames: int = 196
    ) -> None:
        super().__init__()
        self.config = config
        self.motion_dim = motion_dim
        self.max_frames = max_frames
        dim = config.dim
        caption = config.caption
        self.positions = nn.Parameter(torch.randn(max_frames, dim) * dim**-0.5)
        self.tokens = nn.Linear(text_dim, caption.dim)
        self.reader = Transformer(caption, caption.layers, norm="post")
        self.reader_norm = LayerNorm(caption.dim)
        self.whole = nn.Linear(caption.dim, 4 * dim)
        self.time = nn.Sequential(nn.Linear(dim, 4 * dim), nn.SiLU(), nn.Linear(4 * dim, 4 * dim))
        self.enter = nn.Linear(motion_dim, dim)
        self.layers = nn.ModuleList(Layer(config) for _ in range(config.layers))
        self.leave = zeroed(nn.Linear(dim, motion_dim))

    def forward(self, noisy: Tensor, step: Tensor, text: Condition, mask: Tensor) -> Tensor:
        """`denoise` of noisy [B, T, D] at step [B], given captions."""
        return self.denoise(noisy, step, self.read(text), mask)

    def read(self, text: Condition) -> Words:
        """Captions, encoded; computed once a motion, not at each step."""
        states = self.reader_norm(self.reader(self.tokens(text.features.to(self.tokens.weight)), text.mask))
        place = torch.arange(states.shape[1], device=states.device)
        last = place.masked_fill(~text.mask, 0).amax(1)
        return Words(states, text.mask, self.whole(states[torch.arange(len(last), device=last.device), last]))

    def denoise(self, noisy: Tensor, step: Tensor, words: Words, mask: Tensor) -> Tensor:
        """Predicted noise in noisy [B, T, D] at step int64 [B]; zero where `mask` bool [B, T] is False."""
        frames = noisy.shape[1]
        waves = step_waves(step, self.config.dim).roll(self.config.dim // 2, dims=1)  # cosines first
        style = self.time(waves.to(noisy.dtype)) + words.whole
        x = self.enter(noisy) + self.positions[:frames]
        for layer in self.layers:
            x = layer(x, mask, words, style)
        out: Tensor = self.leave(x)
        return out.to(torch.promote_types(out.dtype, torch.float32)) * mask[..., None]


def zeroed(layer: nn.Linear) -> nn.Linear:
    """The layer, its weights zero."""
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer
