"""`GeneratedMotion`: one motion, what it was made from, and its files."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.body.rigid import RigidMotion
from motionloom.datasets.motion.bvh.own_file import OwnBvh
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.pipeline.contract.editing import EditReport
from motionloom.pipeline.contract.generation import Prompt
from motionloom.pipeline.render.sound import Segment

# The writers read this class, so it names their module instead of importing it.
_OUTPUTS = "motionloom.pipeline.inference.outputs"


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
    """The segments that drove a motion made from a script, with their seconds."""
    beats: tuple[float, ...] | None = None
    """Seconds of the beats of its music, as the model heard them; None: not looked for."""
    seed: int | None = None
    """The seed that it was asked for with."""
    figure: RigidMotion | None = None
    """The figure whose joints these are, which is shown as it is; None: one is fitted to them."""
    bvh: OwnBvh | None = None
    """The user's own file with what was made in it, which is what is saved as BVH."""

    def __post_init__(self) -> None:
        made = (self.features, self.joints, self.face)
        if not all(values is None or np.isfinite(values).all() for values in made):
            raise UserError(
                f"the motion for '{self.prompt.text}' holds numbers that are not finite: so do the model's "
                f"weights, or a network overflows in half precision; take an earlier checkpoint (--at)"
            )

    @property
    def caption(self) -> str:
        """The caption; empty without words."""
        return self.prompt.text

    @property
    def face_caption(self) -> str:
        """The caption of the face."""
        return self.prompt.words

    @property
    def words(self) -> str:
        """Both captions in one, for people."""
        face = self.prompt.face_text
        return f"{self.caption} (face: {face})".strip() if face and face != self.caption else self.caption

    @property
    def fps(self) -> float:
        return self.layout.fps

    @property
    def seconds(self) -> float:
        return len(self.joints) / self.layout.fps

    @property
    def joint_names(self) -> tuple[str, ...]:
        return tuple(self.layout.skeleton.joints)

    def __repr__(self) -> str:
        """The words and sizes, without the numbers."""
        frames, joints = self.joints.shape[:2]
        sizes = f"{self.seconds:g} s, {frames} frames, {joints} joints"
        return f"{type(self).__name__}({self.words!r}, {sizes}{'' if self.face is None else ', face'})"

    def save(self, path: Path | str) -> Path:
        """Write one file, of the format that its ending names (`writers.WRITERS`); returns its path."""
        path = Path(path)
        import_module(_OUTPUTS).save(path, self)
        return path

    def _repr_html_(self) -> str:
        """The viewer, in a frame of its own that can reach neither the notebook nor the network."""
        return str(import_module(_OUTPUTS).frame_of(self))


@dataclass(frozen=True, repr=False)
class EditedMotion(GeneratedMotion):
    """A clip of which a part was made anew, in the clip's world, the floor at height 0."""

    original: GeneratedMotion = field(kw_only=True)
    """The clip, at the model's frame rate."""
    report: EditReport = field(kw_only=True)
    """Errors against its task."""
    remarks: tuple[str, ...] = ()
    """Remarks on how the clip was read."""
