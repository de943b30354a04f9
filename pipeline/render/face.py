"""From expression coefficients to the five controls of the drawn face.

Only the synthetic source's basis has a public meaning (happy, sad, angry, surprised, blink; it stands in
`datasets.synth.face`). FLAME coefficients of licensed data follow another basis: their faces stay neutral
unless the caller brings controls.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.synth.face import APEX, BASIS
from motionloom.pipeline.render.body.face import BLINK_HEIGHT


def synthetic_face_controls(expression: NDArray[Any]) -> NDArray[np.float64]:
    """Synthetic expression [T, 50] to controls [T, 5]: smile, brow, eye-open, mouth-open, frown."""
    weights = np.asarray(expression, np.float64) @ BASIS
    happy, sad, angry, surprised = np.clip(weights[:, :4] / APEX, 0, 1.2).T
    blink = np.clip(weights[:, 4] / BLINK_HEIGHT, 0, 1)
    open_eyes = 1 + 0.6 * surprised - 0.25 * happy - 0.15 * sad - 0.2 * angry
    return np.stack(
        [
            happy,
            surprised + 0.35 * sad - 0.9 * angry,
            open_eyes * (1 - blink),
            np.clip(0.9 * surprised + 0.25 * happy, 0, 1.2),
            np.maximum(sad, 0.6 * angry),
        ],
        axis=-1,
    )
