"""The Lightning side of the GPTs: cross-entropy and the optional text-motion alignment (HumanTOMATO section
3.6).
"""

from __future__ import annotations

import torch
from torch import Tensor

from motionloom.datasets.base.errors import UserError
from motionloom.models.gpt.losses import GptLossConfig, accuracy, corrupt, cross_entropy, soft_motion
from motionloom.models.gpt.network import InterleavedGPT
from motionloom.models.gpt.samples import log_likelihood, policy_loss, rewards, sample
from motionloom.models.layers.frozen import Frozen
from motionloom.models.tma.losses import info_nce
from motionloom.models.tma.network import Tma
from motionloom.models.tokenizer.base import Tokenizer
from motionloom.models.training.stage_module import Batch, OptimConfig, StageModule


class GptModule(StageModule):
    """Trains an `InterleavedGPT`; the tokenizer and TMA are only looked through, never trained or saved."""

    net: InterleavedGPT
    shardable = True

    def __init__(
        self,
        net: InterleavedGPT,
        optim: OptimConfig,
        *,
        seed: int,
        max_steps: int,
        loss: GptLossConfig | None = None,
        tokenizer: Tokenizer | None = None,
        tma: Tma | None = None,
    ) -> None:
        super().__init__(net, optim, seed=seed, max_steps=max_steps)
        self.loss_config = loss or GptLossConfig()
        self.tokenizer: Frozen[Tokenizer] | None = None
        self.tma: Frozen[Tma] | None = None
        if not self.loss_config.align_weight:
            return
        if tokenizer is None or tma is None:
            raise UserError(
                "align_weight > 0 needs a trained tokenizer and a trained TMA; set align_weight: 0"
            )
        _check(net, tokenizer, tma)
        self.tokenizer = Frozen(tokenizer)
        self.tma = Frozen(tma)
        self.compilable = self.loss_config.align_on != "samples"

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Loss of one batch.

        "tokens" int64 [B, L] padded with -1, "kinds" int64 [B, L], "text" float32 [B, E] (the prior); for
        L_align also "similarity" [B, S] (sBERT embeddings, for the filter; optional) and "tma_text" [B, Z],
        TMA's text means, where the prior is not TMA's. Of clips that lack a part: "known" bool [B, L], false
        at that part's codes, which are neither read nor predicted, and "present" bool [B, C], the tokenizer's
        columns that they hold (both optional: all).
        """
        net = self.net
        config = self.net.config
        tokens = batch["tokens"]
        kinds = batch["kinds"]
        text = batch["text"]
        known = batch.get("known")
        inputs = None
        drop = None
        if self.training:
            drop = torch.rand(len(text), device=text.device) < config.condition_dropout
            if config.pkeep < 1:
                inputs = corrupt(tokens, kinds, net.ends, config.pkeep)
        logits = net(tokens, kinds, text, inputs=inputs, drop_text=drop, known=known)
        ce = cross_entropy(logits, tokens, known, per_clip=self.loss_config.per_clip)
        values = {"loss": ce, "ce": ce}
        for kind, name in enumerate(net.names):
            values[f"accuracy_{name}"] = accuracy(logits, tokens, kinds, kind, known)
        begun = not self.loss_config.align_from or self.step >= self.loss_config.align_from
        if begun and self.tokenizer is not None and self.tma is not None:
            values["align"] = self._align(batch, logits, drop, self.tokenizer.module, self.tma.module)
            values["loss"] = ce + self.loss_config.align_weight * values["align"]
        return values

    def _align(
        self, batch: Batch, logits: Tensor, drop: Tensor | None, tokenizer: Tokenizer, tma: Tma
    ) -> Tensor:
        config = self.loss_config
        latent: Tensor = batch["tma_text"] if "tma_text" in batch else batch["text"]
        if latent.shape[-1] != tma.config.latent:
            raise UserError(
                f"L_align compares TMA latents of width {tma.config.latent} and the text prior has "
                f"{latent.shape[-1]}; give TMA's text means as 'tma_text' or set align_weight: 0"
            )
        if config.align_on == "samples":
            return self._align_samples(batch, latent, tokenizer, tma)
        if drop is not None:
            # A motion predicted without its text cannot follow it: to the others it is a negative, no more.
            logits = torch.where(drop[:, None, None], logits.detach(), logits)
        # What a clip does not hold is not decoded, and TMA reads the mean there, as in its own training.
        motion, frames = soft_motion(
            self.net,
            logits,
            batch["tokens"],
            batch["kinds"],
            tokenizer=tokenizer,
            temperature=config.gumbel_temperature,
            sample=self.training,
            present=batch.get("present"),
        )
        made, _ = tma.encode_motion(motion, frames, batch.get("present"))
        return info_nce(
            latent, made, batch.get("similarity"), temperature=config.temperature, threshold=config.threshold
        )

    def _align_samples(self, batch: Batch, latent: Tensor, tokenizer: Tokenizer, tma: Tma) -> Tensor:
        config = self.loss_config
        known = batch.get("known")
        count = config.samples if self.training else 1
        drawn = sample(self.net, batch["text"], count)
        reward = rewards(
            drawn.codes,
            latent,
            batch.get("similarity"),
            tokenizer=tokenizer,
            tma=tma,
            temperature=config.temperature,
            threshold=config.threshold,
            present=batch.get("present"),
        )
        if not self.training:
            return -reward.mean()
        lacking = None
        if known is not None:
            streams = range(len(self.net.names))
            lacking = torch.stack([(~known & (batch["kinds"] == k)).any(1) for k in streams], dim=1)
        return policy_loss(reward, *log_likelihood(self.net, drawn, lacking), count)


def _check(net: InterleavedGPT, tokenizer: Tokenizer, tma: Tma) -> None:
    """Hand-over between the stages: same vocabulary, same columns."""
    streams = {stream.name: stream.num_codes for stream in tokenizer.streams}
    if streams != net.num_codes or tuple(tokenizer.pattern) != net.pattern:
        raise UserError(
            f"the GPT's streams {net.num_codes} {net.pattern} are not the tokenizer's {streams} "
            f"{tuple(tokenizer.pattern)}"
        )
    if tokenizer.dim != tma.motion_dim:
        raise UserError(
            f"L_align feeds the tokenizer's {tokenizer.dim} columns to a TMA of {tma.motion_dim}; "
            "train TMA on the same columns or set align_weight: 0"
        )
