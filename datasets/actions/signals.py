"""One-dimensional signals of a motion that its description can be read from.

Lengths are divided by the person's size (straight-leg length over that of the uniform skeleton), so that
thresholds are metres of a 1.7 m adult. Headings come from the hips alone, so a twisting chest does not count
as a turn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.actions.hands import Array
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.canonical import runs
from motionloom.datasets.motion.skeleton import Skeleton

_REST = Skeleton.named("smplx52")
STAND = float(-_REST.rest_joints[10, 1])
"""Root height of the rest pose above the balls of the feet, metres."""
THIGH, SHIN = (float(np.linalg.norm(_REST.offsets[joint])) for joint in (4, 7))
"""Metres from hip to knee and from knee to ankle."""
_STANDING = 25
"""Percent of the frames, at least, in which runners and jumpers have a foot on the floor."""
BALLS = (10, 11)
_ANKLES = (7, 8)
_SHOULDERS = (16, 17)
_WRISTS = (20, 21)


@dataclass(frozen=True)
class Signals:
    """Signals of a motion of T frames; index 0 of a pair is left."""

    fps: float
    joints: Array
    """[T, N, 3], smoothed a little, size removed, floor at 0."""
    heading: Array
    """[T] radians, unwrapped, positive to the left."""
    travel: Array
    """[T] metres the middle of the feet has gone along the heading; negative is backwards."""
    speed: Array
    """[T] metres per second of the root along the heading, smoothed over a step."""
    drop: Array
    """[T] metres of the root below standing."""
    behind: Array
    """[T] metres of the root behind the ankles."""
    balls: Array
    """[2, T] height of the balls of the feet."""
    trunk: Array
    """[T] forward lean of pelvis to neck, radians."""
    aside: Array
    """[T] lean of pelvis to neck to the left, radians."""
    wrists: Array
    """[2, T, 3] shoulder to wrist over arm length: outwards, up, forwards."""
    wrist_height: Array
    """[2, T] metres above the floor."""
    apart: Array
    """[T] metres from wrist to wrist."""

    def peaks(self, signal: Array, prominence: float, height: float | None = None) -> int:
        """Number of peaks of a signal [T]; the ends count as low."""
        from scipy.signal import find_peaks

        low = float(signal.min()) - 1e-6
        padded = np.concatenate([[low], signal, [low]])
        return len(find_peaks(padded, prominence=prominence, height=height)[0])

    def longest(self, mask: NDArray[np.bool_]) -> float:
        """Longest time a condition [T] holds without a break, seconds."""
        return max((b - a for a, b in runs(mask)), default=0) / self.fps


def signals_of(joints: NDArray[np.floating], fps: float) -> Signals:
    """Signals of joints [T, N >= 22, 3] in metres, Y up."""
    from scipy.ndimage import gaussian_filter1d

    if joints.ndim != 3 or joints.shape[0] < 4 or joints.shape[1] < 22 or joints.shape[2] != 3:
        raise UserError(f"joints of shape {list(joints.shape)}: expected [T >= 4, N >= 22, 3]")
    x = gaussian_filter1d(np.asarray(joints, dtype=np.float64), max(0.025 * fps, 0.3), axis=0, mode="nearest")
    # Sizes and the floor are taken from the motion itself, so that thresholds hold for everybody.
    legs = [_length(x, 1 + s, 4 + s) + _length(x, 4 + s, 7 + s) for s in (0, 1)]
    x /= max(float(np.mean(legs)), 1e-3) / (THIGH + SHIN)
    # Of the lower ball, since a foot of a generated motion may dip under the floor that the others stand on.
    x[..., 1] -= np.percentile(x[:, BALLS, 1].min(1), _STANDING)
    # A chest that twists is no turn: the heading is that of the hips.
    hips = x[:, 1] - x[:, 2]
    heading = smooth(np.unwrap(np.arctan2(-hips[:, 2], hips[:, 0])), 0.08, fps)
    forward = np.stack([np.sin(heading), np.cos(heading)], axis=-1)
    left = np.stack([np.cos(heading), -np.sin(heading)], axis=-1)
    root = x[:, 0]
    feet = x[:, BALLS].mean(1)
    # Steps are projected on the heading before they are summed: a circle goes forward all the way.
    step = np.diff(feet[:, [0, 2]], axis=0)
    travel = np.concatenate([[0.0], np.cumsum((step * 0.5 * (forward[1:] + forward[:-1])).sum(-1))])
    velocity = np.gradient(smooth(root[:, [0, 2]], 0.15, fps), 1 / fps, axis=0)
    spine = x[:, 12] - root
    arms = []
    for side, sign in ((0, 1.0), (1, -1.0)):
        length = _length(x, 16 + side, 18 + side) + _length(x, 18 + side, 20 + side)
        to = (x[:, 20 + side] - x[:, 16 + side]) / max(length, 1e-3)
        flat = to[:, [0, 2]]
        arms.append(np.stack([sign * (flat * left).sum(-1), to[:, 1], (flat * forward).sum(-1)], axis=-1))
    away = (x[:, _ANKLES].mean(1) - root)[:, [0, 2]]
    return Signals(
        fps=fps,
        joints=x,
        heading=heading,
        travel=travel,
        speed=(velocity * forward).sum(-1),
        drop=STAND - root[:, 1],
        behind=(away * forward).sum(-1),
        balls=x[:, BALLS, 1].T,
        trunk=np.arctan2((spine[:, [0, 2]] * forward).sum(-1), spine[:, 1]),
        aside=np.arctan2((spine[:, [0, 2]] * left).sum(-1), np.linalg.norm(spine[:, 1:], axis=-1)),
        wrists=np.stack(arms),
        wrist_height=x[:, _WRISTS, 1].T,
        apart=np.linalg.norm(x[:, 20] - x[:, 21], axis=-1),
    )


def tempo(signals: Signals) -> float:
    """Beats per minute of a dance: the strongest rhythm of the body's mean speed between 60 and 170."""
    body = signals.joints[:, :22]
    speed = np.linalg.norm(np.diff(body, axis=0), axis=-1).mean(1)
    speed = (speed - speed.mean()) * np.hanning(len(speed) + 2)[1:-1]
    bpm = np.arange(60.0, 170.5, 0.5)
    time = np.arange(len(speed)) / signals.fps
    power = np.abs(np.exp(-2j * np.pi * bpm[:, None] / 60 * time) @ speed)
    return float(bpm[int(np.argmax(power))])


