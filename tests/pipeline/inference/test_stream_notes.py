"""What a stream's joints do not show of its captions is said while it runs."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.contract.generation import Prompt
from motionloom.pipeline.inference.motion import MotionChunk
from motionloom.pipeline.inference.notes import LOOKED_AT, doubted

LAYOUT = MotionLayout.named("wholebody363", fps=20.0)
REST = Skeleton.named("smplx52").rest_joints


def standing(*said: tuple[str, float]) -> Iterator[MotionChunk]:
    """Chunks of half a second in which nobody moves, whatever is said for so many seconds."""
    start = itertools.count(step=10)
    for text, seconds in said:
        prompt = Prompt(text)
        for _ in range(round(2 * seconds)):
            joints = np.repeat(REST[None], 10, axis=0)
            joints[..., 1] -= joints[..., 1].min()
            features = np.zeros((10, LAYOUT.dim), np.float32)
            yield MotionChunk(next(start), prompt, features, joints, None, LAYOUT)


def test_each_caption_is_looked_at_when_it_ends_or_after_a_while() -> None:
    notes: list[str] = []
    heard: list[tuple[str, int]] = []
    said = (("a person jumps", 3.0), ("a person stands", 2.0), ("a person claps twice", 20.0))
    for chunk in doubted(standing(*said), lambda note: notes.append(str(note))):
        heard.append((chunk.caption, len(notes)))
    assert [note.partition(":")[0] for note in notes] == ["'a person jumps'", "'a person claps twice'"]
    assert "no jump" in notes[0]
    assert [count for caption, count in heard if caption == "a person stands"] == [1] * 4
    claps = [count for caption, count in heard if caption == "a person claps twice"]
    assert claps == [1] * (round(2 * LOOKED_AT) - 1) + [2] * (len(claps) - round(2 * LOOKED_AT) + 1)


def test_the_chunks_are_what_came() -> None:
    chunks = list(standing(("a person jumps", 1.0)))
    assert list(doubted(iter(chunks), lambda _: None)) == chunks[:2] and len(chunks) == 2
