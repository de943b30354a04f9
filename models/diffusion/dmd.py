"""`Dmd`: UDE's diffusion motion decoder (section 3.4), which turns motion tokens into varied motions.

A token encoder reads the code streams once; a diffusion decoder reads the noisy frames, the time step and
the encoder's output, and predicts the noise.

Notable choices:
- Encoded tokens join the frames by place, not by cross-attention [ours]: each group of tokens belongs to
  four known frames, so a linear layer writes each group out as its four frames and is added there. Nothing
  about that alignment has to be learnt, it costs nothing, and a stretch of frames carries its own tokens,
  which is what long motions in windows need (`sampling.py`).
- Any streams and pattern of `gpt/tokens.py`: every token of a group is one position of the encoder.
- Trained with `hide`, the network also fills in frames whose tokens it is not shown [ours], so a change of
  conditions can be bridged instead of decoded from tokens that no clip ever had side by side.
- The time step is added to every frame. Positions are sinusoidal.

Legend: B batch, T frames, D motion features, G groups of four frames, P slots of a group, C width.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Self

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from motionloom.models.diffusion.network import step_waves
from motionloom.models.diffusion.schedule import ScheduleConfig
from motionloom.models.gpt.tokens import slot_codes, stream_names
from motionloom.models.layers.transformer import StackConfig, Transformer, length_mask, sinusoid
from motionloom.models.tokenizer.base import GROUP_FRAMES, Stream


class DmdConfig(StackConfig):
    """Sizes; the defaults are the paper's (section 4.2), at the public demo's width of 512."""

    dim: int = Field(default=512, ge=2, multiple_of=2)
    encoder_layers: int = Field(default=8, ge=1)
    decoder_layers: int = Field(default=8, ge=1)
    attention_dropout: float = Field(default=0.1, ge=0, lt=1)
    hide: float = Field(default=0.0, ge=0, le=1)
    """Share of training windows in which a stretch of tokens is hidden [ours]; 0 is the paper's."""
    velocity_weight: float = Field(default=0.0, ge=0)
    """Weight of the same error between frame-to-frame differences, which makes motion smoother [ours, after
    MDM]; for networks that predict the motion. 0 is the paper's."""
    schedule: ScheduleConfig = ScheduleConfig(betas="linear", predicts="epsilon")

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.velocity_weight and self.schedule.predicts != "sample":
            raise ValueError("velocity_weight is for schedule: {predicts: sample}; noise has no velocity")
        return self


class Dmd(nn.Module):
    """Denoiser of normalised motions [B, T, D] given the tokens of each.

    Args:
        pattern: Stream of every slot of a group.
        motion_dim: D.
    """

    def __init__(
        self, config: DmdConfig, streams: Sequence[Stream], pattern: Sequence[str], motion_dim: int
    ) -> None:
        super().__init__()
        self.config = config
        self.pattern = tuple(pattern)
        self.names = stream_names(pattern)
        self.motion_dim = motion_dim
        sizes = {stream.name: stream.num_codes for stream in streams}
        dim = config.dim
        tables = {name: nn.Embedding(sizes[name], dim) for name in self.names}
        for table in tables.values():
            nn.init.normal_(table.weight, std=dim**-0.5)
        self.embeddings = nn.ModuleDict(tables)
        self.slot = nn.Parameter(torch.randn(len(self.pattern), dim) * dim**-0.5)
        self.encoder = self._stack(config.encoder_layers)
        self.to_frames = nn.Linear(len(self.pattern) * dim, GROUP_FRAMES * dim)
        self.motion_in = nn.Linear(motion_dim, dim)
        self.time = nn.Sequential(nn.Linear(dim, dim), nn.SiLU(), nn.Linear(dim, dim))
        self.decoder = self._stack(config.decoder_layers)
        self.motion_out = nn.Linear(dim, motion_dim)

    def forward(
        self,
        noisy: Tensor,
        step: Tensor,
        codes: Mapping[str, Tensor],
        length: Tensor,
        hidden: Tensor | None = None,
    ) -> Tensor:
        """`denoise` of noisy [B, T, D] at step [B], given the tokens of clips of `length` [B] frames."""
        groups = (length + GROUP_FRAMES - 1) // GROUP_FRAMES
        condition = self.encode_tokens(codes, groups, hidden)
        return self.denoise(noisy, step, condition, length_mask(length, noisy.shape[1]))

    def encode_tokens(
        self, codes: Mapping[str, Tensor], groups: Tensor, hidden: Tensor | None = None
    ) -> Tensor:
        """Condition of each frame from the tokens, [B, 4 G, C]; computed once a motion, not at each step.

        Args:
            codes: Per stream int64 [B, G * per_group].
            groups: int64 [B], groups that count; the others are padding.
            hidden: Bool [B, G], groups whose tokens are read as zero.
        """
        by_slot = slot_codes(codes, self.pattern).unbind(2)
        vectors = [self.embeddings[name](one) for name, one in zip(self.pattern, by_slot, strict=True)]
        x = torch.stack(vectors, dim=2)
        if hidden is not None:
            x = x.masked_fill(hidden[..., None, None], 0.0)
        x = x + self.slot
        x = x + sinusoid(x.shape[1], x.shape[3], x.device)[:, None].to(x.dtype)
        mask = length_mask(groups, x.shape[1]).repeat_interleave(len(self.pattern), dim=1)
        batch, count = x.shape[:2]
        states = self.encoder(x.flatten(1, 2), mask).reshape(batch, count, -1)
        out: Tensor = self.to_frames(states).reshape(batch, count * GROUP_FRAMES, -1)
        return out

    def denoise(self, noisy: Tensor, step: Tensor, condition: Tensor, mask: Tensor) -> Tensor:
        """The noise in `noisy` (or the clean motion, as the schedule predicts); zero where masked.

        Args:
            noisy: [B, T, D].
            step: int64 [B], time step of each row.
            condition: [B, T or more, C], of `encode_tokens`.
            mask: bool [B, T], True = real frame.
        """
        if noisy.shape[-1] != self.motion_dim:
            raise ValueError(f"the DMD was built for {self.motion_dim} features, got {noisy.shape[-1]}")
        frames = noisy.shape[1]
        if condition.shape[1] < frames:
            raise ValueError(f"tokens of {condition.shape[1]} frames were given for {frames} frames")
        dtype = self.motion_in.weight.dtype
        time = self.time(step_waves(step, self.config.dim).to(dtype))
        x = self.motion_in(noisy.to(dtype)) + condition[:, :frames] + time[:, None]
        x = x + sinusoid(frames, x.shape[2], x.device).to(x.dtype)
        out: Tensor = self.motion_out(self.decoder(x, mask))
        out = out.to(torch.promote_types(out.dtype, torch.float32))
        return out.masked_fill(~mask[..., None], 0.0)

    def _stack(self, layers: int) -> Transformer:
        config = self.config
        return Transformer(config, layers, attention_dropout=config.attention_dropout)
