"""The synthetic face read as ARKit weights, by the body's own expressions and its own ARKit shapes."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.arkit import ARKIT, ArkitBases
from motionloom.pipeline.render.body.face import EXPRESSIONS, expression_weights
from motionloom.pipeline.render.body.mesh import neutral_body


@cache
def own_bases() -> ArkitBases:
    """The body's expressions and its ARKit shapes, both on its head."""
    expressions = neutral_body().expressions
    shapes = neutral_body("smplx52", "arkit").expressions
    return ArkitBases(
        np.stack([expressions[name] for name in EXPRESSIONS]), np.stack([shapes[name] for name in ARKIT])
    )


def synthetic_arkit(expression: NDArray[Any]) -> NDArray[np.float64]:
    """Weights [T, 52] of synthetic expression values [T, 50], by the bases of the body's own head."""
    return own_bases().weights(expression_weights(expression))
