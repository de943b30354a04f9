"""Dances whose poses lie on the beats: between two beats the body eases from one pose to the next.

A minimum-jerk ease has no speed at its ends, so every beat is a minimum of the body's speed: exactly what
Beat Align (UDE section 4.3) looks for.
"""

from __future__ import annotations

import numpy as np

from motionloom.datasets.synth.arms import Hold, Vec, play
from motionloom.datasets.synth.maths import Array, keys
from motionloom.datasets.synth.pose import Track
from motionloom.datasets.synth.truth import Span, Truth

_ARMS: tuple[tuple[tuple[Vec, float, Vec], tuple[Vec, float, Vec]], ...] = (
    # Pairs of arm poses (direction, reach, bend) between which the beats alternate.
    (((0.3, -0.55, 0.75), 0.62, (-0.3, 1.0, 0.3)), ((0.45, -0.1, 0.9), 0.72, (-0.4, 1.0, 0.1))),
    (((0.9, -0.35, 0.2), 0.7, (-0.3, 0.8, 0.5)), ((0.7, 0.55, 0.4), 0.72, (-0.6, 0.8, 0.0))),
    (((0.35, -0.9, 0.4), 0.82, (-0.2, 0.4, 1.0)), ((1.0, -0.05, 0.25), 0.9, (-0.1, 0.7, 0.6))),
    (((0.1, -0.3, 0.9), 0.55, (-0.5, 1.0, 0.2)), ((0.1, 0.9, 0.45), 0.85, (-0.8, 0.5, 0.0))),
    (((0.3, -0.8, 0.5), 0.7, (-0.2, 0.7, 1.0)), ((0.15, -0.25, 1.0), 0.8, (-0.3, 1.0, 0.1))),
)


def dance(truth: Truth, span: Span, fps: float, rng: np.random.Generator) -> Track:
    """Step, bounce or sway from side to side on the beat with alternating arms."""
    beat = 60.0 / (truth.bpm or 120)
    offset = rng.uniform(0.0, beat)
    seconds = span.pick(rng, at_least=min(4.0, span.high))
    track = Track.standing(seconds, fps, rng, width=rng.uniform(0.0, 0.05))
    track.first_beat = offset
    beats: Array = np.asarray(offset + beat * np.arange(-1, int(seconds / beat) + 3), dtype=np.float64)
    amount = rng.uniform(0.8, 1.2)
    even = np.where(np.arange(len(beats)) % 2 == 0, 1.0, -1.0)
    side_to_side = keys(track.t, beats, even)
    if truth.style == "step":
        side_steps(track, beats, beat, 0.12 * amount)
    wide = {"step": 0.0, "bounce": 0.03, "sway": 0.08}[truth.style or "bounce"] * amount
    track.root[:, 0] += wide * side_to_side
    deep = {"step": 0.05, "bounce": 0.1, "sway": 0.05}[truth.style or "bounce"] * amount
    # Down on the beat or, one beat later, up: alternating depth keeps the speed at zero on each beat.
    track.root[:, 1] -= 0.03 + deep * (0.5 + 0.5 * side_to_side)
    track.pelvis[:, 2] += 0.07 * amount * side_to_side
    track.spine[:, 2] -= 0.16 * amount * side_to_side
    track.spine[:, 1] += rng.uniform(0.1, 0.35) * side_to_side
    track.head[:, 2] += 0.08 * side_to_side
    track.head[:, 0] += 0.08 * (0.5 + 0.5 * side_to_side)
    track.knee_out += 0.1 * (0.5 + 0.5 * side_to_side)
    _arms(track, beats, even, rng)
    track.lower_to_reach(0.5 / fps)
    return track


def _arms(track: Track, beats: Array, even: Array, rng: np.random.Generator) -> None:
    """Both arms together or in opposition; the pair of poses may change every eight beats."""
    opposed = rng.random() < 0.5
    picks = rng.integers(len(_ARMS), size=len(beats) // 8 + 1)
    for side in (0, 1):
        holds: list[Hold] = []
        for k, at in enumerate(beats):
            pair = _ARMS[int(picks[k // 8])]
            up = (even[k] > 0) != (opposed and side == 1)
            direction, reach, bend = pair[1 if up else 0]
            holds.append((float(at), direction, reach, bend))
        play(track, side, holds)


def side_steps(track: Track, beats: Array, beat: float, far: float) -> None:
    """Step out with one foot and bring the other to it, two beats each way; each foot lands on its beat."""
    where = np.zeros((2, len(beats)))
    for k in range(1, len(beats)):
        where[:, k] = where[:, k - 1]
        turn = k % 4
        # Beats 0, 1 go left (left foot, then right foot closes), beats 2, 3 go right.
        foot = 0 if turn in (0, 3) else 1
        where[foot, k] = far if turn in (0, 1) else -far
        mine = (track.t >= beats[k - 1]) & (track.t < beats[k])
        phase = np.where(mine, (track.t - beats[k - 1]) / beat, 0.0)
        track.ball[foot, :, 1] += 0.06 * np.sin(np.pi * phase) ** 2
        track.foot_pitch[foot] += 0.35 * np.sin(np.pi * phase) ** 2
    for foot in (0, 1):
        track.ball[foot, :, 0] += keys(track.t, beats, where[foot])
    track.root[:, 0] += keys(track.t, beats, where.mean(0))
