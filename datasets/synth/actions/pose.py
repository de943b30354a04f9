"""`Track`: a whole-body pose over time in animator's terms, and its solution to joint positions.

A clip is written as what an animator would key: root path and heading, pelvis and spine lean, where the balls
of the feet are, where the wrists are as seen from the chest, finger rotations. `solve` turns that into local
rotations of `smplx52` with closed-form two-bone IK for legs and arms (knees bend forward, elbows never past
straight), then forward kinematics. Arms are written for the left side with +X pointing *outwards*; the right
side is its mirror image, so one set of numbers serves both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from motionloom.datasets.actions.signals import SHIN, STAND, THIGH
from motionloom.datasets.motion.kinematics import forward_kinematics
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.synth.actions.maths import (
    Array,
    cross,
    ease,
    lower_envelope,
    rot_x,
    rot_y,
    rot_z,
    unit,
    wander,
)

SKELETON = Skeleton.named("smplx52")
OFFSETS = SKELETON.offsets
BALL = np.array([SKELETON.rest_joints[10, 0], SKELETON.rest_joints[10, 2]])
"""Place of the left ball on the floor, (x, z) from the root."""
SHOULDER = SKELETON.rest_joints[16] - SKELETON.rest_joints[9]
"""Left shoulder seen from the chest joint (spine3) at rest."""
UPPER_ARM, FOREARM = (float(np.linalg.norm(OFFSETS[j])) for j in (18, 20))
ARM = UPPER_ARM + FOREARM
OVERLAP = 0.4
"""Seconds in which one action passes into the next."""
LEG_REACH = 0.988
"""Longest hip-to-ankle distance as a fraction of the straight leg."""
_MIRROR = np.outer([-1.0, 1.0, 1.0], [-1.0, 1.0, 1.0])

HANG = ((0.20, -1.0, 0.06), 0.975, (0.0, 0.0, 1.0))
"""Arm hanging at the side: direction shoulder to wrist, reach, bend direction."""


@dataclass
class Arm:
    """One arm over time, in chest coordinates with +X outwards."""

    direction: Array  # [T, 3] shoulder to wrist
    reach: Array  # [T] distance to the wrist over arm length, at most 0.985
    bend: Array  # [T, 3] side to which the forearm folds; the elbow points the other way
    roll: Array  # [T] forearm twist; positive turns the palm down on an arm held forward
    flex: Array  # [T] wrist flexion towards the palm


BODY = ("root", "yaw", "pelvis", "spine", "head")
FEET = ("ball", "foot_yaw", "foot_pitch", "knee_out")
"""A value over time [T, ...], and for both feet [2, T, ...]."""


class Track:
    """A clip before it is solved. Index 0 is left, 1 right."""

    def __init__(self, t: Array, fps: float) -> None:
        n = len(t)
        self.t = t
        self.fps = fps
        self.root: Array = np.tile([0.0, STAND - 0.008, 0.0], (n, 1))
        self.yaw: Array = np.zeros(n)
        self.pelvis: Array = np.zeros((n, 3))  # pitch, yaw, roll
        self.spine: Array = np.zeros((n, 3))
        self.head: Array = np.zeros((n, 3))
        self.ball: Array = np.zeros((2, n, 3))
        self.ball[:, :, 2] = BALL[1]
        self.ball[0, :, 0] = BALL[0]
        self.ball[1, :, 0] = -BALL[0]
        self.foot_yaw: Array = np.zeros((2, n))
        self.foot_yaw[0] = 0.1
        self.foot_yaw[1] = -0.1
        self.foot_pitch: Array = np.zeros((2, n))
        self.knee_out: Array = np.zeros((2, n))
        self.arms = (hanging_arm(n), hanging_arm(n))
        self.fingers: Array = np.tile(np.eye(3), (2, n, 15, 1, 1))

    @staticmethod
    def standing(seconds: float, fps: float, rng: np.random.Generator, width: float | None = None) -> Track:
        """A person who stands still but breathes; stance width and posture differ from clip to clip."""
        frames = max(8, round(seconds * fps))
        track = Track(np.arange(frames) / fps, fps)
        out = rng.uniform(-0.02, 0.06) if width is None else width
        turned = rng.uniform(0.02, 0.22)
        for side, sign in enumerate((1.0, -1.0)):
            track.ball[side, :, 0] += sign * out
            track.foot_yaw[side] = sign * turned
            arm = track.arms[side]
            arm.direction[:, 0] += rng.uniform(-0.03, 0.1)
            arm.direction[:, 2] += rng.uniform(-0.03, 0.12)
            arm.reach -= rng.uniform(0.0, 0.03)
        noise = wander(track.t, rng, 12, 1.0)
        track.spine += 0.015 * noise[:, :3] + np.array([rng.normal(0.02, 0.03), 0.0, 0.0])
        track.head += 0.03 * noise[:, 3:6] + np.array([rng.normal(0.0, 0.05), 0.0, 0.0])
        track.root[:, [0, 2]] += 0.004 * noise[:, 6:8]
        for side in (0, 1):
            track.arms[side].direction += 0.015 * noise[:, 8 + 2 * side : 9 + 2 * side]
            track.arms[side].roll += 0.06 * noise[:, 9 + 2 * side]
        return track

    def cut(self, first: int, frames: int) -> Track:
        """`frames` frames of the track from frame `first` on."""
        part = slice(first, first + frames)
        out = Track(self.t[part] - self.t[first], self.fps)
        for name in BODY:
            setattr(out, name, getattr(self, name)[part])
        for name in (*FEET, "fingers"):
            setattr(out, name, getattr(self, name)[:, part])
        left, right = (Arm(*(values[part] for values in vars(arm).values())) for arm in self.arms)
        out.arms = (left, right)
        return out

    def hold_lower_body(self, before: Track) -> None:
        """Leave root, pelvis and feet as they are where a track ends, so that only the upper body moves."""
        for name in ("root", "yaw", "pelvis"):
            getattr(self, name)[:] = getattr(before, name)[-1]
        for name in FEET:
            getattr(self, name)[:] = getattr(before, name)[:, -1:]

    def lower_to_reach(self, seconds: float = 0.1) -> None:
        """Lower the root smoothly where a standing leg would be too short, so that feet stay in place."""
        hips = np.stack([self._pelvis_rotation() @ OFFSETS[1 + side] for side in (0, 1)])
        away = self._ankles() - hips - self.root
        flat = (away[..., [0, 2]] ** 2).sum(-1)
        limit = (LEG_REACH * (THIGH + SHIN)) ** 2
        top = self.root[:, 1] + away[..., 1] + np.sqrt(np.maximum(limit - flat, 0.01))
        # A swinging foot may lag behind; only one that stands must be reached exactly.
        over = np.where(self.ball[..., 1] < 0.02, np.minimum(top - self.root[:, 1], 0.0), 0.0).min(0)
        self.root[:, 1] += lower_envelope(over, seconds, self.fps)

    def _pelvis_rotation(self) -> Array:
        pitch, yaw, roll = self.pelvis.T
        return np.asarray(rot_y(self.yaw + yaw) @ rot_x(pitch) @ rot_z(roll))

    def _foot_rotation(self, side: int) -> Array:
        return np.asarray(rot_y(self.foot_yaw[side]) @ rot_x(self.foot_pitch[side]))

    def _ankles(self) -> Array:
        return np.stack([self.ball[s] - self._foot_rotation(s) @ OFFSETS[10 + s] for s in (0, 1)])

    def solve(self) -> Array:
        """Joint positions [T, 52, 3], metres."""
        joints, _ = forward_kinematics(self.rotations(), self.root, OFFSETS, SKELETON.parents)
        return np.asarray(joints)

    def rotations(self) -> Array:
        n = len(self.t)
        local = np.zeros((n, len(SKELETON), 3, 3))
        local[..., range(3), range(3)] = 1.0
        local[:, 0] = self._pelvis_rotation()
        share = rot_x(self.spine[:, 0] / 3) @ rot_y(self.spine[:, 1] / 3) @ rot_z(self.spine[:, 2] / 3)
        for joint in (3, 6, 9):
            local[:, joint] = share
        half = rot_y(self.head[:, 1] / 2) @ rot_x(self.head[:, 0] / 2) @ rot_z(self.head[:, 2] / 2)
        local[:, 12] = local[:, 15] = half
        ankles = self._ankles()
        for side in (0, 1):
            self._leg(local, side, ankles[side])
            self._arm(local, side)
            start = 22 + 15 * side
            hand = self.fingers[side]
            local[:, start : start + 15] = hand * _MIRROR if side else hand
        return local

    def _leg(self, local: Array, side: int, ankle: Array) -> None:
        """Two-bone IK: the knee stays in the plane through hip and ankle that faces the foot's way."""
        pelvis = local[:, 0]
        # The hinge is turned into the plane across the leg's axis, so that the knee cannot bend sideways.
        reach = ankle - (self.root + pelvis @ OFFSETS[1 + side])
        distance = np.clip(np.linalg.norm(reach, axis=-1), 0.25, 0.995 * (THIGH + SHIN))
        axis = unit(reach)
        sign = -1.0 if side else 1.0
        facing = 0.5 * (self.yaw + self.pelvis[:, 1] + self.foot_yaw[side]) + sign * self.knee_out[side]
        hinge = np.stack([np.cos(facing), np.zeros_like(facing), -np.sin(facing)], axis=-1)
        hinge = unit(hinge - (hinge * axis).sum(-1, keepdims=True) * axis)
        forward = cross(axis, hinge)
        cosine = (THIGH**2 + distance**2 - SHIN**2) / (2 * THIGH * distance)
        sine = np.sqrt(np.maximum(1 - cosine**2, 0.0))
        thigh = cosine[:, None] * axis + sine[:, None] * forward
        shin = unit(distance[:, None] * axis - THIGH * thigh)
        upper = _bone_frame(hinge, thigh) @ _bone_frame(np.array([1.0, 0, 0]), unit(OFFSETS[4 + side])).T
        lower = _bone_frame(hinge, shin) @ _bone_frame(np.array([1.0, 0, 0]), unit(OFFSETS[7 + side])).T
        local[:, 1 + side] = pelvis.swapaxes(-1, -2) @ upper
        local[:, 4 + side] = upper.swapaxes(-1, -2) @ lower
        local[:, 7 + side] = lower.swapaxes(-1, -2) @ self._foot_rotation(side)

    def _arm(self, local: Array, side: int) -> None:
        """Two-bone IK in chest coordinates; the collar lifts with the arm."""
        arm = self.arms[side]
        axis = unit(arm.direction)
        lift = np.clip(axis[:, 1] + 0.2, 0.0, 1.2) * 0.32
        forward = np.clip(axis[:, 2], -0.3, 1.0) * np.clip(arm.reach - 0.55, 0.0, 0.45) * 0.45
        # The collar takes a part of the way, so the wrist's goal is seen from the shoulder that it moved.
        collar = rot_y(-forward) @ rot_z(lift)
        shift = collar @ OFFSETS[16] - OFFSETS[16]
        distance = np.clip(arm.reach, 0.3, 0.985) * ARM
        axis = unit(axis * distance[:, None] - shift)
        bend = arm.bend - (arm.bend * axis).sum(-1, keepdims=True) * axis
        bend = unit(bend)
        cosine = (UPPER_ARM**2 + distance**2 - FOREARM**2) / (2 * UPPER_ARM * distance)
        sine = np.sqrt(np.maximum(1 - cosine**2, 0.0))
        upper_dir = cosine[:, None] * axis - sine[:, None] * bend
        fore_dir = unit(distance[:, None] * axis - UPPER_ARM * upper_dir)
        hinge = cross(bend, axis)
        up = np.array([0.0, 1.0, 0.0])
        upper = _bone_frame(hinge, upper_dir) @ _bone_frame(up, unit(OFFSETS[18])).T
        lower = _bone_frame(hinge, fore_dir) @ _bone_frame(up, unit(OFFSETS[20])).T @ rot_x(arm.roll)
        parts = (collar, collar.swapaxes(-1, -2) @ upper, upper.swapaxes(-1, -2) @ lower, rot_z(-arm.flex))
        for joint, rotation in zip((13, 16, 18, 20), parts, strict=True):
            local[:, joint + side] = rotation * _MIRROR if side else rotation


