"""A stream as JSON lines: one that says what follows, then one a frame; and what there is to note of it.

    {"format": "motionloom stream", "version": 1, "fps": 20.0, "joint_names": [...], "parents": [...], ...}
    {"frame": 0, "caption": "a person waves", "joints": [[x, y, z], ...], "face": [...]}

Metres, Y up, to a hundredth of a millimetre; `face` only where the model makes one.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.check.claims import Understood, by_words, doubts_of
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.pipeline.inference.stream import MotionChunk, joined
from motionloom.pipeline.store.known_captions import Unknown

DIGITS = 5


def heading(layout: MotionLayout, seed: int, model: str) -> str:
    """The first line."""
    facts = {
        "format": "motionloom stream",
        "version": 1,
        "model": model,
        "seed": seed,
        "fps": layout.fps,
        "skeleton": layout.skeleton_name,
        "joint_names": list(layout.skeleton.joints),
        "parents": [int(parent) for parent in layout.skeleton.parents],
        "unit": "m",
        "up": "y",
    }
    return json.dumps(facts) + "\n"


def frame_lines(chunk: MotionChunk) -> Iterator[str]:
    """A line for each frame."""
    for number, joints in enumerate(chunk.joints):
        frame: dict[str, object] = {
            "frame": chunk.start + number,
            "caption": chunk.caption,
            "joints": rounded(joints),
        }
        if chunk.face is not None:
            frame["face"] = rounded(chunk.face[number])
        yield json.dumps(frame, separators=(",", ":"), ensure_ascii=False) + "\n"


def rounded(values: NDArray[np.floating]) -> object:
    """Numbers as lists, short in writing."""
    return np.round(np.asarray(values, np.float64), DIGITS).tolist()


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