def rise_time(signal: Array, fps: float) -> float:
    """Seconds of the first rise of a signal [T] from rest to its top, by its 10 % and 90 % crossings.

    Infinite for a signal that never rises (a generated motion may do nothing); never less than a frame.
    """
    low = float(signal[0])
    high = float(signal.max())
    if high - low < 1e-6:
        return math.inf
    share = (signal - low) / (high - low)
    end = _crossing(share, 0.9, 0)
    below = np.flatnonzero(share[: int(end) + 1] < 0.1)
    start = _crossing(share, 0.1, int(below[-1]) if len(below) else 0)
    # A minimum-jerk ease spends half of its time between these two.
    return max(end - start, 1.0) / fps / 0.5


def _crossing(share: Array, level: float, first: int) -> float:
    after = np.flatnonzero(share[first:] >= level)
    k = first + (int(after[0]) if len(after) else len(share) - 1 - first)
    if k == 0 or share[k] <= share[k - 1]:
        return float(k)
    return float(k - np.clip((share[k] - level) / (share[k] - share[k - 1]), 0.0, 1.0))


def _length(x: Array, a: int, b: int) -> float:
    return float(np.median(np.linalg.norm(x[:, a] - x[:, b], axis=-1)))


def smooth(x: Array, seconds: float, fps: float) -> Array:
    """The signal [T, ...] smoothed by a Gaussian of so many seconds."""
    from scipy.ndimage import gaussian_filter1d

    return np.asarray(gaussian_filter1d(x, seconds * fps, axis=0, mode="nearest"))
