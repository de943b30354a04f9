"""Two actions in turn: the second begins where the first has ended and faces the way it faces then."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from motionloom.datasets.synth.actions.maths import Array, ease
from motionloom.datasets.synth.actions.pose import Track
from motionloom.datasets.synth.actions.truth import Span, Truth
from motionloom.datasets.synth.hands import grip_hand

OVERLAP = 0.4
"""Seconds in which one action passes into the next."""


def animate_in_turn(
    parts: tuple[Truth, Truth],
    animate: Callable[[Truth, Span, float, np.random.Generator], Track],
    span: Span,
    fps: float,
    rng: np.random.Generator,
) -> Track:
    """Both `parts`, each as long as half of the span allows, with their hands."""
    half = Span(1.9, 0.5 * (span.high + OVERLAP), returns=True)
    first, second = (animate(part, half, fps, rng) for part in parts)
    track = joined(first, second)
    change = len(first.t) / fps - 0.5 * OVERLAP
    for side in (0, 1):
        # The same noise on both sides of the change, where the hand is relaxed.
        seed = int(rng.integers(2**32))
        grips = (ease((change - track.t) / 0.3), ease((track.t - change) / 0.3))
        before, after = (
            grip_hand(part.hand(side), track.t, grip, np.random.default_rng(seed))
            for part, grip in zip(parts, grips, strict=True)
        )
        track.fingers[side] = np.where((track.t < change)[:, None, None, None], before, after)
    return track


def joined(first: Track, second: Track) -> Track:
    """One track of two that begin and end standing; the feet are set one after the other into new places."""
    fps = first.fps
    shared = round(OVERLAP * fps)
    start, frames = len(first.t) - shared, len(first.t) - shared + len(second.t)
    out = Track(np.arange(frames) / fps, fps)
    turn = float(first.yaw[-1])
    cos, sin = np.cos(turn), np.sin(turn)

    def placed(xyz: Array) -> Array:
        x, z = xyz[..., 0] - old[0], xyz[..., 2] - old[1]
        moved = xyz.copy()
        moved[..., 0], moved[..., 2] = cos * x + sin * z + new[0], cos * z - sin * x + new[1]
        return moved

    new = first.ball[:, -1].mean(0)[[0, 2]]
    old = second.ball[:, 0].mean(0)[[0, 2]]
    progress = (np.arange(frames) - start) / max(shared - 1, 1)

    def mixed(a: Array, b: Array, weight: Array) -> Array:
        a = np.concatenate([a, np.repeat(a[-1:], frames - len(a), axis=0)])
        b = np.concatenate([np.repeat(b[:1], frames - len(b), axis=0), b])
        return a + weight.reshape(-1, *[1] * (a.ndim - 1)) * (b - a)

    weight = ease(progress)
    out.root = mixed(first.root, placed(second.root), weight)
    out.yaw = mixed(first.yaw, second.yaw + turn, weight)
    for name in ("pelvis", "spine", "head"):
        setattr(out, name, mixed(getattr(first, name), getattr(second, name), weight))
    for side in (0, 1):
        step = np.clip(2 * progress - side, 0.0, 1.0)
        out.ball[side] = mixed(first.ball[side], placed(second.ball[side]), ease(step))
        out.ball[side, :, 1] += 0.03 * np.sin(np.pi * step) ** 2
        out.foot_yaw[side] = mixed(first.foot_yaw[side], second.foot_yaw[side] + turn, ease(step))
        for name in ("foot_pitch", "knee_out"):
            getattr(out, name)[side] = mixed(getattr(first, name)[side], getattr(second, name)[side], weight)
        for name in ("direction", "reach", "bend", "roll", "flex"):
            before, after = (getattr(track.arms[side], name) for track in (first, second))
            setattr(out.arms[side], name, mixed(before, after, weight))
    out.lower_to_reach()
    return out
