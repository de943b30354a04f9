"""An orthonormal basis of 50 FLAME-like expression values, and the emotion that values show.

FLAME's own expression basis is licensed, so this one is fixed here: column k of `BASIS` is a damped cosine
(most of it in the first components, as in a PCA basis), made orthonormal by QR. Columns 0-3 are happy, sad,
angry and surprised, column 4 is the blink, columns 5-7 small talk-like movement. An emotion at its apex has
length about `APEX`, so single values are of the order of a standard normal.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.layout import FACE_DIMS

FACES = ("neutral", "happy", "sad", "angry", "surprised")
APEX = 6.0
THRESHOLD = 0.35 * APEX
"""Below this length along every emotion a face is neutral."""


_INDEX = np.arange(FACE_DIMS)
_WAVES = [np.cos(np.pi * (_INDEX + 0.5) * (k + 1) / 24) * np.exp(-_INDEX / 18) for k in range(8)]
_Q, _R = np.linalg.qr(np.stack(_WAVES).T)
BASIS: NDArray[np.float64] = _Q * np.sign(np.diag(_R))
"""Orthonormal columns [50, 8]; see the module's description."""


def emotion_of(face: NDArray[np.floating]) -> str:
    """Return the emotion of expression values [T, 50]: the direction with the longest apex, or neutral."""
    along = np.percentile(np.asarray(face) @ BASIS[:, :4], 75, axis=0)
    best = int(np.argmax(along))
    return FACES[1 + best] if along[best] > THRESHOLD else "neutral"
