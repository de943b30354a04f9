"""The judge of motion: what is wrong with one clip, its figure, its joints or its time.

A conversion judges each clip at the source's frame rate and stores the verdict with it, which plan, check,
clean and report read. Every bound is far from what people do: each stands beside the most that was measured
on recorded clips (docs/data.md has the shares of false alarms and of planted faults that are found). What is
said of feet is said of frames in which the trunk is upright and a ball of the foot rests: somebody who lies
has no feet on the floor, and a foot in the air points anywhere.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.records import Fault
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
OFF_FLOOR = 0.1
"""Metres that a resting foot is from the floor, or anything below a resting foot: 0.03 at most of people who
walk and wave, 0.09 of who kicks; dancers on their toes were recorded 0.12 m below."""
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
_SIDES = [
    (_NAMED.index(f"left_{joint}"), _NAMED.index(f"right_{joint}"))
    for joint in ("knee", "ankle", "elbow", "wrist")
]
UNLIKE, _SHORT = 1.15, 0.1
"""Ratio of a left bone of a limb and the right one, at most (1.06 was recorded), and metres from which it is
looked at."""
STRAIGHT = 0.8
"""Cosine between trunk and legs, and length of the mean way of the trunk, of a figure that stands."""
STANDS, ALONG, STEADY = 0.2, 0.7, (0.2, 0.5)
"""Share of the frames in which a trunk lies along a level axis, by that cosine, from which the lowest joint
along it is looked at; a floor is there if that one keeps its place within so many heights and so much of what
the lowest joint along y does: recorded people keep it worse than along y."""
_HINGES = {
    f"{side}_{joint}": tuple(_NAMED.index(f"{side}_{name}") for name in (first, joint, last))
    for side in ("left", "right")
    for first, joint, last in (("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist"))
}
STUCK = 5e-4
"""Radians that the angle of a knee or elbow changes over a clip, at least: 0.006 was recorded."""
ROOTED, WALKS = 0.001, 0.02
"""Metres that a pelvis moves over a clip in which an ankle moves by the second, seen from it, at least: 0.007
was recorded."""
SWING, STEP, STEPS = (0.36, 0.75), 0.3, 4
"""Seconds for which a foot swings forward, of so many steps of that share of the height at least, over the
fourth root of the step in heights: at most in the slowest quarter of a clip's steps, at least in the quickest
one. Who climbs or turns on a toe has some odd steps; 0.37 and 0.71 were recorded."""
FALL, FALLS = 1.6, 0.06
"""How much faster than a stone nobody falls, and the metres of a fall that are looked at."""
REPEATS, _MOVING = 0.02, 10
"""Share of the frames that repeat the one before, in the midst of motion that is so many times `STILL`."""
GLIDES, LOW, LOW_SECONDS = 0.35, 0.03, 0.5
"""Metres a second at which the lower foot goes in half of the frames, of so many seconds, in which it is that
near to its floor: 0.3 was recorded, of who lies down."""
STRETCH = 0.3
"""Share by which a bone's length differs from its median; of recorded people at most 0.1."""


def judge(joints: NDArray[np.floating], fps: float, *, small: float = PERSON_METRES[0]) -> Iterator[Fault]:
    """The faults of joints [T, N >= 22, 3]: metres, Y up, the floor at 0; figures may be `small` metres."""
    body = np.asarray(joints[:, :BODY_JOINTS], dtype=np.float64)
    figure = measure(joints, fps)
    tall = PERSON_METRES[1]
    if not small <= figure.height <= tall:
        ratio = max(small / max(figure.height, 1e-3), figure.height / tall)
        text = f"{figure.height:.2f} m tall, not {small:g} to {tall:g} m"
        yield _fault("no person", text, ratio)
    if figure.up[1] < -UPRIGHT:
        yield _fault("no person", "the head is below the pelvis", -figure.up[1] / UPRIGHT)
    if len(body) < 6:
        return
    yield from _bones(body)
    yield from _axis(body, figure.height)
    yield from _feet(body, fps)
    yield from _sides(body)
    yield from _smoothness(body, fps)
    yield from _limbs(body)
    yield from _still(body, fps)
    yield from _stuck(body)
    yield from _time(body, fps, figure.height)


def on_floor(joints: NDArray[np.floating]) -> NDArray[np.float64]:
    """Joints [T, N, 3] with the lowest of them at height 0."""
    return np.asarray(joints, dtype=np.float64) - [0.0, float(joints[..., 1].min()), 0.0]


