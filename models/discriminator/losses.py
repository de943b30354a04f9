"""Adversarial losses over patches (UDE equation 6), with masks, equal over ranks.

The generator minimises -E D(G(p), q), equation 6. The paper leaves the discriminator's own loss open; it is
the hinge loss [ours]: equation 6 is the generator's half of exactly that pair, the generator's gradient does
not fade when the discriminator is sure (it is not saturating), and a discriminator that is right by a margin
is not pushed further. The gradient penalty is R1 on real motions (Mescheder et al. 2018), off unless it has a
weight.
"""

from __future__ import annotations

import torch
from pydantic import Field
from torch import Tensor
from torch.nn import functional
from torch.nn.attention import SDPBackend, sdpa_kernel

from motionloom.datasets.schema import Config
from motionloom.models.discriminator.patch import PatchDiscriminator, Validity
from motionloom.models.layers.transformer import length_mask
from motionloom.models.training.distributed import masked_mean


class AdversarialConfig(Config):
    """Weights of the adversarial terms."""

    weight: float = Field(default=1.0, ge=0)
    """beta_adv of equation 4; 0 leaves the term out. The public demo has 0.1."""
    gradient_penalty: float = Field(default=0.0, ge=0)
    """Weight of R1 in the discriminator's loss [ours]."""
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


def gradient_penalty(net: PatchDiscriminator, motion: Tensor, glob: Tensor, length: Tensor) -> Tensor:
    """R1: the squared norm of what one frame's features change in the scores, mean over real frames.

    motion [B, T, D] and glob [B, E] are real and need no gradient; the result is differentiable in the
    network.
    """
    with torch.enable_grad():
        motion = motion.detach().requires_grad_()
        # Fused attention has no second derivative.
        with sdpa_kernel(SDPBackend.MATH):
            score, _ = net(motion, glob.detach(), length)
            (gradient,) = torch.autograd.grad(score.sum(), motion, create_graph=True)
        return masked_mean(gradient.square().sum(-1), length_mask(length, motion.shape[1]))
