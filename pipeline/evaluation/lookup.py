"""The training motion of the nearest caption: what an answer gets that looks up what it was trained on.

A text-to-motion model has learnt more than its training clips only where it does better than these rows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from motionloom.datasets.loading.crops import caption_spans
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.datasets.text.encoder import load_text_encoder
from motionloom.pipeline.evaluation.figures import NEAREST_LABELS, NEAREST_WORDS
from motionloom.pipeline.evaluation.truth import Truth, has_caption, truth_in, truth_of

_ENCODER, _AT_ONCE = "minilm", 256
_MIN_FRAMES = 16
"""Of a stretch that a caption is about, as `truth_of` has it."""


def by_words(train: ClipDataset, truths: Sequence[Truth]) -> list[Truth]:
    """For each clip the training motion of the caption whose sentence embedding (MiniLM) is nearest, by
    cosine; of equal captions the first. None without captions.
    """
    spans = [
        (index, span)
        for index in np.flatnonzero(has_caption(train)).tolist()
        for span in caption_spans(train.texts(index), train.layout.fps, int(train.frames[index]), _MIN_FRAMES)
    ]
    first = {span.text: number for number, (_, span) in reversed(list(enumerate(spans)))}
    if not first:
        return []
    numbers = list(first.values())
    nearest = nearest_texts(list(first), [t.caption for t in truths])
    return [truth_in(train, *spans[numbers[index]]) for index in nearest]


def nearest_texts(known: Sequence[str], wanted: Sequence[str]) -> list[int]:
    """For each wanted text the number of the known one with the nearest sentence embedding, by cosine."""
    words = sorted({*known, *wanted})
    encoder = load_text_encoder(_ENCODER)
    parts = [encoder.encode(words[at : at + _AT_ONCE]).sentence for at in range(0, len(words), _AT_ONCE)]
    sentence = dict(zip(words, np.concatenate(parts), strict=True))
    rows = np.stack([sentence[text] for text in known])
    return [int((rows @ sentence[text]).argmax()) for text in wanted]


def by_labels(train: ClipDataset, truths: Sequence[Truth]) -> list[Truth]:
    """For each clip the captioned training clip that agrees with its truth in most attributes, the first of
    several; none unless all clips know what they do.
    """
    usable = np.flatnonzero(has_caption(train)).tolist()
    records = [train.meta(index).truth for index in usable]
    if not usable or not all(records) or not all(t.truth for t in truths):
        return []
    nearest = most_alike([record or {} for record in records], [t.truth or {} for t in truths])
    return [truth_of(train, usable[index]) for index in nearest]


def most_alike(known: Sequence[Mapping[str, object]], wanted: Sequence[Mapping[str, object]]) -> list[int]:
    """For each wanted truth the number of the first known one that agrees in most of its attributes."""
    names = sorted({name for one in wanted for name in one})
    columns = {name: np.array([str(record.get(name)) for record in known]) for name in names}
    out = []
    for one in wanted:
        given = [(name, str(value)) for name, value in one.items() if value is not None]
        out.append(int(np.sum([columns[name] == value for name, value in given], axis=0).argmax()))
    return out


LOOKUPS = {NEAREST_WORDS: by_words, NEAREST_LABELS: by_labels}
"""Row -> how its motions are found; nothing where it cannot."""