def _fault(kind: str, text: str, weight: float, frame: int = 0) -> Fault:
    return Fault(kind=kind, text=text, weight=float(weight), frame=int(frame))


def _bones(body: NDArray[np.float64]) -> Iterator[Fault]:
    lengths = np.linalg.norm(body[:, 1:] - body[:, list(_NAMED.parents[1:])], axis=-1)
    usual = np.median(lengths, axis=0)
    off = np.abs(lengths - usual) / np.maximum(usual, 0.1)  # some skeletons have bones without any length
    frame, bone = np.unravel_index(int(off.argmax()), off.shape)
    if off[frame, bone] > STRETCH:
        name = _NAMED.joints[int(bone) + 1].replace("_", " ")
        share = float(off[frame, bone])
        text = f"the bone to the {name} changes its length by {share:.0%}, not at most {STRETCH:.0%}"
        yield _fault("no person", text, share / STRETCH, int(frame))
    for left, right in _SIDES:
        ratio = float(usual[left - 1] / max(usual[right - 1], 1e-6))
        if usual[left - 1] > _SHORT and not 1 / UNLIKE < ratio < UNLIKE:
            name = _NAMED.joints[left].removeprefix("left_")
            text = (
                f"the left bone to the {name} is {ratio:.2f} times the right one, not 1/{UNLIKE} to {UNLIKE}"
            )
            yield _fault("uneven limbs", text, max(ratio, 1 / max(ratio, 1e-6)) / UNLIKE)


def _axis(body: NDArray[np.float64], height: float) -> Iterator[Fault]:
    """A figure that stands along the ground: trunk and legs in one line, for good, and never upright; or on a
    floor that is a wall.
    """
    trunk = body[:, _HEAD] - body[:, _PELVIS]
    trunk /= np.maximum(np.linalg.norm(trunk, axis=-1, keepdims=True), 1e-9)
    legs = body[:, _HIPS].mean(axis=1) - body[:, _ANKLES].mean(axis=1)
    legs /= np.maximum(np.linalg.norm(legs, axis=-1, keepdims=True), 1e-9)
    way = np.median(trunk, axis=0)
    straight = float(np.median((trunk * legs).sum(axis=-1)))
    level = float(np.percentile(np.abs(trunk[:, 1]), 90))
    axis = 0 if abs(way[0]) > abs(way[2]) else 2
    sign = np.sign(way[axis])
    lies = float((sign * trunk[:, axis] > ALONG).mean())
    lowest = (body * [sign, 1, sign]).min(axis=1)
    moves = np.ptp(np.percentile(lowest, [5, 95], axis=0), axis=0)
    has_floor = lies > STANDS and moves[axis] < min(STEADY[0] * height, STEADY[1] * moves[1])
    if has_floor or (level < UPRIGHT and np.linalg.norm(way) > STRAIGHT and straight > STRAIGHT):
        text = f"stands along {'xyz'[axis]}, not up"
        yield _fault("stands along the ground", text, 1 + lies)


def _feet(body: NDArray[np.float64], fps: float) -> Iterator[Fault]:
    trunk = body[:, _HEAD] - body[:, _PELVIS]
    balls = body[:, _BALLS]
    upright = trunk[:, 1] > UPRIGHT * np.linalg.norm(trunk, axis=-1)
    speed = np.linalg.norm(np.gradient(balls, axis=0), axis=-1) * fps
    lower = balls[..., 1] <= balls[..., 1].min(axis=-1, keepdims=True)  # the other may be held in the air
    flat = np.linalg.norm(np.gradient(balls[..., [0, 2]], axis=0), axis=-1) * fps
    near = (balls[..., 1] < np.percentile(balls[..., 1].min(axis=1), 20) + LOW) & lower & upright[:, None]
    glide = float(np.median(flat[near])) if near.sum() > LOW_SECONDS * fps else 0.0
    if glide > GLIDES:
        text = f"the lower foot glides at {glide:.2f} m/s along the floor, not at most {GLIDES:g} m/s"
        yield _fault("slides", text, glide / GLIDES, int(near.any(axis=1).argmax()))
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
    # Ground of several levels: feet rest on more than one, and nothing has brought them there at once.
    falls = np.abs(np.diff(np.median(body[..., 1], axis=1))).max()
    steps = np.ptp(np.percentile(balls[..., 1][rests], [5, 95]))
    deep = float(balls[..., 1][rests].min()) < float(lowest.min()) + OFF_FLOOR
    uneven = under > OFF_FLOOR and (deep or steps > OFF_FLOOR) and falls < OFF_FLOOR / 2
    if under > OFF_FLOOR and not uneven:  # then the floor of a clip that was moved to 0 is wrong too
        text = f"goes {under:.2f} m below where its feet rest, not at most {OFF_FLOOR:g} m"
        yield _fault("sinks", text, under / OFF_FLOOR, int(lowest.argmin()))
    elif not uneven and (level < -OFF_FLOOR or (level > OFF_FLOOR and not lies)):
        kind, side = ("floats", "above") if level > 0 else ("sinks", "below")
        text = f"feet rest {abs(level):.2f} m {side} the floor, not at most {OFF_FLOOR:g} m"
        yield _fault(kind, text, abs(level) / OFF_FLOOR, first)
    toes = ground(balls - body[:, _ANKLES]) * np.exp(-1j * facing(body))[:, None]
    forward = float(np.median((toes.real / np.maximum(np.abs(toes), 1e-9))[rests]))
    if forward < 0:
        yield _fault("swapped sides", "resting feet point backwards", 1 - forward, first)


