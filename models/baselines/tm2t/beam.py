"""The likeliest sentences about a motion, by beam search."""

from __future__ import annotations

from typing import NamedTuple

import torch

from motionloom.models.baselines.tm2t.network import Captioner, Reading
from motionloom.models.baselines.tm2t.vocabulary import END, START


class Written(NamedTuple):
    """One sentence."""

    words: tuple[int, ...]
    """Their numbers, without End."""
    log_probability: float
    """Of the whole sentence and its end; natural logarithm."""


@torch.no_grad()
def likeliest(net: Captioner, reading: Reading, count: int, beam: int) -> list[list[Written]]:
    """Of each of B motions up to `count` sentences, likeliest first.

    Args:
        reading: Of the B motions, without a word yet.
        beam: Unfinished sentences that are kept, at least `count`; the wider, the surer that no likelier one
            is missed.
    """
    batch, beam = len(reading.mask), max(beam, count)
    device = reading.mask.device
    rows = torch.arange(batch, device=device)
    reading = reading.take(rows.repeat_interleave(beam))
    scores = torch.full((batch, beam), -torch.inf, device=device, dtype=torch.float64)
    scores[:, 0] = 0.0  # the beams of a motion begin as one
    last = torch.full((batch * beam,), START, device=device)
    said = torch.empty(batch, beam, 0, dtype=torch.int64, device=device)
    done: list[list[Written]] = [[] for _ in range(batch)]
    for step in range(net.config.max_words + 1):
        words = net.next(last, reading).double().view(batch, beam, -1)
        if step == 0:
            words[..., END] = -torch.inf  # a sentence is never empty
        if step == net.config.max_words:
            words[..., :END] = words[..., END + 1 :] = -torch.inf
        total = (scores[..., None] + words).flatten(1)
        best, at = total.topk(min(2 * beam, total.shape[1]), dim=1)
        origin, word = at // words.shape[-1], at % words.shape[-1]
        for row in range(batch):
            for score, one, ended in zip(
                best[row].tolist(), origin[row].tolist(), (word[row] == END).tolist(), strict=True
            ):
                if ended and score > -torch.inf:
                    done[row].append(Written(tuple(said[row, one].tolist()), score))
            done[row] = sorted(done[row], key=lambda found: -found.log_probability)[:count]
        # Of those that go on, the first `beam`; at most `beam` of the 2 * beam end here.
        going = torch.where(word == END, -torch.inf, best)
        scores, kept = going.topk(beam, dim=1)
        if all(_finished(found, count, float(left)) for found, left in zip(done, scores[:, 0], strict=True)):
            break
        origin, word = origin.gather(1, kept), word.gather(1, kept)
        said = torch.cat([said.gather(1, origin[..., None].expand(-1, -1, step)), word[..., None]], dim=2)
        reading = reading.take((rows[:, None] * beam + origin).flatten())
        last = word.flatten()
    return done


def _finished(found: list[Written], count: int, left: float) -> bool:
    """Whether no unfinished sentence can be among the best: words only make it less likely."""
    return len(found) == count and found[-1].log_probability >= left
