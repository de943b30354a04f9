"""From 50 expression values to the five controls the viewer's face is drawn with.

The controls are read along the synthetic source's expression directions (`datasets/synth/face.py`). Expressions fitted
with FLAME's own basis have other directions; their faces move, but what they show is not to be trusted.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.synth.face import APEX, BASIS


def face_controls(face: NDArray[Any]) -> NDArray[np.float64]:
    """Expression [T, 50] -> smile, brow, eye-open, mouth-open, frown [T, 5]; neutral is (0, 0, 1, 0, 0)."""
    weights = np.asarray(face, dtype=np.float64) @ BASIS[:, :5]
    happy, sad, angry, surprised = np.clip(weights[:, :4] / APEX, 0.0, 1.3).T
    blink = np.clip(weights[:, 4] / 1.6, 0.0, 1.0)
    smile = happy - 0.9 * sad - 0.5 * angry
    brow = surprised - angry + 0.35 * sad
    eyes = (1.0 + 0.45 * surprised - 0.25 * happy - 0.2 * sad) * (1.0 - blink)
    mouth = 0.9 * surprised + 0.3 * happy
    frown = angry + 0.5 * sad
    return np.stack([smile, brow, eyes, mouth, frown], axis=1)
