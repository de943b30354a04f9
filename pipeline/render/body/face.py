"""The body's face: from expression values to weights of its shapes.

Only the basis of `datasets/motion/body/expressions.py` has a public meaning (happy, sad, angry, surprised,
blink). FLAME coefficients of licensed data follow another basis: their faces stay neutral unless the caller
brings controls.

Pages and films move the face by five controls [T, 5]: smile, brow (-1 lowered, 1 raised), eye-open (0 closed,
1 neutral), mouth-open and frown (mouth corners down, inner brows up). GLB files carry the synthetic basis'
own expressions, or ARKit's 52 shapes.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.body.arkit import ARKIT, ArkitBases
from motionloom.datasets.motion.body.expressions import APEX, BASIS
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.render.body.mesh import body_for

Floats = NDArray[np.float64]
Values = NDArray[np.floating]

CONTROLS = ("smile", "frown", "brow_up", "brow_down", "eye_wide", "eye_shut", "mouth_open")
"""The shapes at each end of the five controls."""
FACE_CONTROLS = ("smile", "brow", "eye_open", "mouth_open", "frown")
FACE_NEUTRAL = (0.0, 0.0, 1.0, 0.0, 0.0)
EXPRESSIONS = ("happy", "sad", "angry", "surprised", "blink", "talk_open", "talk_wide", "talk_purse")
"""The shapes of the synthetic basis' columns at their apex, in the basis' order."""
_EYE_OPEN = np.array([0.75, 0.7, 0.8, 1.6])
"""Opening of the eye at the apex of each emotion, 1 being neutral (fitted to the synthetic basis)."""
BLINK_HEIGHT = 1.6
"""Length of a full blink along its column of the synthetic basis."""
_WIDE_EYE = 1.6


def synthetic_face_controls(expression: Values) -> Floats:
    """Synthetic expression [T, 50] to controls [T, 5], in the order of `FACE_CONTROLS`."""
    emotions, blink, _ = _columns(expression)
    happy, sad, angry, surprised = emotions.T
    open_eyes = 1 + emotions @ (_EYE_OPEN - 1)
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


def control_weights(controls: Values) -> Floats:
    """Controls [T, 5] -> weights [T, 7] of `CONTROLS`."""
    smile, brow, eye, mouth, frown = np.asarray(controls, np.float64).T
    return np.stack(
        [
            np.clip(smile, -0.5, 1.5),
            np.clip(frown, -0.5, 1.5),
            np.clip(brow, 0, 1.5),
            np.clip(-brow, 0, 1.5),
            np.clip((eye - 1) / (_WIDE_EYE - 1), 0, 1.2),
            np.clip(1 - eye, 0, 1),
            np.clip(mouth, 0, 1.5),
        ],
        axis=-1,
    )


def expression_weights(expression: Values) -> Floats:
    """Synthetic expression values [T, 50] -> weights [T, 8] of `EXPRESSIONS`.

    A blink closes the eye as far as the emotions leave it open, so that the sum of both is shut.
    """
    emotions, blink, talk = _columns(expression)
    opened = np.maximum(1 + emotions @ (_EYE_OPEN - 1), 0)
    return np.concatenate([emotions, (blink * opened)[:, None], talk], axis=1)


def _columns(expression: Values) -> tuple[Floats, Floats, Floats]:
    """Emotions [T, 4], blink [T] and talk [T, 3] of synthetic expression values [T, 50]."""
    along = np.asarray(expression, np.float64) @ BASIS
    return (
        np.clip(along[:, :4] / APEX, 0, 1.2),
        np.clip(along[:, 4] / BLINK_HEIGHT, 0, 1),
        np.clip(np.abs(along[:, 5:]), 0, 1),
    )


@cache
def own_bases() -> ArkitBases:
    """The body's expressions and its ARKit shapes, both on its head."""
    shapes = body_for(Skeleton.named("smplx52"), (*EXPRESSIONS, *ARKIT)).shapes
    return ArkitBases(np.stack([shapes[n] for n in EXPRESSIONS]), np.stack([shapes[n] for n in ARKIT]))


def synthetic_arkit(expression: Values) -> Floats:
    """ARKit weights [T, 52] of synthetic expression values [T, 50], by the bases of the body's own head."""
    return own_bases().weights(expression_weights(expression))
