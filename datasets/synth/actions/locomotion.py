"""Walking, circling, turning and running, from footsteps.

A plan of where and when each foot lands becomes feet, root, sway and arm swing. The ball of a foot is exactly
still between landing and lift-off, the heel rolls over it, and the root follows the middle of the two feet,
so legs reach what they stand on and planted feet cannot slide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from motionloom.datasets.actions.signals import STAND
from motionloom.datasets.synth.actions.maths import Array, ease, keys, rot_y, smooth
from motionloom.datasets.synth.actions.pose import BALL, Track
from motionloom.datasets.synth.actions.truth import Span, Truth

WALK_SPEED = {"slowly": (0.5, 0.68), None: (0.95, 1.25), "quickly": (1.6, 1.85)}
BACK_SPEED = {"slowly": (0.34, 0.46), None: (0.68, 0.85), "quickly": (1.12, 1.3)}


def walk(truth: Truth, span: Span, fps: float, rng: np.random.Generator) -> Track:
    """Walk straight forward or backward, or around a circle."""
    backward = truth.direction == "backward"
    low, high = (BACK_SPEED if backward else WALK_SPEED)[truth.speed]
    speed = rng.uniform(low, high)
    if truth.direction in ("clockwise", "counterclockwise"):
        # A whole circle in the time there is: a slow walker takes a small one.
        speed *= 0.92
        seconds = span.pick(rng, at_least=min(5.0, span.high))
        return _walk(rng, fps, seconds, speed, _circle(truth, rng), backward=False)
    return _walk(rng, fps, span.pick(rng), speed, 0.0, backward=backward, stands=span.returns)


def _circle(truth: Truth, rng: np.random.Generator) -> float:
    """Radians of a walk or a run around a circle, positive to the left."""
    return rng.uniform(1.5, 1.95) * np.pi * (-1 if truth.direction == "clockwise" else 1)


def turn(truth: Truth, span: Span, fps: float, rng: np.random.Generator) -> Track:
    """Turn left or right on the spot, or while walking."""
    sign = 1 if truth.direction == "left" else -1
    if truth.style == "walking":
        angle = sign * rng.uniform(1.1, 1.9)
        speed = rng.uniform(0.85, 1.2)
        return _walk(rng, fps, span.pick(rng, at_least=min(3.0, span.high)), speed, angle, corner=True)
    angle = sign * (np.pi if truth.style == "around" else np.pi / 2) * rng.uniform(0.94, 1.06)
    seconds = span.pick(rng)
    count = max(2, round(abs(angle) / rng.uniform(0.5, 0.75)))
    stride = Stride(
        step_seconds=min(rng.uniform(0.42, 0.6), (seconds - 0.5) / (count + 1.2)),
        swing_share=0.8,
        height=rng.uniform(0.03, 0.06),
        off=0.35,
        land=-0.05,
        arm_swing=0.12,
        sway=0.03,
        toe_out=0.1,
    )
    track = Track.standing(seconds, fps, rng, width=0.0)
    stations = [(0.0, 0.0, angle * k / count) for k in range(count + 1)]
    begin = rng.uniform(0.2, max(0.25, seconds - 0.3 - (count + 1) * stride.step_seconds))
    steps = stations_to_steps(stations, 0 if sign > 0 else 1, begin, stride)
    lead = apply_steps(track, steps, stride, 0.1)
    moving = ease((track.t - begin) / 0.4) * ease((steps[-1].end - track.t) / 0.4)
    swing_body(track, lead, stride, moving, amount=0.6)
    # Head and shoulders look where the turn goes, a little ahead of the hips.
    ahead = np.gradient(smooth(track.yaw, 0.15, fps), 1 / fps) * moving
    track.head[:, 1] += np.clip(0.22 * ahead, -0.5, 0.5)
    track.spine[:, 1] += np.clip(0.1 * ahead, -0.25, 0.25)
    stand_height(track, stride, steps)
    return track


def run(truth: Truth, span: Span, fps: float, rng: np.random.Generator) -> Track:
    """Run straight ahead or around a circle, each step with a flight."""
    circles = truth.direction in ("clockwise", "counterclockwise")
    seconds = span.pick(rng, at_least=min(5.0, span.high) if circles else 0.0)
    speed = rng.uniform(2.3, 3.1)
    step = rng.uniform(0.33, 0.37)
    stride = Stride(
        step_seconds=step,
        swing_share=1.45,
        height=rng.uniform(0.2, 0.3),
        off=1.15,
        land=-0.1,
        arm_swing=rng.uniform(0.55, 0.75),
        elbow=rng.uniform(0.68, 0.76),
        lean=rng.uniform(0.14, 0.26),
        sway=0.01,
        bounce=rng.uniform(0.035, 0.05),
        toe_out=0.06,
        width=-0.04,
    )
    angle = _circle(truth, rng) if circles else 0.0
    return _along(rng, fps, seconds, stride, speed, angle, lead_in=0.0, corner=False)


def _walk(
    rng: np.random.Generator,
    fps: float,
    seconds: float,
    speed: float,
    angle: float,
    backward: bool = False,
    corner: bool = False,
    stands: bool = False,
) -> Track:
    pace = abs(speed) * (1.35 if backward else 1.0)
    stride = Stride(
        step_seconds=float(np.clip(0.6 - 0.13 * (pace - 1.0) - 0.12 * max(pace - 1.2, 0), 0.36, 0.72))
        * rng.uniform(0.94, 1.06)
        * (0.85 if abs(angle) > 4 else 1.0),
        swing_share=0.78,
        height=rng.uniform(0.02, 0.045),
        off=0.25 if backward else rng.uniform(0.6, 0.85),
        land=0.3 if backward else rng.uniform(-0.35, -0.2),
        arm_swing=rng.uniform(0.22, 0.6) * min(1.25, 0.5 + 0.5 * pace),
        elbow=rng.uniform(0.93, 0.965),
        lean=rng.uniform(0.0, 0.06) + 0.03 * (pace - 1.0),
        sway=rng.uniform(0.012, 0.025),
        toe_out=rng.uniform(0.03, 0.16),
        width=rng.uniform(-0.04, 0.0),
    )
    lead_in = rng.uniform(0.15, 0.45) if angle or rng.random() < 0.5 or stands else 0.0
    return _along(rng, fps, seconds, stride, -speed if backward else speed, angle, lead_in, corner)


def _along(
    rng: np.random.Generator,
    fps: float,
    seconds: float,
    stride: Stride,
    speed: float,
    angle: float,
    lead_in: float,
    corner: bool,
) -> Track:
    """Steps along an arc of `angle`; without a lead-in the clip starts and ends within full stride."""
    warm = 0.0 if lead_in else 2.6 * stride.step_seconds
    total = seconds + 2 * warm
    angle *= total / seconds  # what is cut off turns as well
    begin = lead_in if lead_in else 0.0
    count = max(3, int((total - begin - 0.2) / stride.step_seconds) - 1)
    # The middle of the feet cuts the corners of the stations: longer steps keep the speed on an arc.
    bend = abs(angle) / count
    length = speed * stride.step_seconds / (np.cos(0.5 * bend) * np.exp(-0.09 * bend**2))
    share = np.arange(count + 1) / count
    if corner:
        share = ease((share - 0.25) / 0.5)
    yaws = angle * share
    middle = 0.5 * (yaws[1:] + yaws[:-1])
    x = np.concatenate([[0.0], np.cumsum(np.sin(middle) * length)])
    z = np.concatenate([[0.0], np.cumsum(np.cos(middle) * length)])
    stations = list(zip(x.tolist(), z.tolist(), yaws.tolist(), strict=True))
    track = Track.standing(total, fps, rng, width=stride.width)
    first = int(rng.integers(2)) if not angle else (0 if angle > 0 else 1)
    steps = stations_to_steps(stations, first, begin, stride)
    lead = apply_steps(track, steps, stride, stride.toe_out)
    moving = ease((track.t - begin) / 0.5) * ease((steps[-1].end - track.t) / 0.5)
    swing_body(track, lead, stride, moving)
    rate = np.gradient(smooth(track.yaw, 0.2, fps), 1 / fps)
    track.head[:, 1] += np.clip(0.15 * rate, -0.4, 0.4)
    track.pelvis[:, 2] += np.clip(-0.04 * rate * abs(speed), -0.1, 0.1)
    stand_height(track, stride, steps)
    if not warm:
        return track
    return track.cut(round(warm * fps), max(8, round(seconds * fps)))


@dataclass(frozen=True)
class Step:
    """One step: which foot, when it swings (seconds), where its ball lands (x, z), where it points."""

    foot: int
    start: float
    end: float
    xz: tuple[float, float]
    yaw: float
    height: float
    off: float
    """Heel-up angle at toe-off, radians."""
    land: float
    """Foot pitch at landing; negative is heel first."""


@dataclass(frozen=True)
class Stride:
    """Parameters of a gait."""

    step_seconds: float
    swing_share: float = 0.8
    """Swing time over step time; below 1 both feet share the floor (walk), above 1 both leave it (run)."""
    height: float = 0.04
    off: float = 0.75
    land: float = -0.3
    arm_swing: float = 0.45
    elbow: float = 0.965
    lean: float = 0.03
    sway: float = 0.02
    bounce: float = 0.0
    toe_out: float = 0.1
    width: float = 0.0


def stations_to_steps(
    stations: Sequence[tuple[float, float, float]], first: int, begin: float, stride: Stride
) -> list[Step]:
    """Steps along stations (x, z, yaw), one foot each in turn, and a last step that closes the feet."""
    steps = []
    order = [*stations[1:], stations[-1]]
    swing = stride.step_seconds * stride.swing_share
    for k, (x, z, yaw) in enumerate(order):
        foot = (first + k) % 2
        ball = ball_at(x, z, yaw, foot, stride.width)
        start = begin + k * stride.step_seconds
        closing = k >= len(order) - 1
        land = -0.05 if closing else stride.land
        off = stride.off * (0.6 if k == 0 or closing else 1.0)
        toe = stride.toe_out * (1 if foot == 0 else -1)
        steps.append(Step(foot, start, start + swing, ball, yaw + toe, stride.height, off, land))
    return steps


def ball_at(x: float, z: float, yaw: float, foot: int, width: float = 0.0) -> tuple[float, float]:
    """The ball of one foot of somebody who stands at (x, z) and faces `yaw`."""
    side = (BALL[0] + width) * (1 if foot == 0 else -1)
    return (
        float(x + np.cos(yaw) * side + np.sin(yaw) * BALL[1]),
        float(z - np.sin(yaw) * side + np.cos(yaw) * BALL[1]),
    )


def apply_steps(track: Track, steps: Sequence[Step], stride: Stride, toe_out: float) -> Array:
    """Write feet, root and heading of a step plan into a track that stands; returns the leg swing [T].

    The swing is the left foot's lead over the right along the heading, in units of one step length.
    """
    t = track.t
    fps = track.fps
    lift = np.zeros((2, len(t)))
    for foot in (0, 1):
        mine = [s for s in steps if s.foot == foot]
        start_xz = ball_at(0.0, 0.0, 0.0, foot, stride.width)
        start_yaw = toe_out if foot == 0 else -toe_out
        xz = np.tile(start_xz, (len(t), 1))
        yaw = np.full(len(t), start_yaw)
        before = np.asarray(start_xz)
        before_yaw = start_yaw
        times = [-1e3]
        values = [0.0]
        for step in mine:
            span = step.end - step.start
            # Gentler than `ease`, so that the foot lags less behind a fast body.
            s = np.clip((t - step.start) / span, 0.0, 1.0)
            s = s * s * (3.0 - 2.0 * s)
            xz += s[:, None] * (np.asarray(step.xz) - before)
            yaw += s * (step.yaw - before_yaw)
            before = np.asarray(step.xz)
            before_yaw = step.yaw
            phase = np.clip((t - step.start) / span, 0.0, 1.0)
            lift[foot] += step.height * np.sin(np.pi * phase**0.85) ** 1.5
            roll = min(0.22, 0.45 * span)
            previous = times[-1]
            times += [max(step.start - roll, previous + 1e-3), step.start + 0.22 * span]
            times += [step.end - 0.06 * span, step.end + min(0.1, 0.3 * span)]
            values += [0.0, step.off, step.land, 0.0]
        track.ball[foot, :, [0, 2]] = xz.T
        track.foot_yaw[foot] = yaw
        pitch = keys(t, times, values) if mine else np.zeros(len(t))
        track.foot_pitch[foot] = pitch
        # Toes up means that the foot stands on its heel: the ball rises, the heel stays at the floor.
        track.ball[foot, :, 1] = lift[foot] + 0.125 * np.sin(np.maximum(-pitch, 0.0))
    # The root follows the feet with the delay that smoothing gives it, so legs reach what they stand on.
    window = 0.42 * stride.step_seconds
    toe = np.array([toe_out, -toe_out])[:, None]
    track.yaw = smooth((track.foot_yaw - toe).mean(0), 1.6 * window, fps)
    back = np.stack([np.sin(track.yaw), np.cos(track.yaw)], axis=-1) * BALL[1]
    middle = track.ball[:, :, [0, 2]].mean(0) - back
    track.root[:, [0, 2]] = smooth(middle, window, fps)
    # The foot that is ahead swings the arms and twists the spine the other way.
    gap = track.ball[0] - track.ball[1]
    ahead = gap[:, 0] * np.sin(track.yaw) + gap[:, 2] * np.cos(track.yaw)
    share = smooth(lift[0] - lift[1], 0.5 * window, fps) / max(stride.height, 0.03)
    aside = -stride.sway * share
    track.root[:, 0] += aside * np.cos(track.yaw)
    track.root[:, 2] -= aside * np.sin(track.yaw)
    track.pelvis[:, 2] += 0.03 * share
    track.spine[:, 2] -= 0.03 * share
    lead = smooth(ahead, 0.25 * window, fps)
    return np.asarray(lead / max(np.abs(lead).max(), 0.25))


def swing_body(track: Track, lead: Array, stride: Stride, moving: Array, amount: float = 1.0) -> None:
    """Pelvis and chest twist against each other, arms against the legs; `moving` [T] fades it all."""
    swing = lead * amount
    track.pelvis[:, 1] += -0.09 * swing
    track.spine[:, 1] += 0.2 * swing
    track.pelvis[:, 0] += stride.lean * moving * 0.4
    track.spine[:, 0] += stride.lean * moving * 0.6
    folded = np.clip((0.965 - stride.elbow) / 0.4, 0.0, 1.0)
    for side, sign in ((0, -1.0), (1, 1.0)):
        arm = track.arms[side]
        angle = sign * swing * stride.arm_swing + moving * (0.06 + 0.25 * folded)
        turned = rot_y(np.zeros_like(angle))
        cos = np.cos(angle)
        sin = np.sin(angle)
        turned[:, 1, 1] = cos
        turned[:, 2, 2] = cos
        turned[:, 1, 2] = sin
        turned[:, 2, 1] = -sin
        arm.direction = (turned @ arm.direction[..., None])[..., 0]
        arm.bend = (turned @ arm.bend[..., None])[..., 0]
        fold = moving * (arm.reach - stride.elbow) + 0.03 * np.maximum(sign * swing, 0.0) * (1 - folded)
        arm.reach = arm.reach - fold
        # A folded forearm swings in front of the chest: shoulder-to-wrist turns forward with it.
        arm.direction[:, 2] += 0.75 * folded * moving
        arm.bend[:, 1] += 0.9 * folded * moving


def stand_height(track: Track, stride: Stride, steps: Sequence[Step]) -> None:
    """Root height: standing, the bounce of a run, and as low as the legs need."""
    if stride.bounce > 0:
        first = steps[0].start
        last = steps[-1].end
        phase = (track.t - first) / stride.step_seconds - (stride.swing_share - 1.0) * 0.5
        inside = ease((track.t - first) / 0.3) * ease((last - track.t) / 0.3)
        track.root[:, 1] += inside * stride.bounce * (np.cos(2 * np.pi * phase) - 1.0)
    track.root[:, 1] = np.minimum(track.root[:, 1], STAND)
    track.lower_to_reach(0.35 * stride.step_seconds)
