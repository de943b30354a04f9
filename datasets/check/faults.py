"""Faults in the motion of one clip: feet off the floor, jumps, flips, jitter, swapped sides, nobody at all.

Every bound is far from what people do: each stands beside the most that was measured on recorded clips
(docs/data.md has the shares of false alarms and of planted faults that are found). What is said of feet is
said of frames in which the trunk is upright and a ball of the foot rests: somebody who lies has no feet on
the floor, and a foot in the air points anywhere.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.canonical import facing, ground, runs
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.datasets.motion.plausibility import PERSON_METRES, UPRIGHT, measure
from motionloom.datasets.motion.skeleton import Skeleton

_NAMED = Skeleton.named("smpl22")
_PELVIS, _HEAD = _NAMED.index("pelvis"), _NAMED.index("head")
_BALLS, _ANKLES, _HIPS, _SHOULDERS = (
    [_NAMED.index(f"{side}_{joint}") for side in ("left", "right")]
    for joint in ("foot", "ankle", "hip", "shoulder")
)

RESTS = 0.3
"""Metres a second below which a foot rests."""
OFF_FLOOR = 0.08
"""Metres that a resting foot is from the floor, or anything below a resting foot: 0.03 at most of people who
walk, wave and kick; dancers on their toes were recorded 0.12 m below."""
LEAST_RESTING = 0.1
"""Seconds that feet must rest to say anything of them."""
LEAP, LEAP_ACCELERATION = 0.02, 30.0
"""Metres that half of the joints go further in a frame than two frames before and after: so much from rest,
and what 3 g, a hard landing, do in a frame; of 0.095 at 20 frames a second 0.07 was recorded at most."""
TREMOR, TREMOR_SPEED = 0.003, 320.0
"""Metres of noise, as a standard deviation, of the median joint seen from the pelvis: so much at any frame
rate, and what fast limbs add to its estimate at a low one (metres a second⁴)."""
LIMB_SNAP, LIMB_FLIP, LONGEST_FLIP = 1.2, 0.5, 10
"""Change of a bone's direction (2 is opposite) in one frame beyond those beside it: at most, and where it is
taken back within ten frames. Quick kicks reach 0.47."""
FROZEN, STILL = 0.5, 1e-4
"""Seconds without a change, and metres a frame below which nothing changes: people move by 7e-4 at least."""
FLIP = 2.0
"""Radians that a figure turns in one frame; dancers and kickers reach 0.6 at 20 frames a second."""
OPPOSITE = -0.5
"""Cosine of hips and shoulders, seen from above: nobody is twisted by more than 120 degrees."""
_BONES = [
    (_NAMED.index(f"{side}_{first}"), _NAMED.index(f"{side}_{last}"))
    for side in ("left", "right")
    for chain in (("hip", "knee", "ankle", "foot"), ("shoulder", "elbow", "wrist"))
    for first, last in pairwise(chain)
]
STRETCH = 0.3
"""Share by which a bone's length differs from its median; of recorded people at most 0.1."""


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong with a clip."""

    kind: str
    text: str
    """The measured value and its bound, in one phrase."""
    weight: float
    """The measure over its bound: above 1."""
    frame: int = 0
    """The frame that shows it best."""


def motion_faults(joints: NDArray[np.floating], fps: float) -> Iterator[Fault]:
    """The faults of joints [T, N >= 22, 3]: metres, Y up, the floor at 0."""
    body = np.asarray(joints[:, :BODY_JOINTS], dtype=np.float64)
    figure, (small, tall) = measure(joints, fps), PERSON_METRES
    if not small <= figure.height <= tall:
        ratio = max(small / max(figure.height, 1e-3), figure.height / tall)
        text = f"{figure.height:.2f} m tall, not {small:g} to {tall:g} m"
        yield Fault("no person", text, ratio)
    if figure.up[1] < -UPRIGHT:
        yield Fault("no person", "the head is below the pelvis", -figure.up[1] / UPRIGHT)
    if len(body) < 6:
        return
    yield from _bones(body)
    yield from _feet(body, fps)
    yield from _sides(body)
    yield from _smoothness(body, fps)
    yield from _limbs(body)
    yield from _still(body, fps)


def _bones(body: NDArray[np.float64]) -> Iterator[Fault]:
    lengths = np.linalg.norm(body[:, 1:] - body[:, list(_NAMED.parents[1:])], axis=-1)
    usual = np.median(lengths, axis=0)
    off = np.abs(lengths - usual) / np.maximum(usual, 0.1)  # some skeletons have bones without any length
    frame, bone = np.unravel_index(int(off.argmax()), off.shape)
    if off[frame, bone] > STRETCH:
        name = _NAMED.joints[int(bone) + 1].replace("_", " ")
        share = float(off[frame, bone])
        text = f"the bone to the {name} changes its length by {share:.0%}, not at most {STRETCH:.0%}"
        yield Fault("no person", text, share / STRETCH, int(frame))


def _feet(body: NDArray[np.float64], fps: float) -> Iterator[Fault]:
    trunk, balls = body[:, _HEAD] - body[:, _PELVIS], body[:, _BALLS]
    upright = trunk[:, 1] > UPRIGHT * np.linalg.norm(trunk, axis=-1)
    speed = np.linalg.norm(np.gradient(balls, axis=0), axis=-1) * fps
    lower = balls[..., 1] <= balls[..., 1].min(axis=-1, keepdims=True)  # the other may be held in the air
    rests = (speed < RESTS) & lower & upright[:, None]
    if rests.sum() < LEAST_RESTING * fps:
        return
    level = float(np.median(balls[..., 1][rests]))
    first = int(rests.any(axis=1).argmax())
    bottom = body[..., 1].min(axis=-1)
    lowest = np.where(upright, bottom, np.inf)
    under = level - float(lowest.min())
    # Who lies on the floor sinks a little lower than the balls of the feet stand, and that is its height 0.
    lies = bool((bottom[~upright] < OFF_FLOOR / 2).any())
    if under > OFF_FLOOR:  # then the floor of a clip that was moved to 0 is wrong too
        text = f"goes {under:.2f} m below where its feet rest, not at most {OFF_FLOOR:g} m"
        yield Fault("sinks", text, under / OFF_FLOOR, int(lowest.argmin()))
    elif level < -OFF_FLOOR or (level > OFF_FLOOR and not lies):
        kind, side = ("floats", "above") if level > 0 else ("sinks", "below")
        text = f"feet rest {abs(level):.2f} m {side} the floor, not at most {OFF_FLOOR:g} m"
        yield Fault(kind, text, abs(level) / OFF_FLOOR, first)
    toes = ground(balls - body[:, _ANKLES]) * np.exp(-1j * facing(body))[:, None]
    forward = float(np.median((toes.real / np.maximum(np.abs(toes), 1e-9))[rests]))
    if forward < 0:
        yield Fault("swapped sides", "resting feet point backwards", 1 - forward, first)


def _sides(body: NDArray[np.float64]) -> Iterator[Fault]:
    turns = np.abs(np.diff(facing(body)))
    if turns.max() > FLIP:
        text = f"turns by {turns.max():.1f} rad in one frame, not at most {FLIP:g}"
        yield Fault("swapped sides", text, float(turns.max()) / FLIP, int(turns.argmax()))
    hips, shoulders = (ground(body[:, pair[0]] - body[:, pair[1]]) for pair in (_HIPS, _SHOULDERS))
    size = np.abs(hips) * np.abs(shoulders)
    # Seen from above, somebody who lies on a side has neither.
    alike = np.where(size > 0.01, (hips * shoulders.conj()).real / np.maximum(size, 1e-9), 1.0)
    if alike.min() < OPPOSITE:
        text = "hips and shoulders face opposite ways"
        yield Fault("swapped sides", text, 1 - float(alike.min()), int(alike.argmin()))


def _smoothness(body: NDArray[np.float64], fps: float) -> Iterator[Fault]:
    steps = np.median(np.linalg.norm(np.diff(body, axis=0), axis=-1), axis=1)
    around = np.pad(steps, 2, mode="edge")
    leaps = steps - np.maximum(around[:-4], around[4:])
    most = LEAP + LEAP_ACCELERATION / fps**2
    if leaps.max() > most:
        text = f"half of the body leaps {leaps.max():.2f} m in one frame, not at most {most:.2f} m"
        yield Fault("jumps", text, float(leaps.max()) / most, int(leaps.argmax()))
    # Fourth differences leave nothing of a cubic; of white noise √70 times its deviation.
    rough = np.abs(np.diff(body - body[:, :1], 4, axis=0))[:, 1:]
    noise, most = float(np.median(rough)) / (0.6745 * np.sqrt(70)), TREMOR + TREMOR_SPEED / fps**4
    if noise > most:
        text = f"trembles by {1000 * noise:.1f} mm, not at most {1000 * most:.1f} mm"
        yield Fault("jitters", text, noise / most, int(rough.mean(axis=(1, 2)).argmax()))


def _limbs(body: NDArray[np.float64]) -> Iterator[Fault]:
    """A limb that turns at once, and most often back at once: what a solver does, and no muscle."""
    first, last = zip(*_BONES, strict=True)
    bones = body[:, last] - body[:, first]
    ways = np.diff(bones / np.maximum(np.linalg.norm(bones, axis=-1, keepdims=True), 1e-6), axis=0)
    turns = np.linalg.norm(ways, axis=-1)
    around = np.pad(turns, ((1, 1), (0, 0)), mode="edge")
    before, after = turns - around[:-2], turns - around[2:]
    alone = np.minimum(before, after)
    leaps = [alone * (LIMB_FLIP / LIMB_SNAP)]
    for frames in range(1, min(LONGEST_FLIP, len(turns) - 1) + 1):
        # Of a flip of one frame, there and back stand beside each other.
        there, back = (before, after) if frames == 1 else (alone, alone)
        opposite = (ways[:-frames] * ways[frames:]).sum(axis=-1) < 0
        leaps.append(np.where(opposite, np.minimum(there[:-frames], back[frames:]), 0.0))
    leap = max(leaps, key=np.max)
    frame, bone = np.unravel_index(int(leap.argmax()), leap.shape)
    if leap[frame, bone] > LIMB_FLIP:
        name = _NAMED.joints[last[bone]].replace("_", " ")
        angle = np.degrees(2 * np.arcsin(min(1.0, float(turns[frame, bone]) / 2)))
        text = f"the bone to the {name} turns by {angle:.0f}° in one frame"
        yield Fault("flips", text, float(leap[frame, bone]) / LIMB_FLIP, int(frame) + 1)


def _still(body: NDArray[np.float64], fps: float) -> Iterator[Fault]:
    moves = np.abs(np.diff(body, axis=0)).max(axis=(1, 2))
    start, end = max(runs(moves < STILL), key=lambda run: run[1] - run[0], default=(0, 0))
    if (end - start) / fps >= FROZEN and moves.max() >= STILL:
        seconds = (end - start) / fps
        text = f"nothing moves for {seconds:.1f} s, not under {FROZEN:g} s"
        yield Fault("frozen", text, seconds / FROZEN + 1e-3, start)
