"""Whether motions show what their captions say."""

from __future__ import annotations

from collections.abc import Iterable
from textwrap import shorten
from typing import TYPE_CHECKING

from motionloom.datasets.base.printable import printable
from motionloom.datasets.check.claims import lacking

if TYPE_CHECKING:
    from motionloom.pipeline.inference.motion import GeneratedMotion


def doubts_of(motions: Iterable[GeneratedMotion]) -> list[str]:
    """Captions whose action does not show in the joints of their motions, one sentence for each caption."""
    made: dict[str, list[str | None]] = {}
    for motion in motions:
        if motion.caption.strip() and not motion.segments and motion.seconds >= 1:
            made.setdefault(motion.caption, []).append(lacking(motion.caption, motion.joints, motion.fps))
    out = []
    for caption, actions in made.items():
        missing = [action for action in actions if action]
        if missing:
            share = f" in {len(missing)} of {len(actions)} motions" if len(actions) > 1 else ""
            said = shorten(printable(caption), 100, placeholder=" …")
            out.append(f"'{said}': its joints show no {missing[0]}{share}; try another seed or other words")
    return out
