"""Config of the loss of MATE and UTT, L = L_ce + beta_adv L_adv (UDE equations 4 to 6).

The cross-entropy and its figures are those of `models/gpt/losses.py`, and so is the motion that predicted
tokens decode to with their gradient (`soft_motion`) [ours]; `discriminator/losses.py` judges it.
"""

from __future__ import annotations

from pydantic import Field

from motionloom.datasets.schema import Config
from motionloom.models.discriminator.losses import AdversarialConfig
from motionloom.models.discriminator.patch import DiscriminatorConfig
from motionloom.models.training.optim import OptimConfig


class UttLossConfig(Config):
    """The loss of MATE and UTT."""

    adversarial: AdversarialConfig = AdversarialConfig()
    adversarial_start: int = Field(0, ge=0)
    """First step with the adversarial term, and the discriminator's first step."""
    adversarial_ramp: int = Field(0, ge=0)
    """Steps over which its weight rises from 0."""
    discriminator: DiscriminatorConfig = DiscriminatorConfig()
    discriminator_optim: OptimConfig = OptimConfig(optimizer="adam", betas=(0.5, 0.99))

    def weight(self, step: int) -> float:
        since = step - self.adversarial_start
        if since < 0:
            return 0.0
        rise = 1.0 if self.adversarial_ramp == 0 else min(1.0, (since + 1) / self.adversarial_ramp)
        return self.adversarial.weight * rise
