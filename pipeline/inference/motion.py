"""`GeneratedMotion`: one motion, what it was made from, and the files it can be saved as."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.generation import Prompt
from motionloom.pipeline.render.score import Segment

WRITERS = {
    ".npz": "motionloom.pipeline.inference.saving:save_npz",
    ".bvh": "motionloom.pipeline.inference.saving:save_bvh",
    ".glb": "motionloom.pipeline.inference.saving:save_glb",
    ".mp4": "motionloom.pipeline.inference.saving:save_mp4",
    ".html": "motionloom.pipeline.inference.saving:save_html",
}
"""What writes a motion to a file that ends so: `module:function`, a function of (path, motion)."""


@dataclass(frozen=True)
class GeneratedMotion:
    """One generated clip. In a notebook it shows itself."""

    prompt: Prompt
    features: NDArray[np.float32]
    """Body-hand features [T, D]."""
    joints: NDArray[np.float64]
    """Positions [T, N, 3] in metres."""
    face: NDArray[np.float32] | None
    """Expression [T, 50], or None where the model makes no face."""
    layout: MotionLayout
    segments: tuple[Segment, ...] = ()
    """What drove which seconds, of a motion made from a script."""
    seed: int | None = None
    """The seed that it was asked for with."""

    @property
    def caption(self) -> str:
        """What the person does, in words; empty without."""
        return self.prompt.text

    @property
    def face_caption(self) -> str:
        """What the face does, in words."""
        return self.prompt.words

    @property
    def fps(self) -> float:
        """Frames a second."""
        return self.layout.fps

    @property
    def seconds(self) -> float:
        """Its length."""
        return len(self.joints) / self.layout.fps

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the N joints."""
        return tuple(self.layout.skeleton.joints)

    def save(self, path: Path | str) -> Path:
        """Write one file; its ending says which kind: .npz, .bvh, .glb, .mp4, .html. Returns its path."""
        path = Path(path)
        write = _from_table(WRITERS.get(path.suffix.lower()))
        if write is None:
            known = ", ".join(WRITERS)
            ending = f"'{path.suffix}'" if path.suffix else "no ending"
            raise UserError(
                f"{path}: a motion cannot be saved with {ending}; name a file that ends in {known}"
            )
        write(path, self)
        return path

    def _repr_html_(self) -> str:
        """The viewer, in a frame of its own that can reach neither the notebook nor the network."""
        show = _from_table("motionloom.pipeline.inference.saving:frame_of")
        assert show is not None
        return str(show(self))


def _from_table(entry: str | None) -> Callable[..., object] | None:
    """The function `module:function`, imported when it is asked for."""
    if entry is None:
        return None
    module, name = entry.split(":")
    function: Callable[..., object] = getattr(import_module(module), name)
    return function
