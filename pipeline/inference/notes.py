"""What there is to note of a motion whose joints show something else than its caption asks for."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import TYPE_CHECKING

from motionloom.datasets.check.claims import doubts_of
from motionloom.datasets.text.words import Understood, by_words
from motionloom.pipeline.inference.motion import GeneratedMotion, MotionChunk, joined
from motionloom.pipeline.store.text import TextSource

if TYPE_CHECKING:
    from motionloom.pipeline.inference.bundle import Bundle
    from motionloom.pipeline.store.known_captions import Unknown


def understood(bundle: Bundle, caption: str) -> Understood:
    """How a model reads a caption, and what it may ask for by the captions of the training nearest to it."""
    source = bundle.generator.prepared.get("text")
    if not isinstance(source, TextSource):
        return by_words(caption)
    return source.understood(caption, getattr(bundle.generator, "read", None))


def doubts(bundle: Bundle, motions: Iterable[GeneratedMotion]) -> list[str]:
    """Captions of which the joints of their motions show something else, one sentence for each."""
    return doubts_of(motions, partial(understood, bundle))


LOOKED_AT = 6.0
"""Seconds of a caption after which what the joints show of it is looked at: a few of its rounds."""


def doubted(
    chunks: Iterable[MotionChunk],
    notice: Callable[[Unknown | str], object],
    understand: Callable[[str], Understood] = by_words,
) -> Iterator[MotionChunk]:
    """The chunks; `notice` is given what the joints do not show of a caption, when it ends or after its first
    seconds. What comes after those is not looked at.
    """
    shown: list[MotionChunk] = []

    def look() -> None:
        for doubt in doubts_of([joined(shown)] if shown else [], understand):
            notice(doubt)
        shown.clear()

    last, looked = None, False
    for chunk in chunks:
        if chunk.prompt is not last:
            look()
            last, looked = chunk.prompt, False
        if not looked:
            shown.append(chunk)
            if sum(len(one.joints) for one in shown) >= LOOKED_AT * chunk.fps:
                look()
                looked = True
        yield chunk
    look()
