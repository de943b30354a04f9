"""Jumping, squatting, sitting down, kicking and bowing."""

from __future__ import annotations

import math

import numpy as np

from motionloom.datasets.synth.actions.arms import Hold, Vec, hold, play
from motionloom.datasets.synth.actions.maths import Array, ease, keys
from motionloom.datasets.synth.actions.pose import BALL, Track
from motionloom.datasets.synth.actions.truth import Span, Truth

GRAVITY = 9.81


def jump(truth: Truth, span: Span, fps: float, rng: np.random.Generator) -> Track:
    """Crouch, push off, fly on a ballistic path, land softly; `count` times, on the spot or forward.

    A hop is lower, and the leg of the other side stays up from before the first to after the last.
    """
    count = truth.count or 1
    hops = truth.action == "hop"
    height = rng.uniform(0.14, 0.3) * (0.8 if count >= 3 else 1.0) * (0.5 if hops else 1.0)
    flight = 2 * math.sqrt(2 * height / GRAVITY)
    dip = 0.32
    rise = 0.2
    absorb = 0.2
    rest = 0.34
    period = dip + rise + flight + absorb + rest
    seconds = span.pick(rng, at_least=count * period + 0.5, at_most=count * period + 2.2)
    still = 0.95 if hops else 0.35
    squeeze = min(1.0, (seconds - still - count * flight) / (count * (period - flight)))
    dip, rise, absorb, rest = (x * squeeze for x in (dip, rise, absorb, rest))
    period = dip + rise + flight + absorb + rest
    early = 0.45 if hops else 0.15
    begin = rng.uniform(early, max(early + 0.01, seconds - count * period - early))
    track = Track.standing(seconds, fps, rng)
    t = track.t
    low = -rng.uniform(0.2, 0.28) * (0.5 if hops else 1.0)
    top = 0.045
    land = -0.08 if hops else -0.16
    speed = math.sqrt(2 * GRAVITY * height)
    y = np.zeros(len(t))
    air = np.zeros(len(t))
    pitch = np.zeros(len(t))
    crouch = np.zeros(len(t))
    travel = np.zeros(len(t))
    swing: list[tuple[float, Vec]] = []
    back, front = (-0.4, (0.25, -0.4, 0.9)) if hops else (-0.75, (0.25, 0.35, 1.0))
    leap = rng.uniform(0.25, 0.5) if truth.direction == "forward" else 0.0
    for k in range(count):
        a = begin + k * period
        b = a + dip
        c = a + dip + rise
        d = c + flight
        e = c + flight + absorb
        y += low * ease((t - a) / dip) * (t < b)
        y += _hermite(t, b, c, low, top, 0.0, speed)
        inside = (t >= c) & (t < d)
        y += np.where(inside, top + speed * (t - c) - 0.5 * GRAVITY * (t - c) ** 2, 0.0)
        y += _hermite(t, d, e, top, land, -speed * 0.8, 0.0)
        y += np.where((t >= e) & (t < e + rest), land * (1 - ease((t - e) / rest)), 0.0)
        air += np.where(inside, speed * (t - c) - 0.5 * GRAVITY * (t - c) ** 2, 0.0)
        pitch += keys(t, [b + 0.3 * rise, c, d - 0.02, d + 0.09], [0.0, 0.75, 0.35, 0.0])
        crouch += keys(t, [a, b, c, d, e, e + rest], [0.0, 1.0, 0.0, 0.25, 0.7, 0.0])
        travel += leap * np.clip((t - c) / flight, 0.0, 1.0)
        swing += [(a, HANG_KEY), (b, (0.25, -1.0, back)), (c + 0.3 * flight, front)]
        swing += [(d + 0.3 * absorb, (0.4, -0.55, 0.7))]
    swing.append((begin + count * period, HANG_KEY))
    track.root[:, 1] += y
    track.root[:, 2] += travel
    track.ball[:, :, 2] += travel
    tuck = air / max(height, 1e-6) * rng.uniform(0.0, 0.06)
    track.ball[:, :, 1] += air + tuck
    track.foot_pitch += pitch
    track.pelvis[:, 0] += 0.35 * crouch
    track.spine[:, 0] += 0.4 * crouch
    track.root[:, 2] -= 0.06 * crouch
    track.head[:, 0] -= 0.35 * crouch
    for side in (0, 1):
        play(track, side, [(at, d, 0.92, (0.0, 0.3, 1.0)) for at, d in swing])
    if hops:
        up = ease((t - begin + 0.4) / 0.4) * ease((begin + count * period + 0.35 - t) / 0.4)
        _on_one_leg(track, 0 if truth.side == "left" else 1, up, rng)
    track.lower_to_reach(1 / fps)
    return track


