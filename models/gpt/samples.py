"""The alignment loss on motions that the model samples itself [ours]; HumanTOMATO section 3.6.

The paper feeds "the generated motion" to TMA. What is predicted after the *true* tokens hardly differs from
the truth, for TMA too, so there is little for a loss to correct. Whole samples do differ, as errors add up
along them; but a draw has no gradient. So each caption is sampled several times, and a sample that TMA finds
nearer to its caption than the caption's other samples becomes likelier, one that it finds farther less likely
(REINFORCE with the mean of a caption's samples as its baseline).

Legend: B captions, N captions of all ranks, R = B * count samples, L tokens.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from motionloom.models.gpt.losses import predicted, token_errors
from motionloom.models.gpt.network import InterleavedGPT
from motionloom.models.gpt.sampling import generate
from motionloom.models.gpt.tokens import Codes, TokenSequence, interleave
from motionloom.models.layers.frozen import evaluating
from motionloom.models.tma.losses import false_negatives
from motionloom.models.tma.network import Tma
from motionloom.models.tokenizer.base import Tokenizer
from motionloom.models.training.distributed import gather_rows, masked_mean, rank


class Samples(NamedTuple):
    """Motions sampled for captions, those of one caption next to each other."""

    text: Tensor
    """float [R, E], the prior of each sample's caption."""
    codes: Codes
    sequence: TokenSequence
    """The same as tokens, closed."""


def sample(gpt: InterleavedGPT, text: Tensor, count: int) -> Samples:
    """`count` motions for each prior text [B, E], of lengths that the model decides, seeded by `draws`."""
    rows = text.repeat_interleave(count, dim=0)
    seeds = torch.randint(2**62, (len(rows),)).tolist()
    codes = generate(gpt, rows, seed=seeds)
    return Samples(rows, codes, interleave(codes.codes, gpt.pattern, ends=gpt.num_codes, groups=codes.groups))


@torch.no_grad()
def rewards(
    codes: Codes,
    text_latent: Tensor,
    sentence: Tensor | None,
    *,
    tokenizer: Tokenizer,
    tma: Tma,
    temperature: float,
    threshold: float | None,
    present: Tensor | None = None,
) -> Tensor:
    """Log-probability [R] that TMA gives a sample's own caption among the captions of all ranks: the motion's
    half of InfoNCE.

    text_latent [B, Z] TMA's text means, sentence [B, S] for the filter of negatives, present bool [B, dim]:
    columns that the captions' clips have.
    """
    count = len(codes.groups) // len(text_latent)
    frames = codes.groups * tokenizer.group_frames
    columns = None if present is None else present.repeat_interleave(count, dim=0)
    latent, _ = tma.encode_motion(tokenizer.decode(codes.codes, frames, columns), frames, columns)
    # A caption competes with those of all ranks, as in the training of TMA.
    captions = F.normalize(gather_rows(text_latent.float()), dim=-1)
    logits = F.normalize(latent.float(), dim=-1) @ captions.T / temperature
    own = rank() * len(text_latent) + torch.arange(len(text_latent), device=logits.device)
    if sentence is not None and threshold is not None:
        # Captions that mean the same are no wrong answers.
        same = false_negatives(gather_rows(sentence), threshold)[own]
        logits = logits.masked_fill(same.repeat_interleave(count, dim=0), -torch.inf)
    chosen = own.repeat_interleave(count)[:, None]
    return logits.log_softmax(-1).gather(1, chosen)[:, 0]


def log_likelihood(
    gpt: InterleavedGPT, samples: Samples, lacking: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Log-probabilities of the tokens [R, L] of samples, without dropout, and which of them were drawn, bool
    [R, L].

    lacking bool [B, streams]: streams that a caption's clip does not hold; nothing judges their codes.
    """
    tokens, kinds, _ = samples.sequence
    with evaluating(gpt):
        logits = gpt(tokens, kinds, samples.text)
    # A sample never is empty: End is no choice at its first token.
    empty = torch.zeros(logits.shape[1:], dtype=torch.bool, device=logits.device)
    empty[0, gpt.ends[gpt.slots[0]]] = True
    logits = logits.masked_fill(empty, -torch.inf)
    drawn = predicted(tokens, logits)
    # At the longest length End is no draw of the model's.
    drawn = drawn & (torch.arange(tokens.shape[1], device=tokens.device) < gpt.max_groups * len(gpt.pattern))
    if lacking is not None:
        rows = lacking.repeat_interleave(len(tokens) // len(lacking), dim=0)
        drawn = drawn & ~rows.gather(1, kinds)
    return -token_errors(logits, tokens), drawn


def policy_loss(reward: Tensor, likelihood: Tensor, drawn: Tensor, count: int) -> Tensor:
    """Minus the mean reward, with the gradient of a policy that earns it.

    reward [R], likelihood and drawn [R, L] of `count` samples a caption. The gradient is a mean over all
    ranks' tokens, as the cross-entropy is, so that their weights mean like things.
    """
    groups = reward.view(-1, count)
    advantage = (groups - groups.mean(1, keepdim=True)).flatten()
    objective = masked_mean(-advantage[:, None] * likelihood, drawn)
    return -reward.mean() + objective - objective.detach()
