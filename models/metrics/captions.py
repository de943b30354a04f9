"""Similarity of sentences about a motion to captions by people: BLEU, ROUGE-L, CIDEr-D, BERTScore.

Each is defined as the evaluation code of COCO's captions computes it, which the papers on motion captions
use: every motion has one sentence to be judged and one or more references. Words are `words_of` a caption.

Legend: S tokens of a sentence, E width of a text encoder.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence

from torch import Tensor
from torch.nn import functional

ORDER = 4
"""Longest word sequences that BLEU and CIDEr-D count."""
_BETA = 1.2
"""Weight of recall relative to precision in ROUGE-L."""
_SIGMA = 6.0
"""Words by which a sentence may differ in length, in CIDEr-D."""
_WORD = re.compile(r"[^\W_]+(?:['’-][^\W_]+)*")

Words = Sequence[str]
Ngram = tuple[str, ...]


def words_of(caption: str) -> list[str]:
    """Its words in lower case, with inner hyphens and apostrophes; no punctuation."""
    return _WORD.findall(caption.lower())


def bleu(candidates: Sequence[Words], references: Sequence[Sequence[Words]]) -> list[float]:
    """BLEU-1 to BLEU-4 of all sentences together (Papineni et al. 2002), in [0, 1].

    The brevity penalty compares with the reference nearest in length, of two the shorter one.
    """
    length = nearest = 0
    hits = [0] * ORDER
    counts = [0] * ORDER
    for words, known in zip(candidates, references, strict=True):
        length += len(words)
        nearest += min((abs(len(one) - len(words)), len(one)) for one in known)[1]
        for n in range(1, ORDER + 1):
            most = Counter[Ngram]()
            for one in known:
                most |= _ngrams(one, n)
            hits[n - 1] += (_ngrams(words, n) & most).total()
            counts[n - 1] += max(len(words) - n + 1, 0)
    brevity = 1.0 if length >= nearest else math.exp(1 - nearest / length) if length else 0.0
    out = []
    product = 1.0
    for n in range(1, ORDER + 1):
        product *= hits[n - 1] / counts[n - 1] if counts[n - 1] else 0.0
        out.append(brevity * product ** (1 / n))
    return out


def rouge_l(words: Words, references: Sequence[Words]) -> float:
    """ROUGE-L of one sentence (Lin 2004): by the best precision and the best recall among its references."""
    shared = [_longest_common(words, one) for one in references]
    precision = max(shared) / len(words) if words else 0.0
    recall = max(
        (count / len(one) for count, one in zip(shared, references, strict=True) if one), default=0.0
    )
    if not precision or not recall:
        return 0.0
    return (1 + _BETA**2) * precision * recall / (recall + _BETA**2 * precision)


def cider_d(candidates: Sequence[Words], references: Sequence[Sequence[Words]]) -> list[float]:
    """CIDEr-D of each sentence (Vedantam et al. 2015), in [0, 10].

    How rare a sequence of words is, is counted in the references of all motions, so one motion alone has 0.
    """
    uses = Counter[Ngram]()
    for known in references:
        uses.update({ngram for one in known for n in range(1, ORDER + 1) for ngram in _ngrams(one, n)})
    motions = math.log(max(len(references), 1))

    def rarity(ngram: Ngram) -> float:
        return motions - math.log(max(uses[ngram], 1))

    def vectors(words: Words) -> list[dict[Ngram, float]]:
        counted = (_ngrams(words, n) for n in range(1, ORDER + 1))
        return [{ngram: count * rarity(ngram) for ngram, count in one.items()} for one in counted]

    out = []
    for words, known in zip(candidates, references, strict=True):
        own = vectors(words)
        total = 0.0
        for one in known:
            # Lengths are counted in pairs of words, as COCO's code counts them.
            apart = max(len(words) - 1, 0) - max(len(one) - 1, 0)
            near = math.exp(-(apart**2) / (2 * _SIGMA**2))
            total += (
                sum(near * _clipped_cosine(*pair) for pair in zip(own, vectors(one), strict=True)) / ORDER
            )
        out.append(10 * total / len(known))
    return out


def bert_score(candidate: Tensor, reference: Tensor) -> tuple[float, float, float]:
    """Precision, recall and F1 of one sentence (Zhang et al. 2020), without weights and rescaling.

    The marks of begin and end are no words, but words may be nearest to them, as in the authors' code.

    Args:
        candidate: Token states [S, E] of the sentence, its two marks included.
        reference: Those of a reference [S', E].
    """
    if len(candidate) < 3 or len(reference) < 3:
        return 0.0, 0.0, 0.0
    cosines = functional.normalize(candidate.double(), dim=-1) @ (
        functional.normalize(reference.double(), dim=-1).t()
    )
    precision = float(cosines[1:-1].amax(1).mean())
    recall = float(cosines[:, 1:-1].amax(0).mean())
    total = precision + recall
    return precision, recall, 2 * precision * recall / total if total else 0.0


def _ngrams(words: Words, n: int) -> Counter[Ngram]:
    return Counter(tuple(words[k : k + n]) for k in range(len(words) - n + 1))


def _longest_common(one: Words, other: Words) -> int:
    """Length of the longest sequence of words that both have in this order."""
    row = [0] * (len(other) + 1)
    for word in one:
        before = 0
        for k, found in enumerate(other, start=1):
            before, row[k] = row[k], before + 1 if word == found else max(row[k], row[k - 1])
    return row[-1]


def _clipped_cosine(own: dict[Ngram, float], other: dict[Ngram, float]) -> float:
    """Cosine in which no sequence of the sentence counts more than in the reference."""
    norms = math.sqrt(sum(v * v for v in own.values()) * sum(v * v for v in other.values()))
    shared = sum(min(own[ngram], other[ngram]) * other[ngram] for ngram in own if ngram in other)
    return shared / norms if norms else 0.0
