"""Lying down and crawling: what is done on the floor."""

from __future__ import annotations

import numpy as np

from motionloom.datasets.actions.signals import SHIN, STAND, THIGH
from motionloom.datasets.synth.actions.arms import Vec, play
from motionloom.datasets.synth.actions.maths import Array, ease, keys, unit
from motionloom.datasets.synth.actions.pose import ARM, OFFSETS, SHOULDER, Track
from motionloom.datasets.synth.actions.truth import Span, Truth

HIPS = float(-OFFSETS[1][1])
"""Metres of the hips below the root, or before it on the back."""

WRIST = 0.07
"""Height of the wrist of a hand on the floor, metres."""


def lie(truth: Truth, span: Span, fps: float, rng: np.random.Generator) -> Track:
    """Crouch, sit down on the floor, lean back, stretch the legs out and stay on the back."""
    seconds = span.pick(rng, at_least=min(3.8, span.high))
    down = rng.uniform(2.4, 3.0) * min(1.0, seconds / 4)
    begin = rng.uniform(0.05, max(0.06, seconds - down - 0.6))
    track = Track.standing(seconds, fps, rng, width=rng.uniform(0.0, 0.06))
    at = [begin + share * down for share in (0.0, 0.34, 0.56, 1.0)]
    back = rng.uniform(0.4, 0.46)
    track.root[:, 1] += keys(track.t, at, [0.0, 0.36 - STAND, 0.1 - STAND, 0.1 - STAND])
    track.root[:, 2] += keys(track.t, at, [0.0, -0.16, -back, -back])
    track.pelvis[:, 0] += keys(track.t, at, [0.0, 0.55, -0.2, -1.5])
    track.spine[:, 0] += keys(track.t, at, [0.0, 0.6, 0.4, -0.02])
    track.head[:, 0] += keys(track.t, at, [0.0, -0.4, 0.1, 0.1])
    track.knee_out += keys(track.t, at, [0.0, 0.2, 0.15, 0.0])
    flat = keys(track.t, at, [0.0, 0.0, 0.0, 1.0])
    ankles = track._ankles()
    track.foot_pitch -= 1.15 * flat
    for side in (0, 1):
        lifted = 0.05 * np.sin(np.pi * np.clip((track.t - at[2] - 0.1 * side) / (at[3] - at[2]), 0, 1)) ** 2
        ankle = ankles[side].copy()
        ankle[:, 1] += lifted
        ankle[:, 2] += (0.985 * (THIGH + SHIN) + HIPS - back - ankle[:, 2]) * flat
        track.ball[side] = ankle + track._foot_rotation(side) @ OFFSETS[10 + side]
    ahead: Vec = (0.1, -0.25, 1.0)
    behind: Vec = (0.35, -1.0, -0.6)
    beside: Vec = (rng.uniform(0.2, 0.4), -1.0, -0.02)
    bend: Vec = (-0.8, 0.0, 0.6)
    for side in (0, 1):
        holds = [
            (at[1], ahead, 0.9, (0.0, 0.5, 1.0)),
            (at[2], behind, 0.93, bend),
            (at[3], beside, 0.95, bend),
        ]
        play(track, side, [(begin, None, 0.0, None), *holds])
    chest, shoulders = _shoulders(track)
    for side, sign in ((0, 1.0), (1, -1.0)):
        arm = track.arms[side]
        away = unit(arm.direction) * (arm.reach * ARM)[:, None] * [sign, 1.0, 1.0]
        wrist = shoulders[side] + (chest @ away[..., None])[..., 0]
        wrist[:, 1] = np.maximum(wrist[:, 1], WRIST)
        _reach_to(track, side, chest, wrist - shoulders[side])
        arm.flex -= keys(track.t, at, [0.0, 0.0, 1.2, 0.0])
    return track


