"""`PatchDiscriminator`: how real a motion is, patch by patch, given its condition (UDE section 3.3).

Temporal convolutions bring a motion to a quarter of its frames; a linear layer brings the global embedding to
the same width and is added to every patch; two transformer layers and one linear layer give a validity score
a patch, after PatchGAN.

Frames after a clip's length are zeroed before anything reads them, so padding does not reveal which
motions were generated, and a clip in a padded batch gives what it gives alone.

The generator minimises -E D(G(p), q), equation 6. The paper leaves the discriminator's own loss open; it is
the hinge loss [ours]: equation 6 is the generator's half of exactly that pair, the generator's gradient does
not fade when the discriminator is sure, and a discriminator that is right by a margin is not pushed further.

Legend: B batch, T frames, D motion features, E condition width, P = ceil(T / 4) patches, C width.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.parametrizations import spectral_norm

from motionloom.datasets.base.config import Config
from motionloom.models.layers.strided import StridedEncoder
from motionloom.models.layers.transformer import StackConfig, Transformer, length_mask, sinusoid
from motionloom.models.training.distributed import masked_mean

PATCH = 4
"""Frames of a patch."""


class DiscriminatorConfig(StackConfig):
    """Sizes: layers and patches of 4 frames are the paper's, widths the public code's but for `ff` (2048)."""

    dim: int = Field(default=1024, ge=2, multiple_of=2)
    """Width of convolutions and transformer."""
    depth: int = Field(default=1, ge=0)
    """Residual blocks after each strided convolution."""
    layers: int = Field(default=2, ge=1)
    spectral_norm: bool = False
    """Divide every linear and convolution weight by its largest singular value [ours]."""


class Validity(NamedTuple):
    """Scores of patches."""

    score: Tensor
    """float32 [B, P], higher is more real; zero where `mask` is false."""
    mask: Tensor
    """bool [B, P]: patches with a real frame."""


class PatchDiscriminator(nn.Module):
    """Scores of motions [B, T, D] given global embeddings [B, E]."""

    def __init__(self, config: DiscriminatorConfig, motion_dim: int, glob_dim: int) -> None:
        super().__init__()
        self.config = config
        self.motion_dim = motion_dim
        self.patches = StridedEncoder(motion_dim, config.dim, width=config.dim, depth=config.depth)
        self.condition = nn.Linear(glob_dim, config.dim)
        self.stack = Transformer(config, config.layers)
        self.score = nn.Linear(config.dim, 1)
        if config.spectral_norm:
            for layer in [m for m in self.modules() if isinstance(m, nn.Linear | nn.Conv1d)]:
                spectral_norm(layer)

    def forward(self, motion: Tensor, glob: Tensor, length: Tensor) -> Validity:
        """Scores of motion [B, T, D] of `length` [B] frames, conditioned on glob [B, E]."""
        if motion.shape[-1] != self.motion_dim:
            raise ValueError(f"built for {self.motion_dim} motion features, got {motion.shape[-1]}")
        frames = motion.shape[1]
        motion = motion.masked_fill(~length_mask(length, frames)[..., None], 0.0)
        motion = functional.pad(motion, (0, 0, 0, -frames % PATCH))
        groups = (length + PATCH - 1) // PATCH
        x = self.patches(motion.to(self.score.weight.dtype), groups * PATCH)
        x = x + self.condition(glob.to(x.dtype))[:, None]
        x = x + sinusoid(x.shape[1], x.shape[2], x.device).to(x.dtype)
        mask = length_mask(groups, x.shape[1])
        score = self.score(self.stack(x, mask))[..., 0]
        score = score.to(torch.promote_types(score.dtype, torch.float32))
        return Validity(score.masked_fill(~mask, 0.0), mask)


class AdversarialConfig(Config):
    """Weights of the adversarial terms."""

    weight: float = Field(default=1.0, ge=0)
    """beta_adv of equation 4; 0 leaves the term out. The public demo has 0.1."""
    gumbel_temperature: float = Field(default=1.0, gt=0)
    """Temperature of the straight-through draw of tokens [ours]."""
    sample: bool = True
    """Draw the tokens that are decoded for the discriminator; false takes the likeliest [ours]."""


def discriminator_loss(real: Validity, fake: Validity) -> dict[str, Tensor]:
    """`loss` = E max(0, 1 - D(real)) + E max(0, 1 + D(fake)), its halves `real` and `fake`, and `accuracy`,
    the share of patches on the right side of 0.

    Each expectation is the mean over the real patches of all ranks.
    """
    terms = {
        "real": masked_mean(functional.relu(1 - real.score), real.mask),
        "fake": masked_mean(functional.relu(1 + fake.score), fake.mask),
    }
    right = masked_mean((real.score > 0).float(), real.mask) + masked_mean(
        (fake.score < 0).float(), fake.mask
    )
    return {"loss": terms["real"] + terms["fake"], **terms, "accuracy": right / 2}


def generator_loss(fake: Validity) -> Tensor:
    """-E D(G(p), q), mean over the real patches of all ranks (equation 6)."""
    return masked_mean(-fake.score, fake.mask)
