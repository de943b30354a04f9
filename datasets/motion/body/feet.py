"""Planted feet: where feet stand they stay, and the legs follow **[ours]**.

A foot stands while its ball is low and slow, or, in features with contact columns, while these say so and it
is low (published contacts hold at any height, h3d.py). For as long as it stands it is pinned above one point
of the floor, its median there; before and after, the way to that point is blended in and out. Ankle and ball
move by the same amount, so the foot keeps its angle, and `chain_solver` finds legs, and where they do not
reach a little of everything else, that fit. This changes the motion: `FeetReport` says what it costs and
what it gains.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.body.chain_solver import solve_poses
from motionloom.datasets.motion.body.rigid import FitError, RigidMotion
from motionloom.datasets.motion.canonical import runs
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.motion.skeleton import Skeleton

SIDES = ("left", "right")

_PINNED = 1000.0
"""Weight of ankles and balls against 1 of other joints: a pinned foot stays within a few millimetres even
where the rest of the body has to give way."""
_KNEES = 0.05
"""Knees are where a leg may bend."""


HEIGHT = 0.05
"""Metres above the floor below which a ball of the foot may stand; the floor is the balls' lowest place,
2 percent of the frames left out."""
SPEED = 0.8
"""Metres a second along the floor below which it may stand; sliding feet of small models reach 0.6."""
SUNK = 1e-3
"""Metres under the floor from which a joint comes up to it."""
_SHORTEST = 0.1
"""Seconds: shorter contacts are none, and shorter gaps between two are closed."""
_BLEND = 0.15
"""Seconds in which a correction comes and goes."""


@dataclass(frozen=True)
class FeetReport:
    """Change by planting the feet. Slides are means over all steps in which a foot stands."""

    slide_before: float
    """Centimetres a second along the floor."""
    slide_after: float
    unplanted: FitError
    """Distance of the figure from the joints before its feet were planted."""


def foot_contacts(
    joints: NDArray[np.floating],
    skeleton: Skeleton,
    fps: float,
    features: NDArray[np.floating] | None = None,
    layout: MotionLayout | None = None,
) -> NDArray[np.bool_]:
    """Return when the left and the right foot stand [T, 2], from joints [T, N, 3] in metres.

    `features` [T, D] of a `layout` with contact columns take the place of the speed.
    """
    balls = np.asarray(joints, np.float64)[:, _balls(skeleton)]
    low = balls[..., 1] - np.percentile(balls[..., 1], 2) < HEIGHT
    if features is not None and layout is not None and layout.has("foot_contacts"):
        stated = np.asarray(features)[:, layout.slice("foot_contacts")] > 0.5
        slow = stated[:, [1, 3]]  # ankle and ball of the left foot, then of the right one
    else:
        way = np.gradient(balls[..., [0, 2]], axis=0) if len(balls) > 1 else np.zeros((1, 2, 2))
        slow = np.linalg.norm(way * fps, axis=-1) < SPEED
    shortest = max(1, round(_SHORTEST * fps))
    standing = low & slow
    # Gaps first: a contact that flickers is one contact, and only then may a short one be dropped.
    for foot in range(2):
        standing[:, foot] = _without_short_runs(standing[:, foot], shortest, gaps=True)
        standing[:, foot] = _without_short_runs(standing[:, foot], shortest, gaps=False)
    return standing


def plant_feet(
    motion: RigidMotion,
    unfitted: NDArray[np.floating],
    contacts: NDArray[np.bool_],
    fps: float,
    fixed: NDArray[np.bool_] | None = None,
) -> tuple[RigidMotion, FeetReport]:
    """Return the motion with its feet pinned while `contacts` [T, 2] say that they stand.

    `unfitted` [T, N, 3] are the joints before any fit, which the result's error is measured against. Frames
    that are `fixed` [T] have no contacts; a foot that stands beside one is pinned where it stands there.
    Without them, joints under the floor, which is at height 0, come up to it.
    """
    skeleton = motion.skeleton
    balls = _balls(motion.skeleton)
    before = _slide(motion.joints[:, balls], contacts, fps)
    sunk = fixed is None and float(motion.joints[..., 1].min()) < -SUNK
    if not contacts.any() and not sunk:
        return motion, FeetReport(before, before, motion.error)
    targets = motion.joints.copy()
    weights = np.ones(len(skeleton))
    blend = max(1, round(_BLEND * fps))
    for foot, side in enumerate(SIDES):
        ankle = skeleton.index(f"{side}_ankle")
        change = _correction(motion.joints[:, balls[foot]], contacts[:, foot], blend, fixed)
        targets[:, [ankle, balls[foot]]] += change[:, None]
        weights[[ankle, balls[foot]]] = _PINNED
        weights[skeleton.index(f"{side}_knee")] = _KNEES
    if sunk:
        targets[..., 1] = np.maximum(targets[..., 1], 0)
    if fixed is not None:
        weights[0] = 10 * _PINNED  # the root stays on its way, which leads from one fixed frame to the next
    turned, root = solve_poses(
        targets, skeleton.offsets, skeleton.parents, motion.rotations, motion.root, weights
    )
    planted = RigidMotion.posed(skeleton, turned, root, unfitted)
    after = _slide(planted.joints[:, balls], contacts, fps)
    return planted, FeetReport(before, after, motion.error)


def _balls(skeleton: Skeleton) -> list[int]:
    return [skeleton.index(f"{side}_foot") for side in SIDES]


def _slide(balls: NDArray[np.float64], contacts: NDArray[np.bool_], fps: float) -> float:
    """Mean speed along the floor in centimetres a second, over steps whose both frames are in contact."""
    both = contacts[1:] & contacts[:-1]
    if not both.any():
        return 0.0
    step = np.linalg.norm(np.diff(balls[..., [0, 2]], axis=0), axis=-1)
    return float(step[both].mean() * fps * 100)


def _correction(
    ball: NDArray[np.float64], standing: NDArray[np.bool_], blend: int, fixed: NDArray[np.bool_] | None
) -> NDArray[np.float64]:
    """Displacement [T, 3] along the floor that keeps a ball of the foot [T, 3] still while it stands."""
    out = np.zeros_like(ball)
    stands = runs(standing)
    fixed = np.zeros(len(ball), dtype=np.bool_) if fixed is None else fixed
    for start, end in stands:
        # Between two fixed frames the foot gives way evenly.
        ends = [ball[k] for k in (start - 1, end) if 0 <= k < len(ball) and fixed[k]]
        anchor = np.linspace(ends[0], ends[-1], end - start) if ends else np.median(ball[start:end], axis=0)
        out[start:end, [0, 2]] = (anchor - ball[start:end])[:, [0, 2]]
    frames = np.arange(len(ball))
    ends = [0, *(edge for run in stands for edge in run), len(ball)]
    for free_start, free_end in zip(ends[::2], ends[1::2], strict=True):
        free = frames[free_start:free_end]
        if not len(free):
            continue
        # Within a gap shorter than two blends both corrections fade over the whole gap, so none is cut off.
        span = min(blend, len(free) + 1)
        if free_start > 0:
            out[free] += out[free_start - 1] * _fade((free - free_start + 1) / span)[:, None]
        if free_end < len(ball):
            out[free] += out[free_end] * _fade((free_end - free) / span)[:, None]
    out[fixed] = 0
    return out


def _fade(way: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a smooth step from 1 at 0 to 0 at 1 and beyond."""
    x = np.clip(way, 0, 1)
    return np.asarray(1 - x * x * (3 - 2 * x), dtype=np.float64)


def _without_short_runs(flags: NDArray[np.bool_], shortest: int, *, gaps: bool) -> NDArray[np.bool_]:
    """Runs of true shorter than `shortest` frames removed; with `gaps` those of false between two of true."""
    out = flags.copy()
    for start, end in runs(~flags if gaps else flags):
        inside = start > 0 and end < len(flags)
        if end - start < shortest and (inside or not gaps):
            out[start:end] = gaps
    return out
