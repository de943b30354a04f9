"""`MotionData`: one motion, as the writers of files take it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.pipeline.contract.generation import Prompt

if TYPE_CHECKING:
    from motionloom.datasets.motion.body.rigid import RigidMotion
    from motionloom.pipeline.render.sound import Segment


class OwnFile(Protocol):
    """A user's file with a motion in it."""

    @property
    def file(self) -> bytes:
        """Its bytes."""


@dataclass(frozen=True)
class MotionData:
    """One motion as numbers, and what it was made from."""

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
    bvh: OwnFile | None = None
    """The user's own BVH with what was made in it, which is what is saved as BVH."""

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
