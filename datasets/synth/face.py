"""Face expressions as trajectories of 50 FLAME-like values, and the classifier that reads them back.

FLAME's own expression basis is licensed, so the generator fixes its own: column k of `BASIS` is a damped
cosine (most of it in the first components, as in a PCA basis), made orthonormal by QR. Columns 0-3 are happy,
sad, angry and surprised, column 4 is the blink, columns 5-7 small talk-like movement. An emotion at its apex
has length about `APEX`, so single values are of the order of a standard normal.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.layout import FACE_DIMS
from motionloom.datasets.synth.actions.maths import Array, ease, wander
from motionloom.datasets.synth.actions.truth import FACES

APEX = 6.0
THRESHOLD = 0.35 * APEX
"""Below this length along every emotion a face is neutral."""
_BLINK, _TALK = 4, slice(5, 8)


def _basis(count: int) -> Array:
    index = np.arange(FACE_DIMS)
    waves = [np.cos(np.pi * (index + 0.5) * (k + 1) / 24) * np.exp(-index / 18) for k in range(count)]
    q, r = np.linalg.qr(np.stack(waves).T)
    return np.asarray(q * np.sign(np.diag(r)))


BASIS = _basis(8)
"""Orthonormal columns [50, 8]; see the module's description."""
DETAIL = _basis(22)[:, 8:]
"""Orthonormal columns [50, 14] across those of `BASIS`, for what recorded faces do beside them."""


def express(emotion: str, t: Array, rng: np.random.Generator) -> Array:
    """Expression values [T, 50] of one emotion: onset, apex, offset, blinks and small movement on top."""
    seconds = float(t[-1]) if len(t) > 1 else 1.0
    weights = _idle(t, rng)
    if emotion != "neutral":
        onset, begin = rng.uniform(0.15, 0.5), rng.uniform(-0.3, 0.15 * seconds)
        release = seconds - rng.uniform(-0.5, 0.12 * seconds)
        left = rng.uniform(0.2, 0.7)
        shape = ease((t - begin) / onset) * (1 - (1 - left) * ease((t - release) / 0.4))
        strength = APEX * rng.uniform(0.75, 1.2) * (1 + 0.04 * wander(t, rng, 1, 1.0)[:, 0])
        weights[:, FACES.index(emotion) - 1] = shape * strength
    return weights @ BASIS.T + wander(t, rng, FACE_DIMS, 0.05)


def express_with(emotion: str, t: Array, strength: Array, rng: np.random.Generator) -> Array:
    """Expression values [T, 50] of an emotion as strong as `strength` [T] says (1 is an apex)."""
    weights = _idle(t, rng)
    if emotion != "neutral":
        weights[:, FACES.index(emotion) - 1] = APEX * strength * (1 + 0.04 * wander(t, rng, 1, 1.0)[:, 0])
    return weights @ BASIS.T + wander(t, rng, FACE_DIMS, 0.05)


def _idle(t: Array, rng: np.random.Generator) -> Array:
    """Weights [T, 8] of the basis while a face does nothing but blink and talk a little."""
    seconds = float(t[-1]) if len(t) > 1 else 1.0
    weights = np.zeros((len(t), 8))
    weights[:, _TALK] = wander(t, rng, 3, 0.35)
    at = rng.uniform(-0.5, 2.0)
    while at < seconds:
        weights[:, _BLINK] += 1.6 * np.exp(-(((t - at) / 0.06) ** 2))
        at += rng.uniform(1.2, 3.5)
    return weights


def read(face: NDArray[np.floating]) -> str:
    """The emotion of expression values [T, 50]: the direction with the longest apex, or neutral."""
    along = np.percentile(np.asarray(face) @ BASIS[:, :4], 75, axis=0)
    best = int(np.argmax(along))
    return FACES[1 + best] if along[best] > THRESHOLD else "neutral"
