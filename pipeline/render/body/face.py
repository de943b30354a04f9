"""The body's face: from expression values to weights of its shapes.

Only the basis of `datasets/motion/body/expressions.py` has a public meaning (happy, sad, angry, surprised,
blink). FLAME coefficients of licensed data follow another basis: their faces stay neutral unless the caller
brings controls.

Pages move the face by five controls [T, 5]: smile, brow (-1 lowered, 1 raised), eye-open (0 closed,
1 neutral), mouth-open and frown (mouth corners down, inner brows up). GLB files carry the synthetic basis'
own expressions, or ARKit's 52 shapes.

Those come by least squares on two bases of one face. What a face does is the displacement of its vertices. A
source basis says it for expression values (`source` [K, V, 3]: the displacement of each vertex for each
value), an ARKit basis for the 52 shapes (`arkit` [52, V, 3], in the order of `ARKIT`). Frame by frame the
weights between 0 and 1 are found whose displacement is nearest to the source's; a trace of ridge keeps shapes
without effect at rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import write_text
from motionloom.datasets.motion.body.expressions import APEX, BASIS
from motionloom.datasets.motion.npz import NpzFile

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


_SIDED = {
    "eyeBlink": "LR", "eyeLookDown": "LR", "eyeLookIn": "LR", "eyeLookOut": "LR", "eyeLookUp": "LR",
    "eyeSquint": "LR", "eyeWide": "LR", "jawForward": "", "jawLeft": "", "jawRight": "", "jawOpen": "",
    "mouthClose": "", "mouthFunnel": "", "mouthPucker": "", "mouthLeft": "", "mouthRight": "",
    "mouthSmile": "LR", "mouthFrown": "LR", "mouthDimple": "LR", "mouthStretch": "LR", "mouthRollLower": "",
    "mouthRollUpper": "", "mouthShrugLower": "", "mouthShrugUpper": "", "mouthPress": "LR",
    "mouthLowerDown": "LR", "mouthUpperUp": "LR", "browDown": "LR", "browInnerUp": "", "browOuterUp": "LR",
    "cheekPuff": "", "cheekSquint": "LR", "noseSneer": "LR", "tongueOut": "",
}  # fmt: skip
ARKIT: tuple[str, ...] = tuple(
    name + {"L": "Left", "R": "Right", "": ""}[side]
    for name, sides in _SIDED.items()
    for side in sides or [""]
)
"""ARKit's names; left is the person's own."""

_RIDGE = 1e-6
"""Ridge, as a share of the mean squared shape: far below what any vertex shows."""
_BASIS_BYTES = 2**29
_FARTHEST = 1e6
"""No vertex moves so far, in any unit."""


@dataclass(frozen=True, eq=False)
class ArkitBases:
    """A source basis [K, V, 3] and an ARKit basis [52, V, 3] on the same vertices; any one unit."""

    source: Floats
    arkit: Floats

    @staticmethod
    def read(path: Path) -> ArkitBases:
        """The arrays `source` and `arkit` of an npz file."""
        with NpzFile(path) as file:
            source = file.numbers("source", limit=_BASIS_BYTES)
            arkit = file.numbers("arkit", limit=_BASIS_BYTES)
        if source.ndim != 3 or source.shape[2] != 3 or arkit.ndim != 3 or arkit.shape[::2] != (len(ARKIT), 3):
            raise UserError(
                f"{path}: 'source' is {list(source.shape)} and 'arkit' {list(arkit.shape)}; they must be "
                f"[K, V, 3] and [{len(ARKIT)}, V, 3]"
            )
        if source.shape[1] != arkit.shape[1]:
            raise UserError(
                f"{path}: 'source' has {source.shape[1]} vertices, 'arkit' {arkit.shape[1]}: not the same"
            )
        if not all((np.abs(basis) <= _FARTHEST).all() for basis in (source, arkit)):  # false for NaN
            raise UserError(f"{path}: a basis holds values that are not finite numbers up to {_FARTHEST:g}")
        return ArkitBases(source, arkit)

    def weights(self, values: NDArray[np.floating]) -> Floats:
        """Weights [T, 52] in 0..1 of expression values [T, K]."""
        count = len(self.source)
        if values.ndim != 2 or values.shape[1] != count:
            raise UserError(
                f"the source basis has {count} values, but the expressions are {list(values.shape)}"
            )
        shapes = self.arkit.reshape(len(ARKIT), -1)
        source = self.source.reshape(count, -1)
        gram = shapes @ shapes.T
        wanted = np.asarray(values, np.float64) @ (source @ shapes.T)
        return bounded_least_squares(gram, wanted)


def bounded_least_squares(gram: Floats, wanted: Floats) -> Floats:
    """Return the w in 0..1 with the least `w' G w / 2 - b' w`, for each row b of `wanted` [T, M]."""
    from scipy.optimize import lsq_linear

    count = len(gram)
    root = np.linalg.cholesky(gram + max(_RIDGE * float(np.trace(gram)) / count, 1e-300) * np.eye(count))
    aims = np.linalg.solve(root, wanted.T).T
    return np.array([lsq_linear(root.T, aim, (0, 1), method="bvls").x for aim in aims])


def write_arkit_csv(path: Path, weights: NDArray[np.floating], fps: float) -> None:
    """One row a frame: time in seconds and the 52 weights, named in the first row."""
    rows = [
        ",".join([f"{frame / fps:.6f}", *(f"{value:.5f}" for value in row)])
        for frame, row in enumerate(weights.tolist())
    ]
    write_text(path, "\n".join([",".join(["time", *ARKIT]), *rows]) + "\n")
