"""What there is to note of a motion: words that its model does not know, joints that show other things."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial

from motionloom.datasets.check.claims import Captioned, Understood, by_words, doubts_of
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.store.known_captions import Unknown
from motionloom.pipeline.store.text import TextSource


def unknown_captions(
    bundle: Bundle, captions: Sequence[str], face: Sequence[str] = (), face_model: str | None = None
) -> list[Unknown]:
    """Captions that are far from all that the model was trained on, and what it knows nearest to each.

    Empty for models without text, and for those whose run or export does not say what it knows.
    """
    out: list[Unknown] = []
    for stage, given in ((bundle.main, captions), (bundle.choose_face(face_model), face)):
        part = None if stage is None else bundle.of(stage)
        source = None if part is None else part.prepared.get("text")
        if isinstance(source, TextSource):
            said, read = [caption for caption in given if caption.strip()], getattr(part, "read", None)
            out += source.unknown(said, face=given is face, read=read)
    return out


def understood(bundle: Bundle, caption: str) -> Understood:
    """How a model reads a caption, and what it may ask for by the captions of the training nearest to it."""
    source = bundle.generator.prepared.get("text")
    if not isinstance(source, TextSource):
        return by_words(caption)
    return source.understood(caption, getattr(bundle.generator, "read", None))


def doubts(bundle: Bundle, motions: Iterable[Captioned]) -> list[str]:
    """Captions of which the joints of their motions show something else, one sentence for each."""
    return doubts_of(motions, partial(understood, bundle))
