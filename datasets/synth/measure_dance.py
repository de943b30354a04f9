"""Which dance a motion is, from its joints alone: style, genre, tempo and the times of its beats.

Style is what the legs do (feet that leave the floor, a root that goes down or aside), the genre is then told
apart by where the hands are on the average: the two genres of a style differ in that by 0.2 arm lengths or
more, whatever the section of the song and whether the arms go together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.synth.genres import Style
from motionloom.datasets.synth.maths import Array
from motionloom.datasets.synth.signals import Signals, signals_of, tempo

STEP_LIFT = 0.03
"""Metres that the ball of a foot is lifted at least by someone who steps."""
_HANDS: dict[str, tuple[float, str, str]] = {
    # Mean height of the wrists over the shoulders, in arm lengths: limit, genre below, genre above.
    "step": (-0.1, "house", "disco"),
    "bounce": (-0.08, "hiphop", "rock"),
    "sway": (-0.35, "reggae", "ballad"),
}


@dataclass(frozen=True)
class MeasuredDance:
    """What a motion dances."""

    style: Style
    genre: str
    bpm: float
    """Beats a minute, of the strongest rhythm of the body's speed."""
    beats: Array
    """Seconds of the kinetic beats: minima of the body's speed."""


def measure_dance(joints: NDArray[Any], fps: float) -> MeasuredDance:
    """The dance of joints [T, N >= 22, 3] (metres, Y up)."""
    signals = signals_of(joints, fps)
    style = _style(signals)
    limit, low, high = _HANDS[style]
    genre = high if float(signals.wrists[..., 1].mean()) > limit else low
    return MeasuredDance(style, genre, tempo(signals), kinetic_beats(joints, fps))


def kinetic_beats(joints: NDArray[Any], fps: float) -> Array:
    """Seconds at which the mean speed of the body joints [T, N >= 22, 3] is at a minimum."""
    from scipy.ndimage import gaussian_filter1d
    from scipy.signal import find_peaks

    body = np.asarray(joints, dtype=np.float64)[:, :22]
    speed = np.linalg.norm(np.diff(body, axis=0), axis=-1).mean(1)
    speed = gaussian_filter1d(speed, max(0.04 * fps, 0.3), mode="nearest")
    found = find_peaks(-speed, prominence=0.1 * max(float(np.ptp(speed)), 1e-12))[0]
    # Speed t lies between frames t and t + 1.
    return np.asarray((found + 0.5) / fps, dtype=np.float64)


def _style(s: Signals) -> Style:
    if float(np.percentile(s.balls, 95)) > STEP_LIFT:
        return "step"
    root = s.joints[:, 0]
    aside = (root[:, 0] - root[:, 0].mean()) * np.cos(s.heading)
    aside -= (root[:, 2] - root[:, 2].mean()) * np.sin(s.heading)
    return "bounce" if float(np.std(root[:, 1])) > float(np.std(aside)) else "sway"