def _sides(body: NDArray[np.float64]) -> Iterator[Fault]:
    turns = np.abs(np.diff(facing(body)))
    if turns.max() > FLIP:
        text = f"turns by {turns.max():.1f} rad in one frame, not at most {FLIP:g}"
        yield _fault("swapped sides", text, float(turns.max()) / FLIP, int(turns.argmax()))
    hips, shoulders = (ground(body[:, pair[0]] - body[:, pair[1]]) for pair in (_HIPS, _SHOULDERS))
    size = np.abs(hips) * np.abs(shoulders)
    # Seen from above, somebody who lies on a side has neither.
    alike = np.where(size > 0.01, (hips * shoulders.conj()).real / np.maximum(size, 1e-9), 1.0)
    if alike.min() < OPPOSITE:
        text = "hips and shoulders face opposite ways"
        yield _fault("swapped sides", text, 1 - float(alike.min()), int(alike.argmin()))


def _smoothness(body: NDArray[np.float64], fps: float) -> Iterator[Fault]:
    steps = np.median(np.linalg.norm(np.diff(body, axis=0), axis=-1), axis=1)
    around = np.pad(steps, 2, mode="edge")
    leaps = steps - np.maximum(around[:-4], around[4:])
    most = LEAP + LEAP_ACCELERATION / fps**2
    if leaps.max() > most:
        text = f"half of the body leaps {leaps.max():.2f} m in one frame, not at most {most:.2f} m"
        yield _fault("jumps", text, float(leaps.max()) / most, int(leaps.argmax()))
    # Fourth differences leave nothing of a cubic; of white noise √70 times its deviation.
    rough = np.abs(np.diff(body - body[:, :1], 4, axis=0))[:, 1:]
    noise = float(np.median(rough)) / (0.6745 * np.sqrt(70))
    most = TREMOR + TREMOR_SPEED / fps**4
    if noise > most:
        text = f"trembles by {1000 * noise:.1f} mm, not at most {1000 * most:.1f} mm"
        yield _fault("jitters", text, noise / most, int(rough.mean(axis=(1, 2)).argmax()))


def _limbs(body: NDArray[np.float64]) -> Iterator[Fault]:
    """A limb that turns at once, and most often back at once: what a solver does, and no muscle."""
    first, last = zip(*_BONES, strict=True)
    bones = body[:, last] - body[:, first]
    ways = np.diff(bones / np.maximum(np.linalg.norm(bones, axis=-1, keepdims=True), 1e-6), axis=0)
    turns = np.linalg.norm(ways, axis=-1)
    around = np.pad(turns, ((1, 1), (0, 0)), mode="edge")
    before = turns - around[:-2]
    after = turns - around[2:]
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
        yield _fault("flips", text, float(leap[frame, bone]) / LIMB_FLIP, int(frame) + 1)


def _still(body: NDArray[np.float64], fps: float) -> Iterator[Fault]:
    moves = np.abs(np.diff(body, axis=0)).max(axis=(1, 2))
    start, end = max(runs(moves < STILL), key=lambda run: run[1] - run[0], default=(0, 0))
    if (end - start) / fps >= FROZEN and moves.max() >= STILL:
        seconds = (end - start) / fps
        text = f"nothing moves for {seconds:.1f} s, not under {FROZEN:g} s"
        yield _fault("frozen", text, seconds / FROZEN + 1e-3, start)


