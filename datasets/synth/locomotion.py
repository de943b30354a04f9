"""Walking, circling, turning and running, from footsteps."""

from __future__ import annotations

import numpy as np

from motionloom.datasets.synth.gait import (
    Stride,
    apply_steps,
    stand_height,
    stations_to_steps,
    swing_body,
)
from motionloom.datasets.synth.maths import ease, smooth
from motionloom.datasets.synth.pose import Track
from motionloom.datasets.synth.truth import Span, Truth

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
        angle = rng.uniform(1.5, 1.95) * np.pi * (-1 if truth.direction == "clockwise" else 1)
        return _walk(rng, fps, seconds, speed, angle, backward=False)
    return _walk(rng, fps, span.pick(rng), speed, 0.0, backward=backward)


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
    """Run forward, each step with a flight."""
    seconds = span.pick(rng)
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
    return _along(rng, fps, seconds, stride, speed, 0.0, lead_in=0.0, corner=False)


def _walk(
    rng: np.random.Generator,
    fps: float,
    seconds: float,
    speed: float,
    angle: float,
    backward: bool = False,
    corner: bool = False,
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
    lead_in = rng.uniform(0.15, 0.45) if angle or rng.random() < 0.5 else 0.0
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
