"""Where a motion changes its conditions: does it jerk there, or go on as it does elsewhere (UDE section 4.4).

The paper shows such transitions in pictures only. Two figures say it in numbers **[ours]**: how strongly the
joints accelerate at a border, and how fast the root moves there, each as the percentile among the frames
inside the segments of the same motion. 0.5 is like everywhere else; 1 is stronger than anywhere.

Legend: T frames, N joints, K borders.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.schema import UserError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TransitionPercentiles:
    """Of each border [K], how its figures lie among those of the inside: shares, 0 to 1."""

    acceleration: Array
    """Of the joints, mean over them."""
    root_velocity: Array
    """Of the root, in all directions."""


def transition_percentiles(
    joints: NDArray[np.floating], borders: Sequence[int], fps: float, *, reach: int = 2
) -> TransitionPercentiles:
    """How borders compare with the inside of the segments of one motion.

    A border's figure is the largest one within `reach` frames of it **[ours]**, so a jerk that comes a frame
    late counts. The inside is measured alike, by the largest figures of equally long stretches that reach no
    border: else a maximum would be compared with single frames.

    Args:
        joints: [T, N, 3] in metres, joint 0 is the root.
        borders: First frames of the segments from the second on.
        fps: Frames a second; percentiles do not depend on it, it keeps the figures in m/s and m/s^2.
        reach: Frames to either side.
    """
    x = np.asarray(joints, dtype=np.float64)
    frames = len(x)
    if x.ndim != 3 or frames < 3 or reach < 1:
        raise UserError(
            f"transitions need joints [T >= 3, N, 3] and a reach of 1 or more, got {list(x.shape)}, {reach}"
        )
    wrong = [border for border in borders if not 1 <= border < frames]
    if wrong or not len(borders):
        raise UserError(f"borders {list(borders)} of {frames} frames: each must be from 1 to {frames - 1}")
    pull, speed = accelerations(x, fps), root_speeds(x, fps)
    centres = np.arange(reach, frames - reach)
    away = np.abs(centres[:, None] - np.asarray(borders)[None]).min(1)
    inside = centres[away > 2 * reach]
    if not len(inside):
        raise UserError(
            f"borders {list(borders)} of {frames} frames leave no inside {2 * reach} frames away from them"
        )
    return TransitionPercentiles(*(_percentiles(values, borders, inside, reach) for values in (pull, speed)))


def accelerations(joints: NDArray[np.floating], fps: float) -> Array:
    """Mean over the joints of |acceleration| in m/s^2, [T]; the ends repeat their neighbours."""
    second = np.diff(np.asarray(joints, dtype=np.float64), n=2, axis=0) * fps**2
    inner = np.linalg.norm(second, axis=-1).mean(1)
    return np.concatenate([inner[:1], inner, inner[-1:]])


def root_speeds(joints: NDArray[np.floating], fps: float) -> Array:
    """|velocity| of the root in m/s, [T], of the step to each frame; frame 0 repeats frame 1."""
    steps = np.linalg.norm(np.diff(np.asarray(joints, dtype=np.float64)[:, 0], axis=0), axis=-1) * fps
    return np.concatenate([steps[:1], steps])


def _percentiles(values: Array, borders: Sequence[int], inside: NDArray[np.int64], reach: int) -> Array:
    """Mid-ranks: equal values count half, so a motion that never changes is at 0.5."""
    usual = _largest(values, inside, reach)
    found = _largest(values, np.asarray(borders), reach)
    below = (usual[None] < found[:, None]).mean(1)
    equal = (usual[None] == found[:, None]).mean(1)
    return np.asarray(below + equal / 2)


def _largest(values: Array, centres: NDArray[np.int64], reach: int) -> Array:
    """Largest of `values` [T] within `reach` frames of each centre."""
    padded = np.pad(values, reach, constant_values=-np.inf)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1)
    return np.asarray(windows[centres].max(-1))
