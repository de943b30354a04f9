"""ARKit's blend shapes on the body's own head.

The head is a stylised one: it has eyelids, brows, lips, cheeks and a jaw, and so some of the 52 shapes move
it. The others (glances, tongue, nose, the jaw to the side) are there by name and leave it as it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from features import Look
from numpy.typing import NDArray

from motionloom.datasets.motion.body.arkit import ARKIT

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Shape:
    """What of a look belongs to a shape: one side of the face, its upper or lower half, or all."""

    look: Look
    side: Literal["", "Left", "Right"] = ""
    half: Literal["", "upper", "lower"] = ""

    def mask(self, local: Floats) -> Floats:
        """Share [V] of the look's displacement at points [V, 3] from the middle of the head."""
        out = np.ones(len(local))
        if self.side:
            out *= _step((local[:, 0] if self.side == "Left" else -local[:, 0]) / 0.006)
        if self.half:
            above = local[:, 1] + 0.022
            out *= _step((above if self.half == "upper" else -above) / 0.004)
        return out


_SIDED: dict[str, tuple[Look, Literal["", "upper", "lower"]]] = {
    "eyeBlink": (Look(eye_open=0.0), "upper"),
    "eyeSquint": (Look(eye_open=0.6), "upper"),
    "eyeWide": (Look(eye_open=1.6), "upper"),
    "browDown": (Look(brow=-1.0), "upper"),
    "browOuterUp": (Look(brow=1.0), "upper"),
    "mouthSmile": (Look(smile=1.0), ""),
    "mouthFrown": (Look(frown=1.0), "lower"),
    "mouthLowerDown": (Look(mouth_open=0.3), "lower"),
}
_WHOLE: dict[str, Shape] = {
    "browInnerUp": Shape(Look(frown=1.0), half="upper"),
    "jawOpen": Shape(Look(mouth_open=1.0), half="lower"),
    "mouthPucker": Shape(Look(purse=1.0), half="lower"),
    "mouthFunnel": Shape(Look(purse=0.7, mouth_open=0.3), half="lower"),
}


def _step(values: Floats) -> Floats:
    return np.asarray(1 / (1 + np.exp(-np.clip(values, -60, 60))), dtype=np.float64)


def _shape(name: str) -> Shape:
    for base, (look, half) in _SIDED.items():
        for side in ("Left", "Right"):
            if name == base + side:
                return Shape(look, side, half)  # type: ignore[arg-type]
    return _WHOLE.get(name, Shape(Look()))


ARKIT_SHAPES: dict[str, Shape] = {name: _shape(name) for name in ARKIT}
"""All 52, in ARKit's order; those that the head does not have are the neutral look."""
