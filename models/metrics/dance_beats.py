"""Beat Align: how closely the beats of a motion and those of its music meet (UDE section 4.3).

The public implementations share the idea, exp(-d^2 / (2 sigma^2)) of the distance d to the nearest beat of
the other, and differ in everything else; `DEFINITIONS` names them:

- `bailando` averages over the music's beats. Speed is the mean over the joints, smoothed over 5 frames, and
  the step t -> t + 1 counts for frame t; every local minimum is a beat.
- `mint` (AI Choreographer) averages over the motion's beats. Speed is the sum over the joints, the step
  t - 1 -> t counts for frame t; a beat is below 10 frames to either side.
- UDE and EDGE measure as `bailando`: their formulas average over the music's beats.

Frames are those of 60 a second; at other rates widths keep their seconds **[ours]**. Music beats come from
the clip's truth or from a beat tracker, in seconds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

_FPS = 60.0
"""Frame rate at which the published widths are counted."""


@dataclass(frozen=True)
class BeatDefinition:
    """One public definition; widths in frames of 60 a second."""

    average: Literal["music", "motion"]
    smoothing: float
    """Standard deviation of the Gaussian over the speed; 0 for none."""
    order: int
    """A minimum is below so many neighbours on either side."""
    late: bool
    """Whether the step between two frames counts for the second of them."""
    sigma: float = 3.0


DEFINITIONS: dict[str, BeatDefinition] = {
    "bailando": BeatDefinition("music", smoothing=5.0, order=1, late=False),
    "mint": BeatDefinition("motion", smoothing=0.0, order=10, late=True),
}


def motion_beats(
    joints: NDArray[np.floating], fps: float, definition: str = "bailando"
) -> NDArray[np.float64]:
    """Seconds of the beats of a motion, joints [T, N, 3]: minima of the body's speed, ascending."""
    from scipy.ndimage import gaussian_filter1d
    from scipy.signal import argrelextrema

    how = DEFINITIONS[definition]
    steps = np.linalg.norm(np.diff(np.asarray(joints, dtype=np.float64), axis=0), axis=-1).mean(1)
    if how.late:
        steps = np.concatenate([[0.0], steps])
    if how.smoothing:
        steps = gaussian_filter1d(steps, how.smoothing * fps / _FPS)
    order = max(1, round(how.order * fps / _FPS))
    return np.asarray(argrelextrema(steps, np.less, order=order)[0] / fps, dtype=np.float64)


def beat_align(
    joints: NDArray[np.floating], music: NDArray[np.floating], fps: float, definition: str = "bailando"
) -> float:
    """Beat Align, 0 to 1, of joints [T, N, 3] and music beats in seconds [M]; 0 without motion beats."""
    how = DEFINITIONS[definition]
    last = len(joints) - (0 if how.late else 1)
    # Beats on the last frame have no step of their own; rounding keeps frame / fps * fps whole.
    inside = np.asarray(music, dtype=np.float64)[np.round(np.asarray(music) * fps, 6) < last]
    return alignment(inside, motion_beats(joints, fps, definition), how.average, how.sigma / _FPS)


def alignment(
    music: NDArray[np.floating],
    motion: NDArray[np.floating],
    average: Literal["music", "motion"],
    sigma: float,
) -> float:
    """Mean over the beats of one, in seconds, of exp(-d^2 / (2 sigma^2)), d to the nearest of the other."""
    if not len(music) or not len(motion):
        return 0.0
    away = np.abs(np.asarray(music, dtype=np.float64)[:, None] - np.asarray(motion, dtype=np.float64)[None])
    nearest = away.min(1 if average == "music" else 0)
    return float(np.exp(-(nearest**2) / (2 * sigma**2)).mean())
