"""Check of a stated frame rate by the physics of a fall and of a step.

In flight a body falls with gravity, whatever it does: at a stated rate that is k times the true one it falls
with k² times as much. And a leg swings through a step like the pendulum it is, in 0.3 to 0.6 s: sprinters
need 0.3 s. Both bounds hold on all real recordings that we know the rate of [ours].
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.canonical import runs
from motionloom.datasets.motion.skeleton import Skeleton

GRAVITY = 9.81
_FAST, _SLOW = 18.0, (1.2, 3.3)
"""Falls in m/s² of which no true rate is the reason: dancers' leaps measure 5 to 14."""
_FLIGHTS = 3
"""Flights that a rate which is too low must show; climbing and hanging look like slow ones."""
_SWING_SECONDS = 0.25
_SWINGS = 4
_STRIDE_METRES = (0.6, 2.2)
_COMMON = (24.0, 25.0, 30.0, 50.0, 60.0, 100.0, 120.0, 240.0)

_NAMED = Skeleton.named("smpl22")
_ANKLES = [_NAMED.index(f"{side}_ankle") for side in ("left", "right")]
_BALLS = [_NAMED.index(f"{side}_foot") for side in ("left", "right")]
_ANKLE_METRES = 0.09
"""Height of an ankle above the ball of a foot on the floor."""
_MASS = {"pelvis": 0.14, "spine2": 0.15, "spine3": 0.2, "head": 0.08} | {
    f"{side}_{joint}": share
    for side in ("left", "right")
    for joint, share in (
        ("hip", 0.05), ("knee", 0.075), ("ankle", 0.03), ("foot", 0.0145), ("shoulder", 0.014),
        ("elbow", 0.022), ("wrist", 0.014),
    )
}  # fmt: skip
"""Share of the body's mass at a joint, after Winter's table of segments."""
_WEIGHTS = np.array([_MASS.get(joint, 0.0) for joint in _NAMED.joints])
_WEIGHTS /= _WEIGHTS.sum()

Floats = NDArray[np.floating]


def wrong_rate(joints: Floats, fps: float) -> str:
    """Return why a stated rate cannot be true, with the evidence; empty where nothing speaks against it.

    `joints` [T, N, 3] in metres, Y up, the first 22 those of the body skeleton, at `fps`.
    """
    falls = _falls(joints, fps)
    fall = float(np.median(falls)) if len(falls) else GRAVITY
    if fall > _FAST or (len(falls) >= _FLIGHTS and _SLOW[0] < fall < _SLOW[1]):
        true = fps / np.sqrt(fall / GRAVITY)
        near = min(_COMMON, key=lambda rate: abs(np.log(rate / true)))
        true = near if abs(np.log(near / true)) < 0.12 else true
        return (
            f"in {len(falls)} flights the body falls with {fall:.1f} m/s² and not with {GRAVITY}: "
            f"the frame rate is about {true:.3g} rather than {fps:g}"
        )
    swings = _swings(joints, fps)
    if len(swings) >= _SWINGS and np.median(swings) < _SWING_SECONDS:
        return (
            f"in {len(swings)} steps the leg swings for {np.median(swings):.2f} s, and people need 0.3 to "
            f"0.6 s: the frame rate may be half of {fps:g}"
        )
    return ""


def _falls(joints: Floats, fps: float) -> list[float]:
    """Return the downward acceleration in m/s² of every flight: both feet leave the floor and come back."""
    feet = np.concatenate([joints[:, _ANKLES, 1] - _ANKLE_METRES, joints[:, _BALLS, 1]], axis=1).min(axis=1)
    feet = feet - np.percentile(feet, 5)
    height = joints[:, : len(_WEIGHTS), 1] @ _WEIGHTS
    accelerations = []
    for first, end in runs(feet > 0.04):
        seconds = (end - first) / fps
        if first == 0 or end == len(feet) or end - first < 5 or not 0.08 < seconds < 1.3:
            continue
        if feet[first:end].max() < 0.08:
            continue
        times = np.arange(end - first) / fps
        curve = np.polyfit(times, height[first:end], 2)
        if np.abs(height[first:end] - np.polyval(curve, times)).max() < 0.03:
            accelerations.append(-2 * float(curve[0]))
    return accelerations


def _swings(joints: Floats, fps: float) -> list[float]:
    """Return the seconds of every swing of a leg through a step."""
    seconds = []
    for ankle in _ANKLES:
        path = joints[:, ankle][:, [0, 2]]
        speed = np.linalg.norm(np.diff(path, axis=0), axis=-1) * fps
        for first, end in runs(speed > 0.25 * np.percentile(speed, 99)) if len(speed) else ():
            stride = float(np.linalg.norm(path[end] - path[first]))
            if first > 0 and end < len(speed) and _STRIDE_METRES[0] < stride < _STRIDE_METRES[1]:
                seconds.append((end - first) / fps)
    return seconds
