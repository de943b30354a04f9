"""Small vectorised maths of the generator: rotations about the axes, eases, key frames, smooth noise.

Everything works on whole time lines [T, ...]; matrices act on column vectors; angles are radians.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def rot_x(angle: ArrayLike) -> Array:
    """Rotations [..., 3, 3] about X; positive takes +Z towards -Y (a forward bend, toes down)."""
    return _axis(angle, 1, 2)


def rot_y(angle: ArrayLike) -> Array:
    """Rotations [..., 3, 3] about Y; positive takes +Z towards +X (a turn to the left)."""
    return _axis(angle, 2, 0)


def rot_z(angle: ArrayLike) -> Array:
    """Rotations [..., 3, 3] about Z; positive takes +X towards +Y."""
    return _axis(angle, 0, 1)


def _axis(angle: ArrayLike, i: int, j: int) -> Array:
    a = np.asarray(angle, dtype=np.float64)
    out = np.zeros((*a.shape, 3, 3))
    out[..., range(3), range(3)] = 1.0
    c = np.cos(a)
    s = np.sin(a)
    out[..., i, i] = c
    out[..., j, j] = c
    out[..., i, j] = -s
    out[..., j, i] = s
    return out


def unit(v: Array) -> Array:
    """Vectors [..., 3] at length one."""
    return np.asarray(v / np.maximum(np.sqrt((v * v).sum(-1, keepdims=True)), 1e-9))


def cross(a: Array, b: Array) -> Array:
    """Cross product [..., 3]; several times faster than `np.cross` on short arrays."""
    ax = a[..., 0]
    ay = a[..., 1]
    az = a[..., 2]
    bx = b[..., 0]
    by = b[..., 1]
    bz = b[..., 2]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def ease(x: ArrayLike) -> Array:
    """Minimum-jerk ease from 0 to 1; flat outside."""
    x = np.clip(np.asarray(x, dtype=np.float64), 0.0, 1.0)
    return np.asarray(x * x * x * (10.0 + x * (6.0 * x - 15.0)))


def keys(t: Array, times: Sequence[float] | Array, values: ArrayLike) -> Array:
    """Key frames: minimum-jerk from key to key, constant outside.

    t [T] seconds, times [K] ascending, values [K] or [K, ...] -> [T] or [T, ...].
    """
    at = np.asarray(times, dtype=np.float64)
    val = np.asarray(values, dtype=np.float64)
    index = np.clip(np.searchsorted(at, t, side="right") - 1, 0, len(at) - 2)
    span = np.maximum(at[index + 1] - at[index], 1e-6)
    weight = ease((t - at[index]) / span).reshape(-1, *[1] * (val.ndim - 1))
    return np.asarray(val[index] + weight * (val[index + 1] - val[index]))


def smooth(x: Array, seconds: float, fps: float) -> Array:
    """Gaussian smoothing over time, ends held."""
    from scipy.ndimage import gaussian_filter1d

    return np.asarray(gaussian_filter1d(x, max(seconds * fps, 1e-3), axis=0, mode="nearest"))


def lower_envelope(x: Array, seconds: float, fps: float) -> Array:
    """A smooth curve [T] never above x [T]: running minimum, then an average over the same window."""
    from scipy.ndimage import minimum_filter1d

    half = max(1, round(seconds * fps))
    size = 2 * half + 1
    low = minimum_filter1d(x, size, mode="nearest")
    window = np.hanning(size + 2)[1:-1]
    padded = np.concatenate([np.full(half, low[0]), low, np.full(half, low[-1])])
    return np.convolve(padded, window / window.sum(), mode="valid")


def wander(t: Array, rng: np.random.Generator, channels: int, scale: float) -> Array:
    """Slow smooth noise [T, channels] of standard deviation about `scale`: three sines of 0.1-0.7 Hz each."""
    rate = rng.uniform(0.1, 0.7, (3, channels))
    phase = rng.uniform(0, 2 * np.pi, (3, channels))
    waves = np.sin(2 * np.pi * rate[:, None] * t[None, :, None] + phase[:, None])
    return np.asarray(waves.sum(0) * (scale * 0.8))
