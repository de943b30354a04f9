"""Training of MATE and UTT end to end, against a conditional patch discriminator (UDE section 3.3).

L = L_ce + beta_adv L_adv (equation 4): cross-entropy of the tokens of real motion, and what a discriminator
says of the motion that the predicted tokens decode to. Tokens are made on the way, by the frozen tokenizer,
so every window of a clip is tokenized as it is.

Notable choices [ours]:
- The adversarial term begins at `adversarial_start` and rises over `adversarial_ramp` steps; the
  discriminator learns from `adversarial_start` on. Before, predictions are noise that teaches it nothing.
- With the term off there is no discriminator.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from motionloom.models.condition.mate import Encoded, drop_conditions
from motionloom.models.discriminator.patch import (
    PatchDiscriminator,
    Validity,
    discriminator_loss,
    generator_loss,
)
from motionloom.models.gpt.losses import accuracy, corrupt, cross_entropy, soft_motion
from motionloom.models.gpt.tokens import TokenSequence, interleave, known_tokens
from motionloom.models.layers.frozen import Frozen
from motionloom.models.tokenizer.base import GROUP_FRAMES, Tokenizer
from motionloom.models.training.alternating import AlternatingModule, OptimizerGroup
from motionloom.models.training.optim import OptimConfig
from motionloom.models.training.stage_module import Batch
from motionloom.models.utt.network import ConditionedUtt, UttLossConfig


class UttModule(AlternatingModule):
    """Trains a `ConditionedUtt` on `ConditionBatches`; the tokenizer is only looked through."""

    net: ConditionedUtt
    pull: Tensor

    def __init__(
        self,
        net: ConditionedUtt,
        optim: OptimConfig,
        *,
        seed: int,
        max_steps: int,
        tokenizer: Tokenizer,
        loss: UttLossConfig | None = None,
    ) -> None:
        super().__init__(net, optim, seed=seed, max_steps=max_steps)
        self.loss_config = loss or UttLossConfig()
        self.tokenizer = Frozen(tokenizer)
        self.discriminator: PatchDiscriminator | None = None
        if self.loss_config.adversarial.weight:
            self.discriminator = PatchDiscriminator(
                self.loss_config.discriminator, tokenizer.dim, net.mate.config.dim
            )

        self.register_buffer("pull", torch.zeros(()), persistent=False)
        self.judged = False
        """Whether the adversarial term is on. It and its weight, `pull`, are set outside of what is compiled,
        which a number that changes with every step would have compiled anew in each."""
        self._weigh()

    def _weigh(self) -> None:
        weight = self.loss_config.weight(self.step)
        self.judged = weight > 0
        self.pull.fill_(weight)

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor | None:
        self._weigh()
        return super().training_step(batch, batch_idx)

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return the figures of token model and critic, scalars [], of a batch as `losses_of` takes it."""
        self._weigh()
        return super().losses(batch)

    def optimizer_groups(self) -> list[OptimizerGroup]:
        """The token model, then the discriminator of what it has made."""
        groups = [OptimizerGroup("tokens", (self.net,), self.optim_config)]
        if self.discriminator is not None:
            config = self.loss_config
            groups.append(
                OptimizerGroup(
                    "critic",
                    (self.discriminator,),
                    config.discriminator_optim,
                    start_step=config.adversarial_start,
                )
            )
        return groups

    def losses_of(self, group: str, batch: Batch, shared: dict[str, Tensor]) -> dict[str, Tensor]:
        """A group's loss of one batch.

        "motion" [B, T, D] (the tokenizer's columns), "length" [B], "closed" bool [B] (whether the clip ends
        with the window), "conditions", "present" bool [B, D] (optional: all).
        """
        if group == "critic":
            return self._critic(batch, shared)
        return self._tokens(batch, shared)

    def sequences(self, batch: Batch) -> TokenSequence:
        """Tokens of a batch's motion, as the frozen tokenizer makes them."""
        tokenizer = self.tokenizer.module
        net = self.net.utt
        groups = (batch["length"] // GROUP_FRAMES).clamp(min=1)
        with torch.no_grad():
            codes = tokenizer.encode(batch["motion"], groups * GROUP_FRAMES, batch.get("present"))
        return interleave(codes, net.pattern, ends=net.num_codes, groups=groups, closed=batch["closed"])

    def _tokens(self, batch: Batch, shared: dict[str, Tensor]) -> dict[str, Tensor]:
        net = self.net.utt
        config = self.net.utt.config
        sequence = self.sequences(batch)
        tokens = sequence.tokens
        kinds = sequence.kinds
        known = None
        if "present" in batch:
            recorded = self.tokenizer.module.recorded(batch["present"])
            # A clip of which no stream says what was recorded teaches nothing, not even where it ends.
            known = known_tokens(recorded, sequence, net.ends) & recorded.any(1, keepdim=True)
        conditions = batch["conditions"]
        inputs = None
        z = None
        size = len(tokens)
        device = tokens.device
        # Validation drops no conditions and corrupts no tokens, so its cross-entropy compares.
        if self.training:
            drop = torch.rand(size, device=device) < config.condition_dropout
            conditions = drop_conditions(conditions, drop)
            if config.pkeep < 1:
                inputs = corrupt(tokens, kinds, net.ends, config.pkeep)
        encoded: Encoded = self.net.mate(conditions, size)
        if config.z_dim:
            z = torch.randn(size, config.z_dim, device=device)
        logits = net(tokens, kinds, encoded, z, inputs=inputs, known=known)
        ce = cross_entropy(logits, tokens, known)
        values = {"loss": ce, "ce": ce}
        for kind, name in enumerate(net.names):
            values[f"accuracy_{name}"] = accuracy(logits, tokens, kinds, kind, known)
        if self.discriminator is None or (self.training and not self.judged):
            return values
        # The critic judges motion decoded by the frozen tokenizer, so that gradients reach the logits.
        how = self.loss_config.adversarial
        fake, length = soft_motion(
            net,
            logits,
            tokens,
            kinds,
            tokenizer=self.tokenizer.module,
            temperature=how.gumbel_temperature,
            sample=how.sample and self.training,
            present=batch.get("present"),
        )
        shared |= {"motion": fake, "length": length, "glob": encoded.glob}
        values["adversarial"] = generator_loss(self.discriminator(fake, encoded.glob, length))
        values["loss"] = ce + self.pull * values["adversarial"]
        return values

    def _critic(self, batch: Batch, shared: dict[str, Tensor]) -> dict[str, Tensor]:
        critic = self.discriminator
        assert critic is not None
        fake = shared["motion"].detach()
        glob = shared["glob"].detach()
        length = shared["length"]
        real = batch["motion"][:, : fake.shape[1]]
        real = functional.pad(real, (0, 0, 0, fake.shape[1] - real.shape[1]))
        # At once: half as many kernels, and no weight is cast twice.
        scores = critic(torch.cat([real, fake]), glob.repeat(2, 1), length.repeat(2))
        return discriminator_loss(*map(Validity, scores.score.chunk(2), scores.mask.chunk(2)))
