"""Training of the captioner: the cross-entropy of its words (TM2T section 3.3)."""

from __future__ import annotations

from torch import Tensor

from motionloom.models.baselines.tm2t.losses import (
    CaptionLossConfig,
    hidden_ends,
    summed_or_mean,
    word_errors,
)
from motionloom.models.baselines.tm2t.network import Captioner
from motionloom.models.baselines.tm2t.vocabulary import PAD
from motionloom.models.gpt.losses import group_counts
from motionloom.models.training.distributed import masked_mean
from motionloom.models.training.stage_module import Batch, OptimConfig, StageModule


class CaptionerModule(StageModule):
    """Trains a `Captioner`."""

    net: Captioner

    def __init__(
        self, net: Captioner, optim: OptimConfig, *, seed: int, max_steps: int, loss: CaptionLossConfig
    ) -> None:
        super().__init__(net, optim, seed=seed, max_steps=max_steps)
        self.loss_config = loss

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Loss of {"tokens" int64 [B, L] padded with -1, "kinds" int64 [B, L], "text" int64 [B, W], the words
        of `Vocabulary.encode`, "known" bool [B, L] (optional: all)}.
        """
        net, tokens, kinds, words = self.net, batch["tokens"], batch["kinds"], batch["text"]
        visible = tokens >= 0
        if self.training and self.loss_config.hide:
            size = len(net.pattern)
            groups = group_counts(tokens, kinds, net.ends, size)
            visible = visible & ~hidden_ends(groups, tokens.shape[1], size, self.loss_config.hide)
        logits = net(tokens, kinds, words, visible, batch.get("known"))
        each, counted = word_errors(logits, words), words != PAD
        right = (logits.argmax(-1) == words).float()
        ce = masked_mean(each, counted)
        return {
            "loss": summed_or_mean(each, counted, summed=self.loss_config.summed),
            "ce": ce,
            "accuracy": masked_mean(right, counted),
        }
