"""Recognise hand shapes on joints: finger curl, fan, thumb distance and rhythm.

Finger order is SMPL-X's: index, middle, pinky, ring, thumb, three joints each. Limits lie between the shapes
of the synthetic source (`datasets/synth/hands_and_face.py`), the only clips whose shapes are known.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
HANDS = ("relaxed", "fist", "point", "spread", "pinch", "wave_fingers")
SIDES = ("left", "right")

_INDEX, _MIDDLE, _PINKY, _RING, _THUMB = range(5)


def curls(joints: NDArray[np.floating], side: int) -> Array:
    """Curl [T, 4] of index, middle, pinky, ring in radians: the turn from the palm to the last bone."""
    wrist, hand = _hand(joints, side)
    palm = hand[:, :4, 0] - wrist[:, None]
    last = hand[:, :4, 2] - hand[:, :4, 1]
    return _angle(palm, last)


def hand_shape(joints: NDArray[np.floating], side: int, fps: float) -> str:
    """Shape of the left (0) or right (1) hand over a clip of joints [T, 52, 3]; a name of `HANDS`."""
    from scipy.ndimage import gaussian_filter1d

    x = gaussian_filter1d(np.asarray(joints, dtype=np.float64), max(0.03 * fps, 0.3), axis=0, mode="nearest")
    curl = curls(x, side)
    start = min(int(0.5 * fps), len(curl) // 4)
    curl = curl[start:]
    if curl.std(0).mean() > 0.3:
        return "wave_fingers"
    wrist, hand = (part[start:] for part in _hand(x, side))
    index, middle, pinky, ring = np.median(curl, axis=0)
    size = np.linalg.norm(hand[:, _MIDDLE, 0] - wrist, axis=-1)
    pinch = np.median(
        np.linalg.norm(hand[:, _THUMB, 2] - hand[:, _INDEX, 2], axis=-1) / np.maximum(size, 1e-6)
    )
    fan = np.median(_angle(hand[:, _INDEX, 1] - hand[:, _INDEX, 0], hand[:, _PINKY, 1] - hand[:, _PINKY, 0]))
    others = (middle + pinky + ring) / 3
    if others > 1.7:
        return "point" if index < 1.2 else "fist"
    if pinch < 0.5 and index > others + 0.3:
        return "pinch"
    if others < 0.45 and index < 0.45 and fan > 0.45:
        return "spread"
    return "relaxed"


def _hand(joints: NDArray[np.floating], side: int) -> tuple[Array, Array]:
    """Wrist [T, 3] and finger joints [T, 5, 3, 3] (index, middle, pinky, ring, thumb)."""
    start = 22 + 15 * side
    x = np.asarray(joints, dtype=np.float64)
    return x[:, 20 + side], x[:, start : start + 15].reshape(len(x), 5, 3, 3)


def _angle(a: Array, b: Array) -> Array:
    norm = np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1)
    return np.asarray(np.arccos(np.clip((a * b).sum(-1) / np.maximum(norm, 1e-12), -1.0, 1.0)))
