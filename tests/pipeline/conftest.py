"""A procedural 52-joint walker for the drawing tests: limbs, curling fingers, a curved path, a face."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from motionloom.datasets.motion.skeleton import Skeleton

Joints = NDArray[np.float64]


def _walk(
    frames: int = 60, fps: float = 20.0, turn: float = 0.5, wave: bool = False, curl: float = 1.0
) -> Joints:
    skeleton = Skeleton.named("smplx52")
    t = np.arange(frames) / fps
    stride = np.sin(2 * np.pi * 0.9 * t)
    local = {name: Rotation.identity(frames) for name in skeleton.joints}

    def about(axis: str, angle: Any) -> Rotation:
        return Rotation.from_euler(axis, np.broadcast_to(np.asarray(angle, float), (frames,))[:, None])

    for side, sign in (("left", 1.0), ("right", -1.0)):
        swing = sign * stride
        local[f"{side}_hip"] = about("x", -0.5 * swing)
        local[f"{side}_knee"] = about(
            "x", 0.25 + 0.45 * (1 + np.cos(2 * np.pi * 0.9 * t + (sign - 1) * np.pi / 2 + 0.5)) / 2
        )
        local[f"{side}_shoulder"] = about("x", 0.5 * swing) * about("z", -sign * 1.25)
        local[f"{side}_elbow"] = about("y", -sign * (0.45 + 0.2 * swing))
        for finger in ("index", "middle", "pinky", "ring"):
            bend = curl * (0.35 + 0.35 * np.sin(2 * np.pi * 0.5 * t))
            for k in (1, 2, 3):
                local[f"{side}_{finger}{k}"] = about("z", -sign * bend)
    if wave:
        local["left_shoulder"] = about("z", 0.75)
        local["left_elbow"] = about("z", 0.9 + 0.5 * np.sin(2 * np.pi * 1.6 * t))
    heading = turn * t
    local["pelvis"] = about("y", heading)
    glob: list[Rotation] = []
    joints = np.zeros((frames, len(skeleton), 3))
    for j, parent in enumerate(skeleton.parents):
        here = local[skeleton.joints[j]]
        glob.append(here if parent < 0 else glob[parent] * here)
        if parent >= 0:
            joints[:, j] = joints[:, parent] + glob[parent].apply(skeleton.offsets[j])
    joints[..., 1] -= joints[:, 10:12, 1].min(axis=1)[:, None]
    speed = np.stack([np.sin(heading), 0 * t, np.cos(heading)], -1) * 1.1 / fps
    path = np.cumsum(speed, axis=0)
    return joints + (path - path[0])[:, None]


@pytest.fixture(scope="session")
def walk() -> Callable[..., Joints]:
    """`walk(frames, fps, turn, wave, curl) -> joints [T, 52, 3]` metres."""
    return _walk


@pytest.fixture(scope="session")
def face_track() -> Callable[[int], Joints]:
    """Face controls [T, 5] that smile, frown, blink and open the mouth in turn."""

    def track(frames: int) -> Joints:
        phase = np.linspace(0, 4 * np.pi, frames)
        smile, frown = np.clip(np.sin(phase), 0, 1), np.clip(-np.sin(phase), 0, 1)
        return np.stack(
            [
                smile,
                np.cos(phase),
                1 - 0.9 * (np.sin(5 * phase) > 0.97),
                np.clip(np.sin(2 * phase), 0, 1),
                frown,
            ],
            -1,
        )

    return track
