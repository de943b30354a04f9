"""Captions of motions, measured: against people's captions, by TMA, and on the joints.

Reference rows need no captioner: the caption of the training clip whose TMA latent is nearest, which is a
hard rival, the most frequent training caption, and another caption of the clip itself, judged by the rest.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from motionloom.datasets.actions.measure import find_mismatch
from motionloom.datasets.actions.requests import read_caption
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.models.metrics.captions import bert_score, bleu, cider_d, rouge_l, words_of
from motionloom.models.metrics.retrieval import r_precision
from motionloom.pipeline.evaluation.estimate import row_estimates, weighted
from motionloom.pipeline.evaluation.figures import (
    COMMON_CAPTION,
    NEAREST,
    Better,
    Estimate,
    Figure,
    Metric,
    Protocol,
    group_figures,
)
from motionloom.pipeline.evaluation.judges import Judge
from motionloom.pipeline.evaluation.latent_metrics import unit_length
from motionloom.pipeline.evaluation.truth import Truth, has_caption, truth_of
from motionloom.pipeline.store.networks import LoadedTma, TokensOfCaptions

_TOP = 3
_AT_ONCE = 256

_WORDS: tuple[tuple[str, str, Better], ...] = (
    *((f"bleu-{n}", f"BLEU-{n}", "higher") for n in range(1, 5)),  # type: ignore[misc]
    ("rouge-l", "ROUGE-L", "higher"),
    ("cider-d", "CIDEr-D", "higher"),
    ("bert", "BERTScore F1", "higher"),
)
METRICS = (
    *(Metric(f"captions.{name}", title, better) for name, title, better in _WORDS),
    *(Metric(f"captions.R-precision-{k}", f"R-precision {k}", "higher") for k in range(1, _TOP + 1)),
    Metric("captions.claims_hold", "claims that hold", "higher", "share"),
    Metric("captions.claims_decided", "captions with a claim", "", "share"),
)


@dataclass(frozen=True)
class CaptionedClips:
    """The clips of an evaluation, n of them."""

    truths: Sequence[Truth]
    references: Sequence[Sequence[str]]
    """Captions of each clip by people."""
    fps: float
    text: TokensOfCaptions
    """Its token states are BERTScore's."""
    tma: LoadedTma | None
    size: int
    """Motions among which TMA finds a caption's own."""
    seed: int

    def measured(
        self, captions: Sequence[str], references: Sequence[Sequence[str]] | None = None
    ) -> dict[str, Estimate]:
        """Return the figures of one caption for each clip, against the clips' own or `references`."""
        known = self.references if references is None else references
        states = _states(self.text, [*captions, *(text for own in known for text in own)])
        candidates = [words_of(caption) for caption in captions]
        by = [[words_of(one) for one in own] for own in known]
        consensus = cider_d(candidates, by)
        rows = []
        for row, truth in enumerate(self.truths):
            found = {
                "captions.rouge-l": rouge_l(candidates[row], by[row]),
                "captions.cider-d": consensus[row],
                "captions.bert": max(bert_score(states[captions[row]], states[one])[2] for one in known[row]),
            }
            if truth.truth is not None:
                # Rules on joints know the actions of clips that state their truth, and no others.
                claims = read_caption(captions[row]).candidates
                holds = bool(claims) and find_mismatch(claims, truth.joints, self.fps) is None
                found["captions.claims_decided"] = float(bool(claims))
                found |= weighted("captions.claims_hold", float(holds), float(bool(claims)))
            rows.append(found)
        out = row_estimates([rows])
        out |= {
            f"captions.bleu-{n}": Estimate(value) for n, value in enumerate(bleu(candidates, by), start=1)
        }
        if self.tma is not None:
            latents = self.tma.embed_captions(list(captions), self.tma.given["text"])
            found_by = r_precision(
                unit_length(latents), self.motions, batch=self.size, top=_TOP, seed=self.seed
            )
            top = found_by.tolist()
            out |= {f"captions.R-precision-{k}": Estimate(value) for k, value in enumerate(top, start=1)}
        return out

    @cached_property
    def motions(self) -> Tensor:
        """TMA's unit-length latents of the clips [n, Z]."""
        assert self.tma is not None
        return unit_length(Judge(self.tma).recorded(self.truths))


def caption_figures(rows: Mapping[str, Mapping[str, Estimate]], protocol: Protocol) -> list[Figure]:
    """Return one table of the estimates of each row."""
    title = "Captions of the clips: words shared with people's, found again by TMA, checked on the joints"
    return group_figures(title, METRICS, rows, protocol)


def _states(text: TokensOfCaptions, captions: Iterable[str]) -> dict[str, Tensor]:
    """Token states [S, E] of each caption."""
    words = sorted(set(captions))
    out = dict[str, Tensor]()
    for start in range(0, len(words), _AT_ONCE):
        some = words[start : start + _AT_ONCE]
        tokens, mask = text.tokens(some)
        out |= {one: torch.from_numpy(tokens[row][mask[row]]) for row, one in enumerate(some)}
    return out


def trivial_captions(train: ClipDataset, clips: CaptionedClips) -> dict[str, list[str]]:
    """Return for each reference row a caption of the training set for each clip."""
    usable = np.flatnonzero(has_caption(train)).tolist()
    truths = [truth_of(train, clip) for clip in usable]
    counts = Counter(caption.text for clip in usable for caption in train.texts(clip))
    common = min(counts, key=lambda text: (-counts[text], text))
    out = {COMMON_CAPTION: [common] * len(clips.truths)}
    if clips.tma is not None:
        trained = unit_length(Judge(clips.tma).recorded(truths))
        near = (clips.motions @ trained.t()).argmax(1).tolist()
        out[NEAREST] = [truths[clip].caption for clip in near]
    return out