def joined(first: Track, second: Track) -> Track:
    """One track of two, where the second begins in the pose in which the first ends; the feet are set one
    after the other into new places."""
    fps = first.fps
    shared = round(OVERLAP * fps)
    start = len(first.t) - shared
    frames = len(first.t) - shared + len(second.t)
    out = Track(np.arange(frames) / fps, fps)
    turn = float(first.yaw[-1])
    cos = np.cos(turn)
    sin = np.sin(turn)

    def placed(xyz: Array) -> Array:
        x = xyz[..., 0] - old[0]
        z = xyz[..., 2] - old[1]
        moved = xyz.copy()
        moved[..., 0] = cos * x + sin * z + new[0]
        moved[..., 2] = cos * z - sin * x + new[1]
        return moved

    new = first.ball[:, -1].mean(0)[[0, 2]]
    old = second.ball[:, 0].mean(0)[[0, 2]]
    progress = (np.arange(frames) - start) / max(shared - 1, 1)

    def mixed(a: Array, b: Array, weight: Array) -> Array:
        a = np.concatenate([a, np.repeat(a[-1:], frames - len(a), axis=0)])
        b = np.concatenate([np.repeat(b[:1], frames - len(b), axis=0), b])
        return a + weight.reshape(-1, *[1] * (a.ndim - 1)) * (b - a)

    weight = ease(progress)
    out.root = mixed(first.root, placed(second.root), weight)
    out.yaw = mixed(first.yaw, second.yaw + turn, weight)
    for name in BODY[2:]:
        setattr(out, name, mixed(getattr(first, name), getattr(second, name), weight))
    for side in (0, 1):
        step = np.clip(2 * progress - side, 0.0, 1.0)
        out.ball[side] = mixed(first.ball[side], placed(second.ball[side]), ease(step))
        out.ball[side, :, 1] += 0.03 * np.sin(np.pi * step) ** 2
        out.foot_yaw[side] = mixed(first.foot_yaw[side], second.foot_yaw[side] + turn, ease(step))
        for name in FEET[2:]:
            getattr(out, name)[side] = mixed(getattr(first, name)[side], getattr(second, name)[side], weight)
        for name in vars(out.arms[side]):
            before, after = (getattr(track.arms[side], name) for track in (first, second))
            setattr(out.arms[side], name, mixed(before, after, weight))
    out.lower_to_reach()
    return out


def hanging_arm(frames: int) -> Arm:
    """An arm at rest beside the body."""
    direction, reach, bend = HANG
    return Arm(
        np.tile(direction, (frames, 1)),
        np.full(frames, reach),
        np.tile(bend, (frames, 1)),
        np.full(frames, 0.35),
        np.zeros(frames),
    )


def _bone_frame(side: Array, along: Array) -> Array:
    """Orthonormal frames [..., 3, 3] whose second column is the bone and whose first is nearest to `side`."""
    side = unit(side - (side * along).sum(-1, keepdims=True) * along)
    return np.stack([side, along, cross(side, along)], axis=-1)
