"""Training of TM2T: its tokenizer against a critic, the captioner, and words to tokens.

The tokenizer's critic is trained as in its release (section 3.1):

    L = |motion - made| + penalty - weight E D(made), from `start` on
    L_D = (E max(0, 1 - D(motion)) + E max(0, 1 + D(made))) / 2

It is two strided convolutions with batch normalisation and one convolution to a score for every four frames.
Its means and variances are those of all ranks' rows, so that ranks equal one process.

The captioner is trained by the cross-entropy of its words (section 3.3); words to tokens by cross-entropy and
inverse alignment (section 3.4): the model draws a motion's tokens by itself, straight through Gumbel-softmax,
and the frozen captioner must find the caption in them. Drawn are as many tokens as the recorded clip has
[ours].

Legend: B batch, T frames, D motion features, C channels.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from motionloom.models.gpt.losses import (
    accuracy,
    cross_entropy,
    group_counts,
    predicted,
    straight_through,
    token_errors,
)
from motionloom.models.layers.frozen import Frozen
from motionloom.models.layers.strided import SLOPE
from motionloom.models.layers.transformer import length_mask
from motionloom.models.tokenizer.base import Tokenizer
from motionloom.models.tokenizer.module import tokenizer_losses
from motionloom.models.training.alternating import AlternatingModule, OptimizerGroup
from motionloom.models.training.distributed import masked_mean, sum_over_ranks, sum_over_ranks_with_grad
from motionloom.models.training.optim import OptimConfig
from motionloom.models.training.stage_module import Batch, StageModule
from motionloom.pipeline.baselines.tm2t.network import (
    PAD,
    Captioner,
    CaptionLossConfig,
    CriticConfig,
    Seq2SeqLossConfig,
    hidden_ends,
    word_errors,
)
from motionloom.pipeline.baselines.tm2t.seq2seq import Seq2Seq


def summed_or_mean(each: Tensor, counted: Tensor, module: StageModule, *, summed: bool) -> Tensor:
    """Errors `each` where `counted`, over the batches of all ranks: their mean, or the sum over the step's
    whole batch, as the mean of the parts that `module` reads it in.
    """
    mean = masked_mean(each, counted)
    if not summed:
        return mean
    return mean * sum_over_ranks(counted.sum().float()) * (module.accumulate if module.training else 1)


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
        net = self.net
        tokens = batch["tokens"]
        kinds = batch["kinds"]
        words = batch["text"]
        visible = tokens >= 0
        known = batch.get("known")
        if self.training and self.loss_config.hide:
            size = len(net.pattern)
            groups = group_counts(tokens, kinds, net.ends, size)
            visible = visible & ~hidden_ends(groups, tokens.shape[1], size, self.loss_config.hide)
        if self.training and self.loss_config.hide_hands and "hand" in net.names:
            handless = torch.rand(len(tokens), device=tokens.device) < self.loss_config.hide_hands
            read = (kinds != net.names.index("hand")) | ~handless[:, None]
            known = read if known is None else known & read
        logits = net(tokens, kinds, words, visible, known)
        each = word_errors(logits, words)
        counted = words != PAD
        right = (logits.argmax(-1) == words).float()
        ce = masked_mean(each, counted)
        return {
            "loss": summed_or_mean(each, counted, self, summed=self.loss_config.summed),
            "ce": ce,
            "accuracy": masked_mean(right, counted),
        }


class Seq2SeqModule(StageModule):
    """Trains a `Seq2Seq`; the captioner is only looked through."""

    net: Seq2Seq
    compilable = False

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
        net = self.net
        tokens = batch["tokens"]
        kinds = batch["kinds"]
        known = batch.get("known")
        rows = torch.rand(len(tokens), device=tokens.device) < (self.forced if self.training else 1.0)

        def read(at: int, logits: Tensor) -> Tensor:
            token = torch.where(rows, tokens[:, at].clamp(min=0), logits.argmax(-1))
            x = net.embed_at(token, kinds[:, at])
            return x if known is None else torch.where(known[:, at, None], x, 0.0)

        logits = net.roll(batch["words"], batch["mask"], kinds, net.legal(tokens, kinds), read)
        ce = cross_entropy(logits, tokens, known)
        each = token_errors(logits, tokens)
        counted = predicted(tokens, logits, known)
        # The release sums errors; the mean is logged either way, so that runs compare.
        values = {"loss": summed_or_mean(each, counted, self, summed=self.loss_config.summed), "ce": ce}
        for kind, name in enumerate(net.names):
            values[f"accuracy_{name}"] = accuracy(logits, tokens, kinds, kind, known)
        if self.captioner is not None:
            errors = self._inverse(batch, self.captioner.module)
            said = batch["said"]
            inverse = summed_or_mean(errors, said != PAD, self, summed=self.loss_config.summed)
            values["inverse"] = inverse
            values["loss"] = values["loss"] + self.loss_config.inverse_weight * inverse
        return values

    def _inverse(self, batch: Batch, captioner: Captioner) -> Tensor:
        """The captioner's errors [B, W] at the words, of tokens that the model draws by itself."""
        net = self.net
        tokens = batch["tokens"]
        kinds = batch["kinds"]
        known = batch.get("known")
        # End where the clip ends; before it, any code.
        legal = net.legal(tokens, kinds)
        drawn = list[Tensor]()
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
        return straight_through(logits, self.loss_config.gumbel_temperature, sample=self.training)


