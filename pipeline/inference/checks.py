"""Look at captions before a motion is made of them, and at the motion afterwards: is it what was asked for?

A caption is unknown where it is far from all of the training's (`store/known_captions.py`). Models whose
clips state their truth, which are those of the synthetic source, are also told what a caption asks for, so
that it can be looked for in the motion's joints.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from textwrap import shorten

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.actions.dances import longest_stand
from motionloom.datasets.actions.measure import actions_of, find_mismatch
from motionloom.datasets.actions.requests import CaptionRequest, read_caption, words_of_actions
from motionloom.datasets.base.printable import printable
from motionloom.pipeline.contract.generation import MotionGenerator
from motionloom.pipeline.inference.motion import GeneratedMotion
from motionloom.pipeline.store.known_captions import Unknown
from motionloom.pipeline.store.text import TextSource

STANDS = 6.0
"""Seconds on both feet from which a dance has a note."""


def unknown_captions(source: object, captions: Sequence[str], *, face: bool = False) -> list[Unknown]:
    """Return captions that are far from all that a model was trained on, with what it knows nearest.

    `source` is what its text stage gives; there are none where it has no text stage.
    """
    if not isinstance(source, TextSource):
        return []
    wanted = [caption for caption in captions if caption.strip()]
    if face or not source.actions:
        return source.unknown(wanted, face=face)
    return source.unknown(wanted, judge=partial(_is_known, source), suits=_suits)


def rounded_lengths(
    generator: MotionGenerator, asked: Sequence[float | None], motions: Sequence[GeneratedMotion]
) -> list[str]:
    """Return a sentence for each length in seconds that a motion's, in whole units, is not."""
    fps = generator.layout.fps
    unit = generator.unit_frames
    lengths = dict.fromkeys((wanted, one.seconds) for wanted, one in zip(asked, motions, strict=False))
    return [
        f"{wanted:g} s were asked for and {made:g} s are made: this model makes whole {unit / fps:.2g} s"
        for wanted, made in lengths
        if wanted is not None and abs(wanted - made) > 0.5 / fps
    ]


def standing(motions: Iterable[GeneratedMotion]) -> list[str]:
    """Return a sentence for each dance in which both feet stand still for long."""
    dances = (one for one in motions if one.prompt.sound and not one.prompt.idle and not one.segments)
    stands = [(one, longest_stand(one.joints, one.fps)) for one in dances if len(one.joints) >= one.fps]
    return [
        f"both feet stand still for {still:.0f} s of these {one.seconds:.0f} s: a dance on the spot; other "
        f"seeds or songs may step"
        for one, still in stands
        if still > STANDS
    ]


def find_mismatches(
    source: object, motions: Iterable[tuple[str, NDArray[np.float64]]], fps: float
) -> list[str]:
    """Return a sentence for each caption of which the joints [T, N, 3] of its motions show something else."""
    if not isinstance(source, TextSource) or not source.actions:
        return []
    found: dict[str, list[str | None]] = {}
    for caption, joints in motions:
        request = _request(source, caption)
        # Of less than a second nothing can be told.
        if request is not None and request.candidates and len(joints) >= fps:
            found.setdefault(caption, []).append(find_mismatch(request.candidates, joints, fps))
    out = []
    for caption, each in found.items():
        wrong = [one for one in each if one]
        if wrong:
            share = f" in {len(wrong)} of {len(each)} motions" if len(each) > 1 else ""
            shown = shorten(printable(caption), 100, placeholder=" …")
            out.append(f"'{shown}': by its joints {wrong[0]}{share}; try another seed or other words")
    return out


def _is_known(source: TextSource, caption: str) -> bool | None:
    """Whether a caption is known by the actions that it names; None where it names none of the training's."""
    request = _request(source, caption)
    return None if request is None else not request.refused


def _suits(caption: str, other: str) -> bool:
    """Whether a caption may be named beside another: not for an action that this one takes back."""
    return not set(read_caption(caption).without) & words_of_actions(other)


def _request(source: TextSource, caption: str) -> CaptionRequest | None:
    """Return what a caption asks for; None where it names no action of the training."""
    request = read_caption(caption)
    named = {action for candidate in request.candidates for action in actions_of(candidate)}
    return request if request.refused or (named and named <= set(source.actions)) else None
