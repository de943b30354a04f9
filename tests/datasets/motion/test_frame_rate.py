"""Frame rates that cannot be true, by jumps and steps whose true rate is known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from motionloom.datasets.convert.bvh.joint_guess.guess import guess_joint_map
from motionloom.datasets.motion.bvh.motion import read_bvh
from motionloom.datasets.motion.plausibility import wrong_rate
from motionloom.datasets.motion.skeleton import Skeleton

REST = Skeleton.named("smpl22").rest_joints
REST = REST - [0.0, REST[:, 1].min(), 0.0]
FPS = 60.0


def jumps(count: int) -> NDArray[np.float64]:
    """Leaps of 0.4 s in free fall between stands."""
    times = np.arange(int(FPS * 0.4) + 1) / FPS
    leap = 0.5 * 9.81 * times * (0.4 - times)
    heights = np.concatenate([np.zeros(30), *[np.r_[leap, np.zeros(30)]] * count])
    return REST + heights[:, None, None] * [0.0, 1.0, 0.0]


def walk(steps: int) -> NDArray[np.float64]:
    """Feet that take turns: 0.45 s of swing for 1.2 m, while the other one stands."""
    swing = round(0.45 * FPS)
    joints = np.repeat(REST[None], steps * swing + 40, axis=0)
    ease = 0.6 - 0.6 * np.cos(np.linspace(0, np.pi, swing))
    for step in range(steps):
        foot = [
            Skeleton.named("smpl22").index(f"{('left', 'right')[step % 2]}_{j}") for j in ("ankle", "foot")
        ]
        at = 20 + step * swing
        joints[at : at + swing, foot, 2] += ease[:, None]
        joints[at + swing :, foot, 2] += 1.2
    return joints


@pytest.mark.parametrize(
    ("joints", "stated", "says"),
    [
        (jumps(1), 60.0, ""),
        (jumps(1), 120.0, "about 60 rather than 120"),
        (jumps(1), 90.0, "about 60 rather than 90"),
        (jumps(1), 30.0, ""),  # one slow rise may be a climber's
        (jumps(4), 30.0, "about 60 rather than 30"),
        (walk(8), 60.0, ""),
        (walk(8), 120.0, "may be half of 120"),
        (walk(2), 120.0, ""),
        (np.repeat(REST[None], 50, axis=0), 120.0, ""),
        (REST[None], 120.0, ""),
    ],
)
def test_falls_and_steps_tell_the_rate(joints: Any, stated: float, says: str) -> None:
    found = wrong_rate(joints, stated)
    assert says in found and bool(found) == bool(says)


def test_real_files_are_judged_by_their_own_falls(shared: Path) -> None:
    """A dance that is stated at 120 fps: its thirteen flights, and the same at half the rate."""
    motion = read_bvh(shared / "data/real/odd_bvh/virvig_dancedb_metres.bvh")
    joint_map = guess_joint_map(motion, Skeleton.named("smpl22")).joint_map("guess")
    joints = joint_map.apply(motion, unit="m", up="z")
    assert motion.fps == 120 and "about 60" in wrong_rate(joints, motion.fps)
    assert wrong_rate(joints, 60.0) == ""
