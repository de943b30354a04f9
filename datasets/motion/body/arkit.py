"""Expression values -> the 52 blend shapes of ARKit, by least squares on two bases of one face.

What a face does is the displacement of its vertices. A source basis says it for expression values
(`source` [K, V, 3]: the displacement of each vertex for each value), an ARKit basis for the 52 shapes
(`arkit` [52, V, 3], in the order of `ARKIT`). Frame by frame the weights between 0 and 1 are found whose
displacement is nearest to the source's; a trace of ridge keeps shapes without effect at rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.files import write_text
from motionloom.datasets.motion.npz import NpzFile
from motionloom.datasets.schema import UserError

Floats = NDArray[np.float64]

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
        return ArkitBases(source, arkit).checked(str(path))

    def checked(self, where: str) -> ArkitBases:
        """Itself, where shapes and numbers are sound."""
        source, arkit = self.source.shape, self.arkit.shape
        if len(source) != 3 or source[2] != 3 or len(arkit) != 3 or arkit[::2] != (len(ARKIT), 3):
            raise UserError(
                f"{where}: 'source' is {list(source)} and 'arkit' {list(arkit)}; they must be [K, V, 3] and "
                f"[{len(ARKIT)}, V, 3]"
            )
        if source[1] != arkit[1]:
            raise UserError(
                f"{where}: 'source' has {source[1]} vertices, 'arkit' {arkit[1]}; they must be the same"
            )
        if not (np.isfinite(self.source).all() and np.isfinite(self.arkit).all()):
            raise UserError(f"{where}: a basis holds NaN or infinite values")
        return self

    def weights(self, values: NDArray[np.floating]) -> Floats:
        """Weights [T, 52] in 0..1 of expression values [T, K]."""
        count = len(self.source)
        if values.ndim != 2 or values.shape[1] != count:
            raise UserError(
                f"the source basis has {count} values, but the expressions are {list(values.shape)}"
            )
        shapes, source = self.arkit.reshape(len(ARKIT), -1), self.source.reshape(count, -1)
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
    if weights.ndim != 2 or weights.shape[1] != len(ARKIT):
        raise UserError(f"{path}: ARKit weights must be [T, {len(ARKIT)}], not {list(weights.shape)}")
    rows = [_row(frame / fps, row) for frame, row in enumerate(weights.tolist())]
    write_text(path, "\n".join([",".join(["time", *ARKIT]), *rows]) + "\n")


def _row(time: float, weights: Sequence[float]) -> str:
    return ",".join([f"{time:.6f}", *(f"{value:.5f}" for value in weights)])
