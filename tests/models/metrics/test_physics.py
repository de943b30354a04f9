"""Physics of motions whose answers are known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from motionloom.datasets.schema import UserError
from motionloom.models.metrics.physics import physics

FPS = 20.0


def standing(frames: int = 40) -> NDArray[np.float64]:
    """Twelve joints one above the other, both feet and toes on the floor."""
    joints = np.zeros((frames, 12, 3))
    joints[:, :, 1] = np.linspace(1.0, 0.1, 12)
    joints[:, [7, 8, 10, 11], 1] = 0.0
    return joints


def test_one_who_stands_does_nothing_wrong() -> None:
    assert physics(standing(), FPS) == (0.0, 0.0, 0.0, 0.0)


def test_height_and_depth_are_millimetres() -> None:
    up, down, both = standing(), standing(), standing()
    up[..., 1] += 0.03
    down[..., 1] -= 0.02
    both[:10, :, 1] += 0.03
    both[10:20, :, 1] -= 0.02
    both[20:, :, 1] += 0.004  # on the floor, as far as it is known
    assert physics(up, FPS)[1:3] == pytest.approx((30.0, 0.0))
    assert physics(down, FPS)[1:3] == pytest.approx((0.0, 20.0))
    assert physics(both, FPS)[1:3] == pytest.approx((7.5, 5.0))


def test_jitter_is_the_third_derivative() -> None:
    """x = t^3 has the jerk 6 everywhere; a parabola has none."""
    t = np.arange(40) / FPS
    joints = standing()
    joints[..., 0] += t[:, None] ** 3
    assert physics(joints, FPS).jitter == pytest.approx(0.06, rel=1e-6)
    joints = standing()
    joints[..., 2] += t[:, None] ** 2
    assert physics(joints, FPS).jitter == pytest.approx(0.0, abs=1e-9)


def test_sliding_is_not_standing() -> None:
    joints = standing()
    joints[..., 0] += (np.arange(40) / FPS)[:, None]  # a metre a second
    assert physics(joints, FPS).skating == 1.0


def test_frame_rate_plays_no_part_in_what_is_done() -> None:
    found = []
    for fps in (60, 120):
        t = np.arange(3 * fps) / fps
        joints = standing(3 * fps)
        joints[..., 1] += 0.1 * (1 - np.cos(2 * np.pi * t))[:, None]
        found.append(physics(joints, float(fps)))
    assert found[0].jitter == pytest.approx(found[1].jitter, rel=0.02)
    assert found[0].floating == pytest.approx(found[1].floating, rel=0.02)


def test_what_is_no_body_is_refused() -> None:
    for shape in ((3, 22, 3), (40, 8, 3), (40, 22), (40, 22, 2)):
        with pytest.raises(UserError, match=r"needs joints \[T >= 4, N >= 12, 3\]"):
            physics(np.zeros(shape), FPS)
