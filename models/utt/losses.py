"""From the UTT's logits to motion that a discriminator can judge (UDE equations 4 to 6).

L = L_ce + beta_adv L_adv. The cross-entropy and its figures are those of `models/gpt/losses.py`. For L_adv
predicted tokens become motion and keep their gradient: straight-through Gumbel one-hots over each codebook
(End excluded) [ours], then the frozen tokenizer's soft decoder; `discriminator/losses.py` judges the result.
"""

from __future__ import annotations

from typing import NamedTuple

from pydantic import Field
from torch import Tensor

from motionloom.datasets.schema import Config
from motionloom.models.discriminator.losses import AdversarialConfig
from motionloom.models.discriminator.patch import DiscriminatorConfig
from motionloom.models.gpt.losses import group_counts, soft_codes
from motionloom.models.gpt.token_network import TokenNetwork
from motionloom.models.tokenizer.base import Tokenizer
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


class SoftMotion(NamedTuple):
    """A motion with a gradient to the logits it comes from."""

    motion: Tensor
    """[B, T, dim], zero after `length`."""
    length: Tensor
    """int64 [B], frames."""


def soft_motion(
    net: TokenNetwork,
    logits: Tensor,
    tokens: Tensor,
    kinds: Tensor,
    *,
    tokenizer: Tokenizer,
    gumbel_temperature: float,
    sample: bool,
    present: Tensor | None = None,
) -> SoftMotion:
    """Decode what logits [B, L, V] predict for the clips of tokens [B, L], kinds [B, L].

    Args:
        logits: Of `net`, with gradient.
        tokens: The clips' own tokens, which determine the number of groups.
        gumbel_temperature: Temperature of the softmax that the one-hots are drawn from.
        sample: Draw from the distribution; false takes the likeliest codes.
        present: bool [B, dim], columns of the tokenizer that the clip has (None = all).
    """
    groups = group_counts(tokens, kinds, net.ends, len(net.pattern))
    weights = soft_codes(net, logits, groups, temperature=gumbel_temperature, sample=sample)
    frames = groups * tokenizer.group_frames
    return SoftMotion(tokenizer.decode_soft(weights, frames, present), frames)
