"""A user's BVH that is written anew in part: kept rows as they were, made ones where the joints are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.bvh.joint_map import JointMap
from motionloom.datasets.motion.bvh.motion import read_bvh
from motionloom.datasets.motion.bvh.own_file import OwnBvh
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.editing.own_file import with_made

BODY = Skeleton.named("smpl22")
FRAMES, FPS = 151, 60


def head(rng: np.random.Generator, joint: int, scale: float) -> list[str]:
    """The lines of a joint and all below; some bones have a joint in their middle that no map names."""
    order = " ".join(f"{axis}rotation" for axis in rng.permutation(list("XYZ")))
    root, offset = joint == 0, BODY.offsets[joint] * scale
    extra = not root and rng.random() < 0.3
    offset = offset / 2 if extra else offset
    place = "OFFSET " + " ".join(f"{value:.5f}" for value in offset)
    below = [child for child, parent in enumerate(BODY.parents) if parent == joint]
    lines = [line for child in below for line in head(rng, child, scale)] or ["End Site", "{", place, "}"]
    channels = f"CHANNELS 6 Zposition Xposition Yposition {order}" if root else f"CHANNELS 3 {order}"
    kind = "ROOT" if root else "JOINT"
    lines = [f"{kind} {BODY.joints[joint]}", "{", place, channels, *lines, "}"]
    return [f"JOINT mid_{joint}", "{", place, f"CHANNELS 3 {order}", *lines, "}"] if extra else lines


def file_of(rng: np.random.Generator, up: str, added: int) -> tuple[OwnBvh, np.ndarray]:
    """A smooth clip, and its values."""
    scale = float(rng.choice([1.0, 100.0]))
    text = ["HIERARCHY", *head(rng, 0, scale), "MOTION", f"Frames:\t{FRAMES}", "Frame Time: 0.0166667"]
    width = sum(int(line.split()[1]) for line in text if line.startswith("CHANNELS"))
    phase, speed = rng.uniform(0, 6, width), rng.uniform(0.5, 3, width)
    values = 20 * np.sin(np.arange(FRAMES)[:, None] / FPS * speed + phase)
    values[:, :3] *= scale / 20
    values[:, 3] += np.linspace(0, float(rng.choice([0, -1100, 1100])), FRAMES)  # a spin
    rows = [" ".join(f"{value:.9g}" for value in row) for row in values]
    data = "\n".join([*text, *rows, ""]).encode()
    names = JointMap("map", BODY, tuple((name,) for name in BODY.joints))
    return OwnBvh(data, read_bvh(data), names, 1 / scale, "z" if up == "z" else "y", added), values


@pytest.mark.parametrize(("seed", "up", "added"), [(0, "y", 0), (1, "z", 0), (2, "y", 3), (3, "z", 6)])
def test_kept_rows_stay_text_and_made_rows_pose_the_joints(seed: int, up: str, added: int) -> None:
    rng = np.random.default_rng(seed)
    own, values = file_of(rng, up, added)
    bump = np.sin(np.pi * np.clip((np.arange(FRAMES) - added - 48) / 48, 0, 1))[:, None]
    size = np.r_[[0.02 / own.unit] * 3, np.full(values.shape[1] - 3, 1.0)] * 15
    other = replace(own.motion, values=values + bump * rng.uniform(-1, 1, values.shape[1]) * size)
    joints = own.joint_map.apply(other, unit=own.unit, up=own.up)[added::3]
    kept = np.ones((len(joints), 22), dtype=bool)
    kept[17:32] = False
    made = with_made(own, joints, 20.0, 0, kept, None)
    before, after = (one.data.partition(b"MOTION") for one in (own, made))
    assert before[0] == after[0] and before[2].split(b"\n")[:3] == after[2].split(b"\n")[:3]
    same = [a == b for a, b in zip(*(part[2].split(b"\n")[3:] for part in (before, after)), strict=True)]
    assert np.flatnonzero(~np.array(same)).tolist() == list(range(added + 51, added + 96))
    found = made.joint_map.apply(made.motion, unit=own.unit, up=own.up)[added::3]
    away = np.linalg.norm(found - joints, axis=-1).max(axis=1)
    assert np.delete(away, slice(17, 22)).max() < 0.003 and away.max() < 0.2, "behind kept rows"
    angles = made.motion.values[added + 50 : added + 97, 3:]
    steps = np.abs(np.diff(angles, axis=0))
    assert steps[:-1].max() < 180, "no made row spins"
    assert np.abs(steps[-1] - 360 * np.round(steps[-1] / 360)).max() < 30, "a turn or none"
    # Kept legs keep their numbers in every row, where they are the file's.
    legs = kept | np.isin(np.arange(22), [0, 1, 2, 4, 5, 7, 8, 10, 11])
    legs_made = with_made(own, joints, 20.0, 0, legs, None).motion
    hips = [0, legs_made.joints.index("left_hip")]
    np.testing.assert_array_equal(legs_made.local_rotations(hips), own.motion.local_rotations(hips))
    more, kept_more = np.concatenate([joints, joints[-1:]]), np.vstack([kept, kept[17:18]])
    longer = with_made(own, more, 20.0, 0, kept_more, 3.0)
    assert longer.motion.frames == added + 180
    with pytest.raises(UserError, match="no frame is kept"):
        with_made(own, joints, 20.0, 0, ~kept & False, None)