_GRAVITY = 9.81
_USUAL = 0.54
_FINE_FPS = 24
"""Steps of fewer frames a second are counted coarsely: none are too quick, a frame more is not too slow."""


def _swings(body: NDArray[np.float64], fps: float, height: float) -> list[float]:
    """The seconds of each step, as `SWING` counts them: at any pace they are nearly the same."""
    times = []
    for ankle in _ANKLES:
        places = body[:, ankle][:, [0, 2]] / height
        speed = np.linalg.norm(np.gradient(places, axis=0), axis=-1)
        for start, end in runs(speed > 0.25 * np.percentile(speed, 95)):
            if start > 0 and end < len(body):
                step = float(np.linalg.norm(places[end] - places[start - 1]))
                times += [(end - start) / fps / step**0.25] if step > STEP else []
    return times


def _falls(body: NDArray[np.float64], fps: float) -> Iterator[tuple[int, int, float]]:
    """Frames of both feet in the air, and how fast the body falls in them (metres a second²)."""
    balls = body[:, [*_BALLS, *_ANKLES], 1].min(axis=1)
    heights = body[..., 1].mean(axis=1)
    for start, end in runs(balls > np.percentile(balls, 10) + FALLS):
        if end - start > 4 and start > 0 and end < len(body):
            times = np.arange(end - start) / fps
            fit = np.polyfit(times, heights[start:end], 2)
            rest = np.abs(np.polyval(fit, times) - heights[start:end]).max()
            rise = heights[start:end].max() - max(heights[start], heights[end - 1])
            if rise > FALLS / 2 and rest < FALLS / 4:
                yield start, end, -2 * float(fit[0])


def _stuck(body: NDArray[np.float64]) -> Iterator[Fault]:
    """Joints that never move although what they hang on does: channels that were not written."""
    for name, (first, joint, last) in _HINGES.items():
        above = body[:, joint] - body[:, first]
        below = body[:, last] - body[:, joint]
        sizes = np.linalg.norm(above, axis=-1) * np.linalg.norm(below, axis=-1)
        bend = float(
            np.ptp(np.arccos(np.clip((above * below).sum(axis=-1) / np.maximum(sizes, 1e-9), -1, 1)))
        )
        if bend < STUCK:
            text = f"the {name.replace('_', ' ')} keeps its angle within {bend:.4f} rad, under {STUCK:g}"
            yield _fault("stuck", text, STUCK / max(bend, STUCK / 10))
    moves = float(np.ptp(body[:, _PELVIS], axis=0).max())
    swings = float(np.ptp(body[:, _ANKLES] - body[:, :1], axis=0).max())
    if moves < ROOTED and swings > WALKS:
        text = f"the pelvis stays in its place while an ankle moves by {swings:.2f} m"
        yield _fault("stuck", text, ROOTED / max(moves, ROOTED / 10))


def _time(body: NDArray[np.float64], fps: float, height: float) -> Iterator[Fault]:
    """Repeated frames, and a frame rate at which people would step or fall as nobody does."""
    moves = np.abs(np.diff(body, axis=0)).max(axis=(1, 2))
    around = np.minimum(moves[:-2], moves[2:])
    again = np.flatnonzero((moves[1:-1] < STILL) & (around > _MOVING * STILL))
    if len(again) > max(REPEATS * len(body), 2):
        text = f"{len(again)} of {len(body)} frames repeat the one before in the midst of motion"
        yield _fault("repeated frames", text, len(again) / max(REPEATS * len(body), 2), int(again[0]) + 2)
    times = _swings(body, fps, height)
    quick, slow = np.percentile(times, [25, 75]) if len(times) >= STEPS else (_USUAL, _USUAL)
    is_fine = fps >= _FINE_FPS
    if (is_fine and slow < SWING[0]) or quick > SWING[1] + (0.0 if is_fine else 1 / fps):
        factor = float(np.median(times)) / _USUAL
        text = f"steps take {factor:.1f} times as long as people's: is the frame rate right?"
        yield _fault("frame rate", text, max(factor, 1 / factor))
    for start, end, pull in _falls(body, fps):
        if pull > FALL * _GRAVITY:
            text = f"falls {pull / _GRAVITY:.1f} times as fast as a stone: is the frame rate right?"
            yield _fault("frame rate", text, pull / (FALL * _GRAVITY), (start + end) // 2)
            break
