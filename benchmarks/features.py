"""Frames per second of the feature encoders: `OMP_NUM_THREADS=1 python -P benchmarks/features.py`.

One line a case: layout, family, clips in the call, encode and decode in thousand frames a second (median).
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.canonical import canonicalize
from motionloom.datasets.motion.features.codec import decode, encode
from motionloom.datasets.motion.layout import Family, MotionLayout
from motionloom.datasets.motion.skeleton import Skeleton

FRAMES = 196
CASES: tuple[tuple[str, Family], ...] = (
    ("body133", "exact"),
    ("wholebody313", "exact"),
    ("body133", "h3d"),
    ("h3d263", "h3d"),
    ("tomato623", "h3d"),
)


def clips(skeleton: Skeleton, count: int) -> NDArray[np.float64]:
    """Clips [count, FRAMES, N, 3] of a swaying figure that drifts along."""
    rng = np.random.default_rng(0)
    time_axis = np.arange(FRAMES)[:, None, None] / 20.0
    phase = rng.uniform(0, 6, size=(count, 1, len(skeleton), 3))
    sway = 0.05 * np.sin(4.0 * time_axis + phase)
    return np.asarray(canonicalize(skeleton.rest_joints + sway + time_axis * [0.3, 0.0, 1.0]))


def rate(call: Callable[[], object], frames: int, repeats: int = 7) -> float:
    """Thousand frames a second, median."""
    call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return frames / statistics.median(times) / 1e3


def main() -> None:
    print(f"{'layout':14}{'family':8}{'clips':>6}{'encode k/s':>12}{'decode k/s':>12}")
    for name, family in CASES:
        layout = MotionLayout.named(name, family=family)
        for count in (1, 32):
            joints = clips(layout.skeleton, count)
            features = encode(joints, layout)
            coding = rate(lambda j=joints, m=layout: encode(j, m), count * FRAMES)  # type: ignore[misc]
            decoding = rate(lambda f=features, m=layout: decode(f, m), count * FRAMES)  # type: ignore[misc]
            print(f"{name:14}{family:8}{count:6d}{coding:12.0f}{decoding:12.0f}")


if __name__ == "__main__":
    main()
