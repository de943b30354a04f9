"""Borders of segments against the inside, on motions whose answer is known, and against a slow version."""

from __future__ import annotations

import numpy as np
import pytest

from motionloom.datasets.schema import UserError
from motionloom.models.metrics.transitions import accelerations, root_speeds, transition_percentiles

FPS = 20.0


def wander(frames: int = 120, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    smooth = rng.standard_normal((frames + 8, 5, 3)).cumsum(0)
    return np.stack([smooth[i : i + 9].mean(0) for i in range(frames)]) * 0.02


def slow(values: list[float], borders: list[int], reach: int) -> list[float]:
    """The definition, word by word."""

    def largest(centre: int) -> float:
        return max(v for t, v in enumerate(values) if abs(t - centre) <= reach)

    usual = [
        largest(centre)
        for centre in range(reach, len(values) - reach)
        if all(abs(centre - border) > 2 * reach for border in borders)
    ]
    return [
        sum(1.0 if u < largest(b) else 0.5 if u == largest(b) else 0.0 for u in usual) / len(usual)
        for b in borders
    ]


@pytest.mark.parametrize("reach", [1, 2, 5])
def test_equals_the_slow_version(reach: int) -> None:
    joints, borders = wander(), [1, 40, 71, 119]
    found = transition_percentiles(joints, borders, FPS, reach=reach)
    pull = [0.0] * 120
    for t in range(1, 119):
        step = (joints[t + 1] - 2 * joints[t] + joints[t - 1]) * FPS**2
        pull[t] = float(np.mean([np.sqrt((row**2).sum()) for row in step]))
    pull[0], pull[-1] = pull[1], pull[-2]
    speed = [float(np.sqrt(((joints[t, 0] - joints[t - 1, 0]) ** 2).sum())) * FPS for t in range(1, 120)]
    speed = [speed[0], *speed]
    np.testing.assert_allclose(accelerations(joints, FPS), pull, rtol=1e-9)
    np.testing.assert_allclose(root_speeds(joints, FPS), speed, rtol=1e-9)
    np.testing.assert_allclose(found.acceleration, slow(pull, borders, reach), rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.root_velocity, slow(speed, borders, reach), rtol=0, atol=1e-12)


def test_a_jump_stands_out_and_a_smooth_border_does_not() -> None:
    joints = wander()
    calm = transition_percentiles(joints, [60], FPS)
    joints[60:] += 0.5
    jump = transition_percentiles(joints, [60], FPS)
    assert jump.acceleration.tolist() == jump.root_velocity.tolist() == [1.0]
    assert calm.acceleration[0] < 1 and calm.root_velocity[0] < 1


def test_a_stop_of_the_root_is_at_the_low_end() -> None:
    joints = wander()
    joints[55:66] = joints[55]
    assert transition_percentiles(joints, [60], FPS).root_velocity.tolist() == [0.0]


def test_where_nothing_changes_borders_are_like_the_inside() -> None:
    still = np.ones((50, 3, 3))
    found = transition_percentiles(still, [10, 30], FPS)
    assert found.acceleration.tolist() == found.root_velocity.tolist() == [0.5, 0.5]


def test_random_borders_are_spread_evenly() -> None:
    """Where borders mean nothing, percentiles are uniform: mean 1/2, deviation 1/sqrt(12)."""
    found = np.concatenate(
        [transition_percentiles(wander(seed=seed), [30, 60, 90], FPS).acceleration for seed in range(60)]
    )
    assert found.mean() == pytest.approx(0.5, abs=4 / np.sqrt(12 * len(found)))
    assert found.std() == pytest.approx(1 / np.sqrt(12), abs=0.05)


def test_the_frame_rate_plays_no_part() -> None:
    one, two = (transition_percentiles(wander(), [60], fps) for fps in (20.0, 60.0))
    assert one.acceleration == two.acceleration and one.root_velocity == two.root_velocity


def test_mistakes_are_named() -> None:
    for borders in ([], [0], [120]):
        with pytest.raises(UserError, match="each must be from 1 to 119"):
            transition_percentiles(wander(), borders, FPS)
    with pytest.raises(UserError, match="leave no inside 4 frames away"):
        transition_percentiles(wander(12), [4, 8], FPS)
    with pytest.raises(UserError, match=r"joints \[T >= 3, N, 3\]"):
        transition_percentiles(wander(2), [1], FPS)
