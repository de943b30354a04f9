"""Adversarial losses over patches (UDE equation 6), with masks, equal over ranks.

The generator minimises -E D(G(p), q), equation 6. The paper leaves the discriminator's own loss open; it is
the hinge loss [ours]: equation 6 is the generator's half of exactly that pair, the generator's gradient does
not fade when the discriminator is sure (it is not saturating), and a discriminator that is right by a margin
is not pushed further.
"""

from __future__ import annotations

from pydantic import Field
from torch import Tensor
from torch.nn import functional

from motionloom.datasets.schema import Config
from motionloom.models.discriminator.patch import Validity
from motionloom.models.training.distributed import masked_mean


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
