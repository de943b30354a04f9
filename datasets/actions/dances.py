"""Recognise style, genre and tempo of a dance on joints.

Style is what the legs do (feet that leave the floor, a root that goes down or aside); the two genres of a
style differ in where the hands are on average by 0.2 arm lengths or more, whatever the section of the song
and whether the arms go together.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.actions.signals import BALLS, signals_of, smooth, tempo

Record = dict[str, Any]
"""Truth of a clip as plain JSON (`ClipMeta.truth`)."""
Style = Literal["step", "bounce", "sway"]
STEP_LIFT = 0.03
"""Metres that the ball of a foot is lifted at least by someone who steps, for a seventh of the time."""
STILL = 0.2
"""Metres a second below which a foot stands: half of those who step never do for .5 s."""
_WRIST_HEIGHTS: dict[str, tuple[float, str, str]] = {
    # Mean height of the wrists over the shoulders, in arm lengths: limit, genre below, genre above.
    "step": (-0.1, "house", "disco"),
    "bounce": (-0.08, "hiphop", "rock"),
    "sway": (-0.35, "reggae", "ballad"),
}


class MeasuredDance(NamedTuple):
    """Style, genre and tempo of a dance."""

    style: Style
    genre: str
    bpm: float
    """Beats a minute, of the strongest rhythm of the body's speed."""


def measure_dance(joints: NDArray[np.floating], fps: float) -> MeasuredDance:
    """The dance of joints [T, N >= 22, 3] (metres, Y up)."""
    signals = signals_of(joints, fps)
    root = signals.joints[:, 0]
    heading = signals.heading
    aside = (root[:, 0] - root[:, 0].mean()) * np.cos(heading)
    aside -= (root[:, 2] - root[:, 2].mean()) * np.sin(heading)
    style: Style = "bounce" if float(np.std(root[:, 1])) > float(np.std(aside)) else "sway"
    if float(np.percentile(signals.balls, 85)) > STEP_LIFT:
        style = "step"
    limit, low, high = _WRIST_HEIGHTS[style]
    genre = high if float(signals.wrists[..., 1].mean()) > limit else low
    return MeasuredDance(style, genre, tempo(signals))


def longest_stand(joints: NDArray[np.floating], fps: float) -> float:
    """Longest time in which both feet stand still, seconds; joints [T >= 4, N >= 22, 3] (metres, Y up)."""
    signals = signals_of(joints, fps)
    # Smoothed, so that trembling is no step.
    balls = smooth(signals.joints[:, BALLS], 0.15, fps)
    speed = np.linalg.norm(np.gradient(balls, axis=0), axis=-1) * fps
    return signals.longest(speed.max(1) < STILL)


def beats_of(truth: Record, seconds: float) -> list[float]:
    """Times of the beats inside a clip of `seconds` by its truth record (`ClipMeta.truth`)."""
    if truth.get("beats"):
        return [at for at in truth["beats"] if at < seconds]
    beat = 60.0 / truth["bpm"]
    count = max(0, int(np.ceil((seconds - truth["first_beat"]) / beat - 1e-9)))
    return [truth["first_beat"] + k * beat for k in range(count)]