def _on_one_leg(track: Track, leg: int, up: Array, rng: np.random.Generator) -> None:
    """Stand on `leg` and hold the other foot behind, as `up` [T] says."""
    sign = 1.0 if leg == 0 else -1.0
    track.root[:, 0] += sign * 0.07 * up
    track.pelvis[:, 2] -= sign * 0.04 * up
    track.ball[1 - leg, :, 1] += rng.uniform(0.2, 0.28) * up
    track.ball[1 - leg, :, 2] -= rng.uniform(0.25, 0.35) * up
    track.foot_pitch[1 - leg] += 0.9 * up


HANG_KEY = (0.22, -1.0, 0.08)


def squat(truth: Truth, span: Span, fps: float, rng: np.random.Generator) -> Track:
    """Bend the knees and come up again, `count` times, arms held out in front."""
    count = truth.count or 1
    low, high = {"slowly": (1.1, 1.4), None: (0.65, 0.8), "quickly": (0.36, 0.46)}[truth.speed or None]
    down = rng.uniform(low, high)
    pause = rng.uniform(0.05, 0.25) * down / 0.6
    gap = rng.uniform(0.05, 0.25)
    period = 2 * down + pause + gap
    seconds = span.pick(rng, at_least=count * period + 0.3, at_most=count * period + 1.6)
    period = min(period, (seconds - 0.2) / count)
    squeeze = period / (2 * down + pause + gap)
    begin = rng.uniform(0.1, max(0.11, seconds - count * period - 0.1))
    track = Track.standing(seconds, fps, rng, width=rng.uniform(0.03, 0.08))
    depth = rng.uniform(0.3, 0.42)
    bent = np.zeros(len(track.t))
    for k in range(count):
        at = begin + k * period
        bent += _bump(track.t, at, down * squeeze, pause * squeeze)
    back = rng.uniform(0.1, 0.15)
    pitch = rng.uniform(0.5, 0.7)
    track.root[:, 1] -= depth * bent
    track.root[:, 2] -= back * bent
    track.pelvis[:, 0] += 0.6 * pitch * bent
    track.spine[:, 0] += 0.4 * pitch * bent
    track.head[:, 0] -= 0.5 * pitch * bent
    track.knee_out += 0.25 * bent
    end = begin + count * period - gap * squeeze
    out = (rng.uniform(0.0, 0.15), rng.uniform(-0.15, 0.05), 1.0)
    for side in (0, 1):
        times = (begin, begin + down * squeeze, end - down * squeeze, end)
        hold(track, side, times, out, 0.95, (0.0, 1.0, 0.0))
        # Arms stay level while the chest leans.
        track.arms[side].direction[:, 1] += 0.4 * bent
    track.lower_to_reach()
    return track


def sit(truth: Truth, span: Span, fps: float, rng: np.random.Generator) -> Track:
    """Sit down on something of chair height and stay, hands on the thighs; some clips stand up again."""
    seconds = span.pick(rng, at_least=min(3.0, span.high))
    down = rng.uniform(0.8, 1.3) * min(1.0, seconds / 3)
    begin = rng.uniform(0.1, 0.2 * seconds)
    track = Track.standing(seconds, fps, rng)
    up_again = span.returns or (seconds > 4.2 and rng.random() < 0.4)
    end = seconds - 0.2 if up_again else seconds + 10
    up_at = end - down
    seated = keys(track.t, [begin, begin + down, up_at, end], [0.0, 1.0, 1.0, 0.0])
    lean = keys(
        track.t,
        [begin, begin + 0.55 * down, begin + 1.25 * down, up_at - 0.25 * down, up_at + 0.45 * down, end],
        [0.0, 1.0, 0.12, 0.12, 1.0, 0.0],
    )
    drop = rng.uniform(0.39, 0.44)
    track.root[:, 1] -= drop * seated
    track.root[:, 2] -= rng.uniform(0.38, 0.42) * seated**1.15
    track.pelvis[:, 0] += 0.45 * lean
    track.spine[:, 0] += 0.35 * lean
    track.head[:, 0] -= 0.3 * lean
    thigh = (rng.uniform(-0.06, 0.06), -0.66, rng.uniform(0.62, 0.75))
    inward = (-0.4, 0.4, 0.8)
    for side in (0, 1):
        holds: list[Hold] = [(begin, None, 0.0, None), (begin + down, thigh, 0.84, inward)]
        if up_again:
            holds += [(up_at, thigh, 0.84, inward), (end, None, 0.0, None)]
        play(track, side, holds)
        track.arms[side].roll += 0.9 * seated
    track.lower_to_reach()
    return track


