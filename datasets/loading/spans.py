"""Which frames of a clip a caption is about: the rule that every stage shares."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from motionloom.datasets.schema import Caption


class CaptionSpan(NamedTuple):
    """A caption and its stretch of a clip, in frames."""

    text: str
    first: int
    end: int
    """The frame behind the last."""
    tokens: tuple[str, ...] = ()
    """Its `word/POS` tags, where the source brings them."""

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.end - self.first


def frame_span(caption: Caption, fps: float, frames: int) -> tuple[int, int]:
    """(first frame, frame behind the last) of a caption's stretch in a clip of `frames`; all when empty."""
    first = min(max(round(caption.start * fps), 0), frames)
    end = frames if caption.end is None else min(max(round(caption.end * fps), 0), frames)
    return (first, end) if end > first else (0, frames)


def caption_spans(
    captions: Sequence[Caption], fps: float, frames: int, min_frames: int = 1
) -> list[CaptionSpan]:
    """The captions that cover `min_frames` or more of a clip of `frames`.

    When none does, the one that covers most: a clip with a caption always gives one.
    """
    spans = [
        CaptionSpan(caption.text, *frame_span(caption, fps, frames), tuple(caption.tokens or ()))
        for caption in captions
    ]
    long = [span for span in spans if span.frames >= min_frames]
    return long or ([max(spans, key=lambda span: span.frames)] if spans else [])
