"""A calm stand, put into motions of every layout."""

from __future__ import annotations

import numpy as np
import pytest

from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.pipeline.inference.generators.idle_pose import EASE, blend_to_idle

FPS = 20
MOVING = ("body133", "wholebody363", "h3d263", "tomato623", "smpl75", "smplx322")


@pytest.mark.parametrize("name", MOVING)
def test_somebody_stands(name: str) -> None:
    layout = MotionLayout.named(name, fps=FPS)
    wild = np.random.default_rng(0).normal(0, 0.2, (200, layout.dim)).astype(np.float32)
    joints = joints_of(blend_to_idle(wild, [True], [200], layout, "all"), layout)
    speed = np.linalg.norm(np.diff(joints, axis=0), axis=-1) * FPS
    assert speed.max() < 1e-3, "metres a second"
    skeleton = layout.skeleton
    high = joints[:, :, 1] - joints[:, [10, 11], 1].min(axis=1, keepdims=True)
    if layout.family != "raw":  # parameters keep their own turn in space
        for side in ("left", "right"):
            assert (high[:, skeleton.index(f"{side}_wrist")] < high[:, skeleton.index("spine2")]).all()
        assert (high.argmax(axis=1) == skeleton.index("head")).all()


@pytest.mark.parametrize("name", MOVING)
def test_it_is_eased_into_and_out_of(name: str) -> None:
    layout = MotionLayout.named(name, fps=FPS)
    rng = np.random.default_rng(1)
    pieces = [rng.normal(0, 0.1, (count, layout.dim)).astype(np.float32) for count in (30, 60, 50)]
    ease, whole = round(EASE * FPS), np.concatenate(pieces)
    made = np.split(blend_to_idle(whole, [False, True, False], [30, 60, 50], layout, "all"), [30, 90])
    assert np.array_equal(made[0], pieces[0])
    assert np.array_equal(made[2][ease:], pieces[2][ease:])
    share = np.abs(made[1] - pieces[1]).mean(axis=1)
    assert share[0] < 0.1 * share[ease:].mean()