def _soft(net: Seq2Seq | Captioner, weights: Tensor, kinds: Tensor) -> Tensor:
    """Embeddings [B, D] of weights [B, V] over the tokens of each row's stream."""
    tables = [table.weight for table in net.embeddings]
    made = [weights[:, : len(table)].to(table) @ table for table in tables if isinstance(table, Tensor)]
    out = made[0]
    for kind, vectors in enumerate(made[1:], start=1):
        out = torch.where((kinds == kind)[:, None], vectors, out)
    return out


class RankNorm(nn.Module):
    """Batch normalisation of [B, C, T] over the rows of all ranks."""

    mean: Tensor
    var: Tensor

    def __init__(self, channels: int, momentum: float = 0.1) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.ones(channels))
        self.shift = nn.Parameter(torch.zeros(channels))
        self.momentum = momentum
        self.register_buffer("mean", torch.zeros(channels))
        self.register_buffer("var", torch.ones(channels))

    def forward(self, x: Tensor, there: Tensor) -> Tensor:
        """The same of x; padding, where `there` [B, 1, T] is 0, counts for nothing."""
        x = x.to(torch.promote_types(x.dtype, torch.float32))
        mean = self.mean.to(x)
        var = self.var.to(x)
        if self.training:
            count = sum_over_ranks(there.sum().to(x))
            mean = sum_over_ranks_with_grad((x * there).sum((0, 2))) / count
            var = sum_over_ranks_with_grad(((x - mean[:, None]).square() * there).sum((0, 2))) / count
            with torch.no_grad():
                self.mean.lerp_(mean.to(self.mean), self.momentum)
                self.var.lerp_((var * count / (count - 1)).to(self.var), self.momentum)
        scaled = (x - mean[:, None]) * (var[:, None] + 1e-5).rsqrt()
        return scaled * self.scale[:, None] + self.shift[:, None]


class Critic(nn.Module):
    """Scores [B, T / 4] of motion [B, T, D], T a multiple of 4, zero after `length` [B], and which of them
    are of frames, bool [B, T / 4]; higher is more real.
    """

    def __init__(self, motion_dim: int, width: int) -> None:
        super().__init__()
        widths = (motion_dim, width, width // 2)
        self.down = nn.ModuleList(nn.Conv1d(a, b, 4, stride=2, padding=1) for a, b in pairwise(widths))
        self.norms = nn.ModuleList(map(RankNorm, widths[1:]))
        self.out = nn.Conv1d(width // 2, 1, 3, padding=1)

    def forward(self, motion: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
        x = motion.transpose(1, 2)
        there = length_mask(length, motion.shape[1])[:, None]
        for down, norm in zip(self.down, self.norms, strict=True):
            there = there[..., ::2]
            # Behind a clip there are zeros again, as behind one that fills its window.
            x = functional.leaky_relu(norm(down(x), there), SLOPE) * there
        return self.out(x)[:, 0], there[:, 0]


class AdversarialTokenizerModule(AlternatingModule):
    """Trains TM2T's tokenizer, and the critic of what it makes. What a clip lacks is 0 in both."""

    net: Tokenizer

    def __init__(
        self, net: Tokenizer, optim: OptimConfig, *, seed: int, max_steps: int, critic: CriticConfig
    ) -> None:
        super().__init__(net, optim, seed=seed, max_steps=max_steps)
        self.critic_config = critic
        self.critic = Critic(net.dim, critic.width)
        self.judged = critic.start == 0
        """Whether the critic plays; no number, by which every step would be compiled anew."""

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor | None:
        self.judged = self.step >= self.critic_config.start
        return super().training_step(batch, batch_idx)

    def optimizer_groups(self) -> list[OptimizerGroup]:
        """The tokenizer, then the critic of what it has made."""
        start = self.critic_config.start
        return [
            OptimizerGroup("tokenizer", (self.net,), self.optim_config),
            OptimizerGroup("critic", (self.critic,), self.optim_config, start_step=start),
        ]

    def losses_of(self, group: str, batch: Batch, shared: dict[str, Tensor]) -> dict[str, Tensor]:
        """A group's loss of one batch, as `TokenizerModule` takes it."""
        if group == "critic":
            (real, there), (made, _) = (self.critic(shared[k], batch["length"]) for k in ("motion", "made"))
            terms = {"real": functional.relu(1 - real), "made": functional.relu(1 + made)}
            values = {name: masked_mean(each, there) for name, each in terms.items()}
            right = (real > 0).float() + (made < 0).float()
            values["accuracy"] = masked_mean(right / 2, there)
            return {"loss": (values["real"] + values["made"]) / 2, **values}
        values, out = tokenizer_losses(self.net, batch)
        there = length_mask(batch["length"], out.input.shape[1])[..., None]
        if "present" in batch:
            there = there & batch["present"][:, None]
        shared |= {"motion": out.input * there, "made": out.reconstruction * there}
        if self.training and not self.judged:
            return values
        values["adversarial"] = -masked_mean(*self.critic(shared["made"], batch["length"]))
        values["loss"] = values["loss"] + self.critic_config.weight * values["adversarial"]
        return values