def crawl(truth: Truth, span: Span, fps: float, rng: np.random.Generator) -> Track:
    """Crawl forward on hands and knees; each hand moves with the knee of the other side."""
    track = Track.standing(span.pick(rng), fps, rng, width=rng.uniform(-0.01, 0.03))
    stride = rng.uniform(0.2, 0.3)
    period = rng.uniform(0.95, 1.3)
    phase = track.t / period + rng.uniform(0, 1)
    speed = 2 * stride / period
    track.root[:] = 0.0
    track.root[:, 2] = speed * period * phase
    track.pelvis[:, 0] += 1.25
    track.spine[:, 0] += rng.uniform(0.05, 0.2)
    track.head[:, 0] -= rng.uniform(0.9, 1.2)
    sway = np.sin(2 * np.pi * (phase + 0.1))
    track.spine[:, 1] += 0.05 * sway
    knee = 0.055
    ankle = 0.05
    hips = [track._pelvis_rotation() @ OFFSETS[1 + side] for side in (0, 1)]
    ahead = np.stack([_planted(phase + 0.5 * side) for side in (0, 1)]) * stride
    # Both thighs lean by the same angle at all times, so that both knees can be on the floor.
    height = np.sqrt(THIGH**2 - np.minimum(np.abs(ahead[0]), 0.5 * stride) ** 2)
    track.root[:, 1] = knee + height - 0.5 * (hips[0] + hips[1])[:, 1]
    track.foot_yaw[:] = 0.0
    track.foot_pitch[:] = 2.55
    for side in (0, 1):
        lift = _lifted(phase + 0.5 * side)
        place = track.root + hips[side]
        place[:, 0] = hips[side][:, 0].mean()
        place[:, 1] = ankle + 0.05 * lift
        place[:, 2] += ahead[side] - np.sqrt(SHIN**2 - (knee - ankle) ** 2)
        track.ball[side] = place + track._foot_rotation(side) @ OFFSETS[10 + side]
    _put_hands(track, [_planted(phase + 0.5 * (1 - side)) * stride for side in (0, 1)],
               [_lifted(phase + 0.5 * (1 - side)) for side in (0, 1)], rng)  # fmt: skip
    return track


def _planted(phase: Array) -> Array:
    """Return the place of a limb, strides before its hip: 0.5 to -0.5 on the floor, and back in the air."""
    p = phase % 1.0
    return np.where(p < 0.5, 0.5 - 2 * p, -0.5 + ease(2 * p - 1))


def _lifted(phase: Array) -> Array:
    return np.sin(np.pi * np.maximum(2 * (phase % 1.0) - 1, 0.0)) ** 2


def _put_hands(track: Track, ahead: list[Array], lift: list[Array], rng: np.random.Generator) -> None:
    """Wrists on the floor under the shoulders, `ahead` [T] of them and `lift` [T] up."""
    chest, shoulders = _shoulders(track)
    wide = rng.uniform(-0.01, 0.04)
    for side, sign in ((0, 1.0), (1, -1.0)):
        wrist = shoulders[side].copy()
        wrist[:, 0] = sign * (SHOULDER[0] + wide)
        wrist[:, 1] = WRIST + 0.06 * lift[side]
        wrist[:, 2] += 0.03 + ahead[side]
        _reach_to(track, side, chest, wrist - shoulders[side])
        arm = track.arms[side]
        arm.bend[:] = (-0.3, 1.0, 0.0)
        arm.roll[:] = 1.2
        arm.flex[:] = -1.2


def _shoulders(track: Track) -> tuple[Array, list[Array]]:
    """Frames [T, 3, 3] of the chest, and where both shoulders [T, 3] rest on it."""
    local = track.rotations()
    chest = local[:, 0] @ local[:, 3] @ local[:, 6] @ local[:, 9]
    base = track.solve()[:, 9]
    return chest, [base + chest @ (SHOULDER * [sign, 1.0, 1.0]) for sign in (1.0, -1.0)]


def _reach_to(track: Track, side: int, chest: Array, away: Array) -> None:
    """Bring a wrist to where it is `away` [T, 3] from its shoulder, in metres of the world."""
    arm = track.arms[side]
    arm.direction = (chest.swapaxes(-1, -2) @ away[..., None])[..., 0] * [-1.0 if side else 1.0, 1.0, 1.0]
    arm.reach = np.minimum(np.linalg.norm(away, axis=-1) / ARM, 0.985)
