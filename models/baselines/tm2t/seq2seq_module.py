"""Training of words to tokens: cross-entropy, and inverse alignment by a frozen captioner (TM2T section 3.4).

For inverse alignment the model draws a motion's tokens by itself, straight through Gumbel-softmax, and the
captioner must find the caption in them. Drawn are as many tokens as the recorded clip has [ours].
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from motionloom.models.baselines.tm2t.losses import Seq2SeqLossConfig, summed_or_mean, word_errors
from motionloom.models.baselines.tm2t.network import Captioner
from motionloom.models.baselines.tm2t.seq2seq import Seq2Seq
from motionloom.models.baselines.tm2t.vocabulary import PAD
from motionloom.models.gpt.frozen import Frozen
from motionloom.models.gpt.losses import accuracy, cross_entropy, predicted
from motionloom.models.training.stage_module import Batch, OptimConfig, StageModule


class Seq2SeqModule(StageModule):
    """Trains a `Seq2Seq`; the captioner is only looked through."""

    net: Seq2Seq

    def __init__(
        self,
        net: Seq2Seq,
        optim: OptimConfig,
        *,
        seed: int,
        max_steps: int,
        loss: Seq2SeqLossConfig,
        captioner: Captioner | None = None,
    ) -> None:
        super().__init__(net, optim, seed=seed, max_steps=max_steps)
        self.loss_config = loss
        self.captioner = None if captioner is None else Frozen(captioner)

    @property
    def forced(self) -> float:
        """Share of the clips whose true tokens are read in this step."""
        first, last = self.loss_config.forced
        return first + (last - first) * min(1.0, self.step / max(1, self.max_steps - 1))

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Loss of {"tokens" int64 [B, L] padded with -1, "kinds" int64 [B, L], "words" float [B, S, E],
        "mask" bool [B, S], "known" bool [B, L] (optional: all)}, and of "said" int64 [B, W], the caption as
        the captioner's vocabulary has it, for inverse alignment.
        """
        net, tokens, kinds, known = self.net, batch["tokens"], batch["kinds"], batch.get("known")
        rows = torch.rand(len(tokens), device=tokens.device) < (self.forced if self.training else 1.0)

        def read(at: int, logits: Tensor) -> Tensor:
            token = torch.where(rows, tokens[:, at].clamp(min=0), logits.argmax(-1))
            x = net.embed_at(token, kinds[:, at])
            return x if known is None else torch.where(known[:, at, None], x, 0.0)

        logits = net.roll(batch["words"], batch["mask"], kinds, net.legal(tokens, kinds), read)
        ce = cross_entropy(logits, tokens, known)
        each = functional.cross_entropy(
            logits.flatten(0, 1), tokens.flatten(), ignore_index=-1, reduction="none"
        ).view_as(tokens)
        counted = predicted(tokens, logits, known)
        values = {"loss": summed_or_mean(each, counted, summed=self.loss_config.summed), "ce": ce}
        for kind, name in enumerate(net.names):
            values[f"accuracy_{name}"] = accuracy(logits, tokens, kinds, kind, known)
        if self.captioner is not None:
            errors, said = self._inverse(batch, self.captioner.module), batch["said"]
            inverse = summed_or_mean(errors, said != PAD, summed=self.loss_config.summed)
            values["inverse"] = inverse
            values["loss"] = values["loss"] + self.loss_config.inverse_weight * inverse
        return values

    def _inverse(self, batch: Batch, captioner: Captioner) -> Tensor:
        """The captioner's errors [B, W] at the words, of tokens that the model draws by itself."""
        net, tokens, kinds, known = self.net, batch["tokens"], batch["kinds"], batch.get("known")
        # End where the clip ends; before it, any code.
        legal, drawn = net.legal(tokens, kinds), list[Tensor]()
        end = tokens == net.ends[kinds]
        code = torch.arange(net.vocabulary, device=tokens.device) < net.ends[kinds][..., None]
        legal = torch.where(end[..., None], legal & ~code, legal & code)
        legal[..., 0] |= tokens < 0

        def read(at: int, logits: Tensor) -> Tensor:
            weights = self._weights(logits)
            drawn.append(weights)
            return _soft(net, weights, kinds[:, at])

        logits = net.roll(batch["words"], batch["mask"], kinds, legal, read)
        drawn.append(self._weights(logits[:, -1]))
        embedded = torch.stack(
            [_soft(captioner, weights, kinds[:, at]) for at, weights in enumerate(drawn)], dim=1
        )
        if known is not None:
            embedded = embedded.masked_fill(~known[..., None], 0.0)
        words: Tensor = batch["said"]
        return word_errors(captioner.write(embedded, tokens >= 0, words), words)

    def _weights(self, logits: Tensor) -> Tensor:
        """One-hot weights [B, V], differentiable straight through: drawn, or the likeliest in validation."""
        if self.training:
            return functional.gumbel_softmax(logits, tau=self.loss_config.gumbel_temperature, hard=True)
        return functional.one_hot(logits.argmax(-1), logits.shape[-1]).to(logits)


def _soft(net: Seq2Seq | Captioner, weights: Tensor, kinds: Tensor) -> Tensor:
    """Embeddings [B, D] of weights [B, V] over the tokens of each row's stream."""
    tables = [table.weight for table in net.embeddings]
    made = [weights[:, : len(table)].to(table) @ table for table in tables if isinstance(table, Tensor)]
    out = made[0]
    for kind, vectors in enumerate(made[1:], start=1):
        out = torch.where((kinds == kind)[:, None], vectors, out)
    return out
