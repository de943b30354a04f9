"""Captions that contradict their motion, by rules: left and right, forward and backward, how often.

Only captions about one action of a short list are judged, and only what `datasets/synth/measure.py` can read
from joints. Side and direction count where the motion does the opposite; how often, and one hand for both,
only where the motion is recognised as the very action, since people do things in more ways than rules know.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.check.faults import Fault
from motionloom.datasets.loading.crops import caption_spans
from motionloom.datasets.schema import Caption
from motionloom.datasets.synth.actions.truth import Record
from motionloom.datasets.synth.measure import described, measure

_ACTIONS = {
    "turn": r"turn(s|ing)?",
    "walk": r"walk(s|ing)?",
    "run": r"(run|jog|dash)(s|es|ning|ging|ing)?",
    "wave": r"wav(e|es|ing)",
    "raise": r"(rais|lift)(e|es|s|ing)?",
    "kick": r"kick(s|ing)?",
    "punch": r"punch(es|ing)?",
    "hop": r"hop(s|ping)?",
    "jump": r"(jump|leap)(s|ing)?",
    "squat": r"squat(s|ting)?",
    "clap": r"clap(s|ping)?",
}
_OTHERS = r"then|while|after|before|danc\w+|sit\w*|bow\w*|reach\w*|point\w*|crawl\w*|lie|lies|step\w*|not"
"""Words of captions that are about more than these rules know."""
_OPPOSITE = {"left": "right", "right": "left", "forward": "backward", "backward": "forward"}
_TIMES = {"once": 1, "one time": 1, "twice": 2, "two times": 2, "three times": 3, "thrice": 3}
_TIMES |= {"four times": 4, "five times": 5} | {f"{n} times": n for n in range(2, 6)}


def claim_of(text: str) -> Record | None:
    """What a caption says of one action: `action` and any of `side`, `direction`, `count`; None otherwise."""
    text = text.lower()

    def says(pattern: str) -> bool:
        return re.search(rf"\b({pattern})\b", text) is not None

    found = [name for name, pattern in _ACTIONS.items() if says(pattern)]
    if found == ["turn", "walk"]:
        found = ["turn"]
    if len(found) != 1 or says(_OTHERS):
        return None
    action = found[0]
    out: Record = {"action": action}
    sides = [side for side in ("left", "right", "both") if says(side)]
    ways = [way for way in ("forward", "backward") if says(f"{way}s?")]
    if len(sides) == 1 and action in ("wave", "raise", "kick", "punch", "hop"):
        out["side"] = sides[0]
    if action == "turn" and len(sides) == 1 and sides != ["both"]:
        out["direction"] = sides[0]
    if action in ("walk", "run") and len(ways) == 1 and not sides and not says(r"circles?|back"):
        out["direction"] = ways[0]
    counts = {times for words, times in _TIMES.items() if says(words)}
    if len(counts) == 1 and action in ("kick", "punch", "hop", "jump", "squat", "clap"):
        out["count"] = counts.pop()
    return out if len(out) > 1 else None


def caption_faults(captions: Sequence[Caption], joints: NDArray[np.floating], fps: float) -> Iterator[Fault]:
    """The captions that joints [T, N >= 22, 3] contradict; of several that say the same the first."""
    said: list[Record] = []
    for span in caption_spans(captions, fps, len(joints), min_frames=4):
        claim = claim_of(span.text)
        if claim is None or claim in said or span.frames < 4:
            continue
        said.append(claim)
        part = joints[span.first : span.end]
        does = described(part, fps, str(claim["action"]))
        recognised = measure(part, fps).action == claim["action"]
        for name in ("side", "direction", "count"):
            want, got = claim.get(name), does.get(name)
            opposite = got is not None and got == _OPPOSITE.get(str(want))
            if want is not None and want != got and (opposite or (recognised and got is not None)):
                text = f"'{span.text}': the {name} is {got}, not {want}"
                yield Fault("caption disagrees", text, 2.0 if opposite else 1.0, span.first)
                break
