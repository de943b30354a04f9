"""MDM's network `trans_enc` (Tevet et al. 2023, section 3.2; HumanTOMATO B.5.2 follows it for faces).

The condition, projected text plus embedded time step, is one token in front of the frames; every frame is one
more token. The output at the frames is the clean motion. Hidden texts are zeros before the projection, so
that its bias remains.

Legend: B batch, T frames, D motion features, E text width.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from motionloom.models.diffusion.network import TextDenoiser, TextDenoiserConfig, time_embedding
from motionloom.models.layers.linear import Linear
from motionloom.models.layers.transformer import Transformer, sinusoid, waves


class Mdm(TextDenoiser):
    """MDM: a transformer encoder, LayerNorm after the sums, over a condition token and the frames."""

    def __init__(self, config: TextDenoiserConfig, motion_dim: int, text_dim: int) -> None:
        super().__init__(config, motion_dim, text_dim)
        self.enter = Linear(motion_dim, config.dim)
        self.text = nn.Linear(text_dim, config.dim)
        self.time = time_embedding(config.dim)
        self.dropout = nn.Dropout(config.dropout)
        self.stack = Transformer(config, config.layers, norm="post")
        self.leave = Linear(config.dim, motion_dim)

    def forward(self, noisy: Tensor, step: Tensor, text: Tensor, mask: Tensor, conditioned: Tensor) -> Tensor:
        time = self.time(waves(step, self.config.dim).to(self.text.weight.dtype))
        condition = self.text(text * conditioned[:, None]) + time
        frames = self.enter(noisy * mask[..., None])
        x = torch.cat([condition[:, None].to(frames.dtype), frames], dim=1)
        x = self.dropout(x + sinusoid(x.shape[1], x.shape[2], x.device).to(x.dtype))
        visible = torch.cat([mask.new_ones(len(mask), 1), mask], dim=1)
        out: Tensor = self.leave(self.stack(x, visible)[:, 1:])
        # Half precision ends here: losses and samplers subtract nearly equal motions.
        return out.to(torch.promote_types(out.dtype, torch.float32)) * mask[..., None]
