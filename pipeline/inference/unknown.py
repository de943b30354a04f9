"""What is said before a motion is made of words that a model does not know."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from motionloom.pipeline.contract.stage import Finished
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.store.known_captions import Unknown
from motionloom.pipeline.store.text import TextSource


def unknown_captions(
    bundle: Bundle, captions: Sequence[str], face: Sequence[str] = (), face_model: str | None = None
) -> list[Unknown]:
    """Captions that are far from all that the model was trained on, and what it knows nearest to each.

    Empty for models without text, and for those whose run or export does not say what it knows.
    """
    found = _of(bundle, bundle.main, captions, face=False)
    faces = bundle.choose_face(face_model)
    return found + ([] if faces is None else _of(bundle, faces, face, face=True))


def _of(bundle: Bundle, stage: Finished, captions: Iterable[str], *, face: bool) -> list[Unknown]:
    text = bundle.of(stage).text
    said = [caption for caption in captions if caption.strip()]
    return text.unknown(said, face=face) if isinstance(text, TextSource) else []
