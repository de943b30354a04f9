"""Recognise style, genre, tempo and beats of a dance on joints.

Style is what the legs do (feet that leave the floor, a root that goes down or aside); the two genres of a
style differ in where the hands are on average by 0.2 arm lengths or more, whatever the section of the song
and whether the arms go together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.actions.hands import Array
from motionloom.datasets.actions.signals import Signals, signals_of, tempo

Record = dict[str, Any]
"""Truth of a clip as plain JSON (`ClipMeta.truth`)."""
Style = Literal["step", "bounce", "sway"]
STEP_LIFT = 0.03
"""Metres that the ball of a foot is lifted at least by someone who steps, for a seventh of the time."""
_WRIST_HEIGHTS: dict[str, tuple[float, str, str]] = {
    # Mean height of the wrists over the shoulders, in arm lengths: limit, genre below, genre above.
    "step": (-0.1, "house", "disco"),
    "bounce": (-0.08, "hiphop", "rock"),
    "sway": (-0.35, "reggae", "ballad"),
}


@dataclass(frozen=True)
class MeasuredDance:
    """Style, genre, tempo and beats of a dance."""

    style: Style
    genre: str
    bpm: float
    """Beats a minute, of the strongest rhythm of the body's speed."""
    beats: Array
    """Seconds of the kinetic beats: minima of the body's speed."""


def measure_dance(joints: NDArray[np.floating], fps: float) -> MeasuredDance:
    """The dance of joints [T, N >= 22, 3] (metres, Y up)."""
    signals = signals_of(joints, fps)
    style = _style(signals)
    limit, low, high = _WRIST_HEIGHTS[style]
    genre = high if float(signals.wrists[..., 1].mean()) > limit else low
    return MeasuredDance(style, genre, tempo(signals), kinetic_beats(joints, fps))


def kinetic_beats(joints: NDArray[np.floating], fps: float) -> Array:
    """Seconds at which the mean speed of the body joints [T, N >= 22, 3] is at a minimum."""
    from scipy.ndimage import gaussian_filter1d
    from scipy.signal import find_peaks

    body = np.asarray(joints, dtype=np.float64)[:, :22]
    speed = np.linalg.norm(np.diff(body, axis=0), axis=-1).mean(1)
    # Joints jitter more than they rest: without smoothing each frame would be a beat.
    speed = gaussian_filter1d(speed, max(0.04 * fps, 0.3), mode="nearest")
    found = find_peaks(-speed, prominence=0.1 * max(float(np.ptp(speed)), 1e-12))[0]
    # Speed t lies between frames t and t + 1.
    return np.asarray((found + 0.5) / fps, dtype=np.float64)


def _style(s: Signals) -> Style:
    if float(np.percentile(s.balls, 85)) > STEP_LIFT:
        return "step"
    root = s.joints[:, 0]
    aside = (root[:, 0] - root[:, 0].mean()) * np.cos(s.heading)
    aside -= (root[:, 2] - root[:, 2].mean()) * np.sin(s.heading)
    return "bounce" if float(np.std(root[:, 1])) > float(np.std(aside)) else "sway"


def beats_of(truth: Record, seconds: float) -> list[float]:
    """Times of the beats inside a clip of `seconds` by its truth record (`ClipMeta.truth`)."""
    if truth.get("beats"):
        return [at for at in truth["beats"] if at < seconds]
    beat = 60.0 / truth["bpm"]
    count = max(0, int(np.ceil((seconds - truth["first_beat"]) / beat - 1e-9)))
    return [truth["first_beat"] + k * beat for k in range(count)]