def kick(truth: Truth, span: Span, fps: float, rng: np.random.Generator) -> Track:
    """Shift the weight, chamber the knee, kick forward, set the foot down; `count` times."""
    count = truth.count or 1
    leg = 0 if truth.side == "left" else 1
    sign = 1.0 if leg == 0 else -1.0
    unit_time = rng.uniform(0.95, 1.25)
    seconds = span.pick(rng, at_least=count * unit_time + 0.6, at_most=count * unit_time + 2.0)
    unit_time = min(unit_time, (seconds - 0.5) / count)
    begin = rng.uniform(0.3, max(0.31, seconds - count * unit_time - 0.2))
    track = Track.standing(seconds, fps, rng, width=rng.uniform(-0.02, 0.02))
    rest = track.ball[leg, 0].copy()
    height = rng.uniform(0.6, 0.95)
    far = rng.uniform(0.68, 0.8)
    chamber = rest + np.array([-0.02 * sign, 0.38, 0.06])
    end = np.array([rest[0] - 0.04 * sign, height, BALL[1] + far])
    times = [0.0]
    places = [rest]
    pitches = [0.0]
    effort = [0.0]
    for k in range(count):
        a = begin + k * unit_time
        times += [a, a + 0.34 * unit_time, a + 0.52 * unit_time, a + 0.6 * unit_time]
        places += [rest, chamber, end, end]
        pitches += [0.0, 0.55, -0.35, -0.35]
        effort += [0.0, 0.55, 1.0, 1.0]
        times += [a + 0.78 * unit_time, a + unit_time]
        places += [chamber, rest]
        pitches += [0.5, 0.0]
        effort += [0.5, 0.0]
    track.ball[leg] = keys(track.t, times, np.stack(places))
    track.foot_pitch[leg] += keys(track.t, times, pitches)
    push = keys(track.t, times, effort)
    finish = begin + count * unit_time
    loaded = ease((track.t - begin + 0.3) / 0.3) * ease((finish + 0.25 - track.t) / 0.3)
    track.root[:, 0] -= sign * 0.075 * loaded
    track.root[:, 1] -= 0.02 * loaded
    track.pelvis[:, 0] -= 0.22 * push
    track.pelvis[:, 2] += sign * 0.05 * push
    track.spine[:, 0] += 0.1 * push
    track.spine[:, 1] += sign * 0.25 * push
    track.head[:, 0] += 0.12 * push
    guard = rng.random() < 0.6
    for side in (0, 1):
        wide = (0.45, -0.5, 0.65 if side != leg else -0.2)
        there = begin + 0.4 * unit_time
        pose = (wide, 0.85, (0.0, 0.5, 1.0))
        if guard:
            there = begin - 0.05
            pose = ((-0.05, 0.0, 0.85), 0.6, (-0.4, 1.0, 0.2))
        hold(track, side, (max(begin - 0.5, -0.2), there, finish - 0.15, finish + 0.5), *pose)
    track.lower_to_reach()
    return track


def bow(truth: Truth, span: Span, fps: float, rng: np.random.Generator) -> Track:
    """Bend forward from the hips, arms along the body, and straighten up."""
    low, high = {"slowly": (1.3, 1.7), None: (0.8, 1.0), "quickly": (0.42, 0.56)}[truth.speed or None]
    down = rng.uniform(low, high)
    seconds = span.pick(rng, at_least=2 * down + 0.6)
    down = min(down, 0.44 * seconds)
    pause = rng.uniform(0.1, max(0.11, min(1.2, seconds - 2 * down - 0.3)))
    begin = rng.uniform(0.05, max(0.06, seconds - 2 * down - pause - 0.1))
    track = Track.standing(seconds, fps, rng, width=rng.uniform(-0.03, 0.0))
    bent = _bump(track.t, begin, down, pause)
    deep = rng.uniform(0.85, 1.35)
    track.pelvis[:, 0] += 0.62 * deep * bent
    track.spine[:, 0] += 0.38 * deep * bent
    track.head[:, 0] += 0.2 * bent
    track.root[:, 2] -= 0.11 * deep * bent
    track.root[:, 1] -= 0.012 * bent
    for side in (0, 1):
        track.arms[side].direction += bent[:, None] * np.array([-0.1, 0.0, rng.uniform(0.25, 0.45) * deep])
    track.lower_to_reach()
    return track


def _bump(t: Array, begin: float, rise: float, hold: float) -> Array:
    """0 to 1 in `rise` seconds, held, and back."""
    return keys(t, [begin, begin + rise, begin + rise + hold, begin + 2 * rise + hold], [0.0, 1.0, 1.0, 0.0])


def _hermite(t: Array, a: float, b: float, ya: float, yb: float, va: float, vb: float) -> Array:
    """A cubic from (a, ya) to (b, yb) with end velocities va and vb; zero outside [a, b)."""
    span = b - a
    s = (t - a) / span
    value = ya * (1 + 2 * s) * (1 - s) ** 2 + yb * s * s * (3 - 2 * s)
    value += span * (va * s * (1 - s) ** 2 - vb * s * s * (1 - s))
    return np.where((t >= a) & (t < b), value, 0.0)
