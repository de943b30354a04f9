"""Face expressions as trajectories of 50 values in the basis of `datasets/motion/body/expressions.py`."""

from __future__ import annotations

import numpy as np

from motionloom.datasets.motion.body.expressions import APEX, BASIS, FACES
from motionloom.datasets.motion.layout import FACE_DIMS
from motionloom.datasets.synth.actions.maths import Array, ease, wander

_BLINK, _TALK = 4, slice(5, 8)


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
