"""`InBetweener` [ours]: a network that observes a part of a motion and fills in the rest.

It is the network of `motionloom edit` and of the shipped model `inbetween`. Like MDM it is a transformer
encoder over a condition token and the frames. It differs where a small network on few clips needed it:

- What is known of the motion enters beside the noise (`observed.py`), as in conditional in-betweening models.
- Noisy frames are scaled by sqrt(alpha_bar), the best linear guess of the motion in them, so that nearly pure
  noise enters as nearly zero.
- The condition is added to every frame too, with the text scaled by the root of its width: it comes through
  where frames are next to noise.
- Several frames are one token.

Legend: B batch, T frames, D motion features, E text width.
"""

from __future__ import annotations

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from motionloom.models.diffusion.network import TextDenoiser, TextDenoiserConfig, time_embedding
from motionloom.models.layers.transformer import Transformer, sinusoid, waves
from motionloom.pipeline.editing.inbetween.observed import observed_width


class InBetweenConfig(TextDenoiserConfig):
    """Sizes of the in-betweener, and how it is trained."""

    frames_per_token: int = Field(default=2, ge=1)
    """Frames that are one token together."""
    observed_share: float = Field(default=0.8, ge=0, le=1)
    """Share of the training's samples of which a part is observed."""
    velocity_weight: float = Field(default=2.0, ge=0)
    """Weight of the squared error of frame-to-frame differences, which makes motion smoother."""


class InBetweener(TextDenoiser):
    """Denoiser of motions [B, T, D] normalised, given a text vector [B, E] and what is known of each."""

    config: InBetweenConfig
    signal_scale: Tensor
    """sqrt(alpha_bar) by time step [steps]."""

    def __init__(self, config: InBetweenConfig, motion_dim: int, text_dim: int) -> None:
        super().__init__(config, motion_dim, text_dim)
        scale = torch.from_numpy(np.cumprod(1 - config.schedule.beta_table()) ** 0.5).float()
        self.register_buffer("signal_scale", scale, persistent=False)
        self.frames_per_token = config.frames_per_token
        self.enter = nn.Linear(self.frames_per_token * motion_dim, config.dim)
        self.observed = nn.Linear(self.frames_per_token * observed_width(motion_dim), config.dim, bias=False)
        self.text = nn.Linear(text_dim, config.dim)
        self.time = time_embedding(config.dim)
        self.dropout = nn.Dropout(config.dropout)
        # LayerNorm before attention and feed-forward needs no warm-up, unlike MDM's after the sums.
        self.stack = Transformer(config, config.layers, norm="pre")
        self.leave = nn.Linear(config.dim, self.frames_per_token * motion_dim)

    def forward(
        self,
        noisy: Tensor,
        step: Tensor,
        text: Tensor,
        mask: Tensor,
        conditioned: Tensor,
        observed: Tensor | None = None,
    ) -> Tensor:
        """Return the clean motion of `noisy`; `observed` [B, T, 2 D + 6] is what is known of it, or None."""
        time = self.time(waves(step, self.config.dim).to(self.text.weight.dtype))
        text = text * conditioned[:, None]
        condition = self.text(text * self.text_dim**0.5) + time
        noisy = noisy * self.signal_scale[step][:, None, None].to(noisy.dtype)
        frames = self.enter(self.tokens(noisy * mask[..., None]))
        frames = frames + condition[:, None].to(frames.dtype)
        if observed is not None:
            frames = frames + self.observed(self.tokens(observed.to(frames.dtype)))
        x = torch.cat([condition[:, None].to(frames.dtype), frames], dim=1)
        x = self.dropout(x + sinusoid(x.shape[1], x.shape[2], x.device).to(x.dtype))
        # A token with at least one real frame is attended to.
        visible = torch.cat([mask.new_ones(len(mask), 1), self.tokens(mask[..., None]).any(-1)], dim=1)
        out: Tensor = self.leave(self.stack(x, visible)[:, 1:])
        out = out.view(len(out), -1, self.motion_dim)[:, : mask.shape[1]]
        # Half precision ends here: losses and samplers subtract nearly equal motions.
        return out.to(torch.promote_types(out.dtype, torch.float32)) * mask[..., None]

    def tokens(self, frames: Tensor) -> Tensor:
        """Return [B, T / k, k D] of frames [B, T, D], k frames a token, with zeros after the last."""
        per = self.frames_per_token
        whole = nn.functional.pad(frames, (0, 0, 0, -frames.shape[1] % per))
        return whole.reshape(len(frames), -1, per * frames.shape[2])
