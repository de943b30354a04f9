"""Keyed arm motion and the actions of the upper body: punch, wave, clap, raise, reach."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from motionloom.datasets.synth.actions.maths import Array, ease, keys, unit
from motionloom.datasets.synth.actions.pose import ARM, SHOULDER, Track
from motionloom.datasets.synth.actions.truth import Span, Truth

Vec = tuple[float, float, float]
Hold = tuple[float, Vec | None, float, Vec | None]
"""One arm key: seconds, direction to the wrist (chest axes, +X outwards), reach, bend; None = hanging."""


def play(track: Track, side: int, holds: Sequence[Hold]) -> None:
    """Move one arm through keys on great circles around the shoulder, easing from key to key."""
    arm = track.arms[side]
    t = track.t
    rest = unit(arm.direction.mean(0))
    rest_bend = unit(arm.bend.mean(0))
    rest_reach = float(arm.reach.mean())
    at = np.array([h[0] for h in holds])
    to = unit(np.array([rest if h[1] is None else h[1] for h in holds], dtype=np.float64))
    bend = unit(np.array([rest_bend if h[3] is None else h[3] for h in holds], dtype=np.float64))
    reach = np.array([rest_reach if h[1] is None else h[2] for h in holds])
    order = np.argsort(at, kind="stable")
    at = at[order]
    to = to[order]
    bend = bend[order]
    reach = reach[order]
    index = np.clip(np.searchsorted(at, t, side="right") - 1, 0, len(at) - 2)
    weight = ease((t - at[index]) / np.maximum(at[index + 1] - at[index], 1e-6))
    noise = arm.direction - arm.direction.mean(0)
    arm.direction = slerp(to[index], to[index + 1], weight) + noise
    arm.bend = unit(bend[index] + weight[:, None] * (bend[index + 1] - bend[index]))
    arm.reach = arm.reach - rest_reach + reach[index] + weight * (reach[index + 1] - reach[index])


def hold(
    track: Track, side: int, times: tuple[float, float, float, float], to: Vec, reach: float, bend: Vec
) -> None:
    """Move a hanging arm to a pose between the first two times, and back between the others."""
    first, there, until, last = times
    pose = (to, reach, bend)
    play(track, side, [(first, None, 0.0, None), (there, *pose), (until, *pose), (last, None, 0.0, None)])


def slerp(a: Array, b: Array, weight: Array) -> Array:
    """Great-circle interpolation of unit vectors a, b [T, 3] by weight [T]."""
    angle = np.arccos(np.clip((a * b).sum(-1), -0.9999, 0.9999))
    sine = np.sin(angle)
    first = np.sin((1 - weight) * angle) / sine
    second = np.sin(weight * angle) / sine
    return unit(first[:, None] * a + second[:, None] * b)


def to_point(x: float, y: float, z: float) -> tuple[Vec, float]:
    """Direction and reach that bring the wrist to a point seen from the chest (x outwards)."""
    away = np.array([x, y, z]) - SHOULDER
    far = float(np.linalg.norm(away))
    return (float(away[0]), float(away[1]), float(away[2])), min(far / ARM, 0.985)


GUARD_BEND: Vec = (-0.5, 1.0, 0.1)


def punch(truth: Truth, span: Span, fps: float, rng: np.random.Generator) -> Track:
    """Raise a guard, strike straight forward `count` times with the hips behind it, drop the guard."""
    count = truth.count or 1
    hand = 0 if truth.side == "left" else 1
    sign = 1.0 if hand == 0 else -1.0
    period = rng.uniform(0.6, 0.85)
    seconds = span.pick(rng, at_least=count * period + 1.2, at_most=count * period + 2.4)
    period = min(period, (seconds - 0.9) / count)
    begin = rng.uniform(0.5, max(0.51, seconds - count * period - 0.4))
    track = Track.standing(seconds, fps, rng, width=rng.uniform(0.02, 0.08))
    guard, near = to_point(rng.uniform(0.12, 0.17), rng.uniform(0.06, 0.14), rng.uniform(0.2, 0.26))
    # The chest turns away from the striking arm: straight ahead is outwards of the chest.
    strike = (rng.uniform(0.2, 0.36), rng.uniform(-0.08, 0.16), 1.0)
    mine: list[Hold] = [(begin - 0.5, None, 0.0, None), (begin - 0.05, guard, near, GUARD_BEND)]
    times = [0.0]
    effort = [0.0]
    for k in range(count):
        a = begin + k * period
        mine += [
            (a + 0.16 * period, guard, near * 0.95, GUARD_BEND),
            (a + 0.44 * period, strike, 0.975, (0.0, 1.0, 0.0)),
            (a + 0.52 * period, strike, 0.975, (0.0, 1.0, 0.0)),
            (a + 0.9 * period, guard, near, GUARD_BEND),
        ]
        times += [a, a + 0.16 * period, a + 0.44 * period, a + 0.52 * period, a + 0.9 * period]
        effort += [0.0, -0.25, 1.0, 1.0, 0.0]
    end = begin + count * period
    mine += [(end, guard, near, GUARD_BEND), (end + 0.5, None, 0.0, None)]
    play(track, hand, mine)
    if rng.random() < 0.6:
        hold(track, 1 - hand, (begin - 0.5, begin - 0.05, end, end + 0.5), guard, near, GUARD_BEND)
    push = keys(track.t, times, effort)
    ready = ease((track.t - begin + 0.5) / 0.45) * ease((end + 0.5 - track.t) / 0.45)
    track.arms[hand].roll += 1.1 * np.clip(push, 0, 1)
    track.pelvis[:, 1] -= sign * 0.14 * push
    track.spine[:, 1] -= sign * 0.36 * push
    track.head[:, 1] += sign * 0.4 * push
    track.root[:, 2] += 0.045 * push
    track.spine[:, 0] += 0.08 * ready + 0.05 * push
    track.root[:, 1] -= rng.uniform(0.02, 0.06) * ready
    track.lower_to_reach()
    return track


def wave(truth: Truth, span: Span, fps: float, rng: np.random.Generator) -> Track:
    """Lift a hand (or both) beside the head and swing the forearm from side to side."""
    seconds = span.pick(rng, at_least=2.8)
    track = Track.standing(seconds, fps, rng)
    up = rng.uniform(0.5, 0.75) * min(1.0, seconds / 2.5)
    begin = rng.uniform(0.05, 0.2 * seconds)
    stays = rng.random() < 0.4 and not span.returns
    down = seconds + 5 if stays else seconds - up - rng.uniform(0.02, 0.15)
    rate = rng.uniform(1.4, 2.3)
    high = rng.uniform(0.5, 1.0)
    wide = rng.uniform(0.35, 0.6)
    amplitude = rng.uniform(0.3, 0.45)
    for side in (0, 1):
        if truth.side not in (("left", "right")[side], "both"):
            continue
        beside: Vec = (wide, high, rng.uniform(0.35, 0.5))
        bend: Vec = (-0.75, 0.75, 0.1)
        hold(track, side, (begin, begin + up, down, down + up), beside, 0.66, bend)
        arm = track.arms[side]
        on = ease((track.t - begin - 0.6 * up) / (0.5 * up)) * ease((down + 0.2 * up - track.t) / (0.4 * up))
        swing = np.sin(2 * np.pi * rate * (track.t - begin - up)) * on
        arm.direction = unit(arm.direction) + swing[:, None] * np.array([amplitude, -0.12 * amplitude, 0.0])
        arm.roll -= 0.3 * on
        track.spine[:, 2] += (1 if side else -1) * 0.03 * swing
    tilt = {"left": -1.0, "right": 1.0}.get(truth.side or "", 0.0)
    track.head[:, 2] += tilt * 0.06
    track.lower_to_reach()
    return track


def clap(truth: Truth, span: Span, fps: float, rng: np.random.Generator) -> Track:
    """Bring the palms together in front of the chest, `count` times."""
    count = truth.count or 2
    period = rng.uniform(0.42, 0.62)
    seconds = span.pick(rng, at_least=count * period + 1.5, at_most=count * period + 2.6)
    period = min(period, (seconds - 1.2) / count)
    begin = rng.uniform(0.55, max(0.56, seconds - count * period - 0.6))
    track = Track.standing(seconds, fps, rng)
    height = rng.uniform(-0.12, 0.08)
    front = rng.uniform(0.27, 0.34)
    open_to = to_point(rng.uniform(0.17, 0.24), height, front)
    shut = to_point(0.03, height, front + 0.02)
    bend: Vec = (0.0, 1.0, 0.35)
    holds: list[Hold] = [(begin - 0.5, None, 0.0, None), (begin, *open_to, bend)]
    for k in range(count):
        a = begin + k * period
        holds += [(a + 0.5 * period, *shut, bend), (a + 0.56 * period, *shut, bend)]
        holds.append((a + period, *open_to, bend))
    holds.append((begin + count * period + 0.5, None, 0.0, None))
    on = ease((track.t - begin + 0.5) / 0.5) * ease((begin + count * period + 0.5 - track.t) / 0.5)
    for side in (0, 1):
        arm = track.arms[side]
        arm.direction[:] = arm.direction.mean(0)
        play(track, side, holds)
        arm.roll -= 0.35 * on
        # Forearms come in at an angle: turn the fingers forward so that palms meet flat.
        arm.flex -= 0.35 * on
    track.head[:, 0] += 0.08 * on
    track.lower_to_reach()
    return track


def lift(truth: Truth, span: Span, fps: float, rng: np.random.Generator) -> Track:
    """Raise an arm (or both) straight overhead, through the front or through the side, and hold it.

    To stretch is to raise both through the sides and then to go on the toes or to bend to one side.
    """
    stretches = truth.action == "stretch"
    sides = "both" if stretches else truth.side
    seconds = span.pick(rng)
    up = rng.uniform(0.6, 0.95) * min(1.0, seconds / 2.5) * (1.25 if stretches else 1.0)
    begin = rng.uniform(0.05, 0.15 * seconds)
    stays = rng.random() < 0.35 and not span.returns
    down = seconds + 5 if stays else seconds - up - rng.uniform(0.02, 0.1)
    track = Track.standing(seconds, fps, rng)
    half: Vec = (0.15, 0.0, 1.0) if truth.style == "front" else (1.0, 0.0, 0.15)
    top: Vec = (rng.uniform(0.0, 0.22), 1.0, rng.uniform(-0.02, 0.05))
    bends: tuple[Vec, Vec] = ((-0.6, 0.6, 0.2), (-1.0, 0.0, 0.3))
    for side in (0, 1):
        if sides not in (("left", "right")[side], "both"):
            continue
        arm = track.arms[side]
        rest = unit(arm.direction.mean(0))
        path = np.stack([rest, unit(np.array(half)), unit(np.array(top))])
        rise = keys(track.t, [begin, begin + up, down, down + up], [0.0, 1.0, 1.0, 0.0])
        first = slerp(path[:1], path[1:2], np.minimum(2 * rise, 1.0))
        second = slerp(path[1:2], path[2:], np.maximum(2 * rise - 1, 0.0))
        blend = ease((rise - 0.35) / 0.3)[:, None]
        noise = arm.direction - arm.direction.mean(0)
        arm.direction = unit((1 - blend) * first + blend * second) + noise
        bend = np.stack([unit(arm.bend.mean(0)), *(unit(np.array(b)) for b in bends)])
        arm.bend = keys(rise, [0.0, 0.5, 1.0], bend)
        arm.reach += (0.975 - arm.reach) * rise
        if sides != "both":
            track.spine[:, 2] += (-1 if side else 1) * 0.05 * rise
    if stretches:
        _strain(track, truth.direction or "up", ease((rise - 0.5) / 0.5), rng)
    track.lower_to_reach()
    return track


def _strain(track: Track, direction: str, on: Array, rng: np.random.Generator) -> None:
    """On the toes and a little backwards, or bent to one side, as `on` [T] says."""
    if direction == "up":
        track.foot_pitch += rng.uniform(0.4, 0.55) * on
        track.root[:, 1] += rng.uniform(0.07, 0.09) * on
        track.spine[:, 0] -= rng.uniform(0.1, 0.25) * on
        track.head[:, 0] -= 0.35 * on
        return
    sign = 1.0 if direction == "left" else -1.0
    bend = sign * rng.uniform(0.55, 0.8) * on
    track.spine[:, 2] -= bend
    track.pelvis[:, 2] -= 0.15 * bend
    track.root[:, 0] -= 0.07 * bend


def reach(truth: Truth, span: Span, fps: float, rng: np.random.Generator) -> Track:
    """Stretch one hand forward, up, down to the floor or out to its side, hold it there, come back.

    Who points does the same with the arm alone: the body stays upright, the feet stay flat.
    """
    body = 0.0 if truth.action == "point" else 1.0
    hand = 0 if truth.side == "left" else 1
    sign = 1.0 if hand == 0 else -1.0
    seconds = span.pick(rng)
    out = rng.uniform(0.7, 1.0) * min(1.0, seconds / 2.8)
    begin = rng.uniform(0.05, 0.15 * seconds)
    back = seconds - out - 0.05
    track = Track.standing(seconds, fps, rng, width=rng.uniform(0.02, 0.06))
    go = keys(track.t, [begin, begin + out, max(back, begin + out), seconds], [0.0, 1.0, 1.0, 0.0])
    reached = rng.uniform(0.95, 0.98)
    via: list[Hold] = []
    if truth.direction == "forward":
        to = (rng.uniform(-0.2, 0.0), rng.uniform(-0.15, 0.12), 1.0)
        bend = (0.0, 1.0, 0.0)
        track.spine[:, 0] += body * rng.uniform(0.12, 0.25) * go
        track.pelvis[:, 0] += body * 0.1 * go
        track.spine[:, 1] -= body * sign * 0.35 * go
        track.root[:, 2] += body * 0.03 * go
    elif truth.direction == "up":
        # Up and forward, as to a shelf: on the toes, eyes on the hand. Raising an arm goes straight overhead.
        to = (rng.uniform(-0.1, 0.1), 1.0, rng.uniform(0.6, 0.85))
        bend = (-0.6, 0.8, 0.0)
        track.foot_pitch += body * rng.uniform(0.25, 0.45) * go
        track.root[:, 1] += body * 0.06 * go
        track.head[:, 0] -= 0.4 * go
        track.spine[:, 2] += body * sign * 0.1 * go
        via = [(begin + 0.5 * out, (0.1, -0.1, 1.0), 0.85, (0.0, 1.0, 0.2))]
    elif truth.direction == "down":
        to = (rng.uniform(-0.05, 0.1), rng.uniform(-0.35, -0.1), 1.0)
        bend = (0.0, 0.6, 0.4)
        deep = rng.uniform(0.9, 1.1)
        track.root[:, 1] -= 0.4 * deep * go
        track.root[:, 2] -= 0.16 * go
        track.pelvis[:, 0] += 0.8 * deep * go
        track.spine[:, 0] += 0.45 * deep * go
        track.spine[:, 1] -= sign * 0.15 * go
        track.head[:, 0] -= 0.2 * go
        track.knee_out += 0.12 * go
    else:
        to = (1.0, rng.uniform(-0.1, 0.2), rng.uniform(0.0, 0.15))
        bend = (0.0, 0.3, 1.0)
        track.spine[:, 2] -= body * sign * rng.uniform(0.12, 0.25) * go
        track.head[:, 1] += sign * 0.5 * go
        track.root[:, 0] += body * sign * 0.05 * go
    holds: list[Hold] = [(begin, None, 0.0, None), *via, (begin + out, to, reached, bend)]
    holds += [(max(back, begin + out + 0.01), to, reached, bend), (seconds, None, 0.0, None)]
    play(track, hand, holds)
    track.arms[hand].roll += 0.5 * go
    if truth.direction == "down":
        # The other arm goes back for balance: what differs from side to side is plain to see, and to learn.
        behind: Hold = (begin + out, (0.35, -0.5, -0.7), 0.93, (0.0, 0.3, 1.0))
        play(track, 1 - hand, [holds[0], behind, (max(back, begin + out + 0.01), *behind[1:]), holds[-1]])
    track.lower_to_reach()
    return track
