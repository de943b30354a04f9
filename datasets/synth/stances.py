"""How somebody stands before and after an action: idle poses, and how soon a clip begins and ends.

Every action is animated from one pose, arms hanging, and back to it. People stand as they like until they
begin, and a clip is cut where they move. `settle` writes both into a track.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.actions.signals import STAND
from motionloom.datasets.synth.actions.arms import Vec, slerp, to_point
from motionloom.datasets.synth.actions.maths import Array, ease, unit
from motionloom.datasets.synth.actions.pose import Track

Poses = Literal["few", "everyday"]
PACE = (0.9, 1.1)
"""How much slower or quicker than the usual a person does everything; "slowly" and "quickly" still differ."""
RELAXED = 0.3
"""Seconds in which an idle pose is left or taken."""
REST = 0.3
"""Longest rest before and after an action, seconds."""
_MOVES = 0.25
"""Metres a second at which a joint counts as moving; who breathes and sways stays below."""

_IDLE: dict[str, tuple[tuple[float, float, float], Vec, float, float]] = {
    "hip": ((0.24, -0.24, 0.02), (-1.0, -0.2, 0.3), -0.4, 0.5),
    "front": ((0.12, -0.32, 0.2), (-0.7, 0.2, 0.7), 0.3, 0.0),
    "back": ((0.12, -0.28, -0.16), (-0.9, 0.0, -0.4), 0.0, 0.0),
    "thigh": ((0.17, -0.42, 0.14), (-0.3, 0.2, 1.0), 0.2, 0.2),
}
"""Pose of an arm: wrist seen from the chest (metres, x outwards), bend, twist and wrist flexion (radians)."""
_BOTH = ("hip", "front", "back")


def settle(track: Track, shortest: float, rng: np.random.Generator) -> Track:
    """The track of somebody who stands as she likes before and after what she does, cut where she moves.

    Only an end at which one stands still, arms down, is changed. At most `REST` seconds of rest are kept,
    unless the track were below `shortest` seconds.
    """
    moving = _moving(track)
    busy = np.flatnonzero(moving.any(1))
    begin = 0
    end = len(track.t)
    if not len(busy):
        return track
    for last in (False, True):
        at = -1 if last else 0
        low = track.root[at, 1] < 0.94 * STAND
        up = any(unit(arm.direction[at])[1] > -0.8 for arm in track.arms)
        if low or up or moving[at].any():
            continue
        rest = round(rng.uniform(0.0, REST) * track.fps)
        if last:
            end = min(end, int(busy[-1]) + 1 + rest)
        else:
            begin = max(0, int(busy[0]) - rest)
        _stand(track, moving, last, rng)
    track.lower_to_reach()
    least = min(round(shortest * track.fps), len(track.t))
    begin = max(0, min(begin - max(0, least - end + begin) // 2, len(track.t) - least))
    end = max(end, begin + least)
    return track.cut(begin, end - begin)


def _moving(track: Track) -> NDArray[np.bool_]:
    """Whether [T, 3] the left wrist, the right one and anything else move."""
    joints = track.solve()[:, :22]
    speed = np.linalg.norm(np.gradient(joints, axis=0), axis=-1) * track.fps
    others = np.delete(speed, [18, 19, 20, 21], axis=1).max(1)
    return np.asarray(np.stack([speed[:, 20], speed[:, 21], others], axis=1) > _MOVES)


def _stand(track: Track, moving: NDArray[np.bool_], last: bool, rng: np.random.Generator) -> None:
    """Take one idle pose at the beginning or, `last`, at the end of a track."""
    names = [str(rng.choice(_BOTH))] * 2 if rng.random() < 0.35 else list(rng.choice(("", "hip", "thigh"), 2))
    for side, name in enumerate(names):
        weight = _fade(track, moving[:, side] | moving[:, 2], last)
        if not name:
            continue
        wrist, bend, roll, flex = _IDLE[name]
        place, reach = to_point(*(np.array(wrist) + rng.normal(0.0, 0.015, 3)))
        arm = track.arms[side]
        arm.direction = slerp(unit(arm.direction), np.tile(unit(np.array(place)), (len(weight), 1)), weight)
        arm.bend = unit(arm.bend + weight[:, None] * (unit(np.array(bend)) - arm.bend))
        arm.reach = arm.reach + weight * (reach - arm.reach)
        arm.roll = arm.roll + weight * (roll - arm.roll)
        arm.flex = arm.flex + weight * (flex - arm.flex)
    # The weight is on one leg, the hip above it higher, and she looks somewhere.
    weight = _fade(track, np.asarray(moving.any(1)), last)
    shift = rng.uniform(-0.05, 0.05)
    track.root += (
        weight[:, None]
        * shift
        * np.stack([np.cos(track.yaw), np.zeros_like(track.yaw), -np.sin(track.yaw)], axis=-1)
    )
    track.pelvis[:, 2] += 1.2 * shift * weight
    track.spine[:, 2] -= 1.5 * shift * weight
    track.head[:, :2] += weight[:, None] * rng.normal(0.0, (0.06, 0.2))


def _fade(track: Track, busy: NDArray[np.bool_], last: bool) -> Array:
    """A weight [T] that is 1 until half of `RELAXED` before one moves, and 0 from half of it after that."""
    if last:
        return _fade(track, busy[::-1], False)[::-1]
    first = float(np.argmax(busy)) if busy.any() else float(len(busy))
    first = max(first / track.fps, 0.5 * RELAXED)
    return ease((first + 0.5 * RELAXED - track.t) / RELAXED)
