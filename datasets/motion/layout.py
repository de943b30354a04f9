"""`MotionLayout`: what the columns of a motion array mean (HumanTOMATO section 4.2).

Every module that needs a width, a slice or a body part asks the layout; no other file knows column numbers.

| name          | D   | columns |
|---------------|-----|---------|
| `body133`     | 133 | root 4, 21 joint positions, 22 joint velocities |
| `wholebody313`| 313 | root 4, 51 positions, 52 velocities |
| `wholebody363`| 363 | `wholebody313` + 50 FLAME expression values |
| `h3d263`      | 263 | HumanML3D: root 4, positions 63, 6-D rotations 126, velocities 66, foot contacts 4 |
| `tomato623`   | 623 | the same with 52 joints |
| `smpl75`      | 75  | UDE: translation 3, axis-angle 24 x 3 |
| `smplx322`    | 322 | Motion-X raw input |
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import FACE, HANDS, PRESENT_ALL, ClipMeta
from motionloom.datasets.motion.skeleton import Skeleton

Family = Literal["exact", "h3d", "raw"]
Part = Literal["all", "bodyhand", "body", "hand", "face"]

BODY_JOINTS = 22
WRISTS = (20, 21)
FINGERS = (range(22, 37), range(37, 52))
"""Joints of `smplx52`, left and right."""
FACE_DIMS = 50
ROOT = ("root_yaw_velocity", "root_xz_velocity", "root_height")
"""Fields of the way that the root goes."""


def _h3d_fields(joints: int, *, rotations: bool, face: bool) -> tuple[tuple[str, int], ...]:
    fields = [("root_yaw_velocity", 1), ("root_xz_velocity", 2), ("root_height", 1)]
    fields.append(("positions", 3 * (joints - 1)))
    if rotations:
        fields.append(("rotations_6d", 6 * (joints - 1)))
    fields.append(("velocities", 3 * joints))
    if rotations:
        fields.append(("foot_contacts", 4))
    if face:
        fields.append(("face", FACE_DIMS))
    return tuple(fields)


_SMPLX322 = (
    ("root_orient", 3),
    ("pose_body", 63),
    ("pose_hand", 90),
    ("pose_jaw", 3),
    ("face", 50),
    ("face_shape", 100),
    ("trans", 3),
    ("betas", 10),
)

_KNOWN: dict[str, tuple[str, float, Family, tuple[tuple[str, int], ...]]] = {
    "body133": ("smpl22", 20.0, "exact", _h3d_fields(22, rotations=False, face=False)),
    "wholebody313": ("smplx52", 30.0, "exact", _h3d_fields(52, rotations=False, face=False)),
    "wholebody363": ("smplx52", 30.0, "exact", _h3d_fields(52, rotations=False, face=True)),
    "h3d263": ("smpl22", 20.0, "h3d", _h3d_fields(22, rotations=True, face=False)),
    "tomato623": ("smplx52", 30.0, "h3d", _h3d_fields(52, rotations=True, face=False)),
    "smpl75": ("smpl22", 20.0, "raw", (("trans", 3), ("pose", 72))),
    "smplx322": ("smplx52", 30.0, "raw", _SMPLX322),
}

LAYOUTS = tuple(_KNOWN)
"""Names of all layouts."""


@dataclass(frozen=True)
class MotionLayout:
    """Names and order of the columns, the skeleton behind them, the frame rate and the feature family."""

    name: str
    skeleton_name: str
    fps: float
    family: Family
    fields: tuple[tuple[str, int], ...]

    @staticmethod
    def named(name: str, *, fps: float | None = None, family: Family | None = None) -> MotionLayout:
        """A known layout, at its usual frame rate and family unless given."""
        if name not in _KNOWN:
            raise UserError(f"no motion layout '{name}'; known: {', '.join(_KNOWN)}")
        skeleton, usual_fps, usual_family, fields = _KNOWN[name]
        if fps is not None and not 0 < fps <= 1000:
            raise UserError(f"{fps:g} frames a second: no motion has such a rate; give one up to 1000")
        layout = MotionLayout(name, skeleton, usual_fps, usual_family, fields)
        return replace(layout, fps=fps or layout.fps, family=family or layout.family)

    def clip_meta(self, clip_id: str, **facts: Any) -> ClipMeta:
        """`meta.json` of a clip in this layout; `facts` are the fields that the layout does not know."""
        return ClipMeta(
            id=clip_id,
            layout=self.name,
            family=self.family,
            fps=self.fps,
            skeleton=self.skeleton_name,
            **facts,
        )

    @cached_property
    def skeleton(self) -> Skeleton:
        return Skeleton.named(self.skeleton_name)

    @property
    def num_joints(self) -> int:
        return len(self.skeleton)

    @cached_property
    def dim(self) -> int:
        """D, the width of one frame."""
        return sum(size for _, size in self.fields)

    def has(self, field: str) -> bool:
        return any(name == field for name, _ in self.fields)

    def slice(self, field: str) -> slice:
        start = 0
        for name, size in self.fields:
            if name == field:
                return slice(start, start + size)
            start += size
        raise UserError(f"layout {self.name} has no field '{field}'; it has {[n for n, _ in self.fields]}")

    def part(self, part: Part) -> NDArray[np.int64]:
        """Columns of one body part, ascending.

        `body` is m^B of the paper (root, body positions, body velocities: 133), `hand` is m^H (180),
        `bodyhand` both (313), `face` the expression (50), `all` everything.
        """
        columns = np.arange(self.dim)
        if part == "all":
            return columns
        if part == "face":
            return columns[self.slice("face")]
        face = columns[self.slice("face")] if self.has("face") else columns[:0]
        if part == "bodyhand":
            return np.setdiff1d(columns, face)
        hand = self._hand_columns()
        return hand if part == "hand" else np.setdiff1d(columns, np.concatenate([hand, face]))

    @cached_property
    def present_columns(self) -> NDArray[np.bool_]:
        """Row b: which columns mean something in a clip that holds the bits b (`ClipMeta.present`), [4, D].

        The body's always do. The others are masked in training: what a file stores there is ignored.
        """
        needs = np.zeros(self.dim, dtype=np.uint8)
        needs[self._hand_columns()] = HANDS
        if self.has("face"):
            needs[self.slice("face")] = FACE
        bits = np.arange(PRESENT_ALL + 1, dtype=np.uint8)[:, None]
        present: NDArray[np.bool_] = (bits & needs) == needs
        return present

    def _hand_columns(self) -> NDArray[np.int64]:
        columns = np.arange(self.dim)
        out = [columns[:0]]
        for field, per_joint, first in (("positions", 3, 1), ("rotations_6d", 6, 1), ("velocities", 3, 0)):
            if self.has(field):
                out.append(columns[self.slice(field)][per_joint * (BODY_JOINTS - first) :])
        return np.concatenate(out)

    def without_face(self) -> MotionLayout:
        """The layout of `part("bodyhand")`, which joints can be decoded from; itself where it has no face."""
        if not self.has("face"):
            return self
        fields = tuple((name, size) for name, size in self.fields if name != "face")
        for name, (skeleton, _, _, known) in _KNOWN.items():
            if (skeleton, known) == (self.skeleton_name, fields):
                return MotionLayout.named(name, fps=self.fps, family=self.family)
        raise UserError(f"layout {self.name} has no counterpart without the face")

    def has_part(self, part: Part) -> bool:
        return self.has("face") if part == "face" else len(self.part(part)) > 0


def require_layout(actual: MotionLayout, wanted: MotionLayout, where: str) -> None:
    """`UserError` naming both when data does not have the layout, family and frame rate a config expects."""
    have = (actual.name, actual.family, actual.fps)
    want = (wanted.name, wanted.family, wanted.fps)
    if have != want:
        raise UserError(
            f"{where}: holds layout {have[0]} ({have[1]}, {have[2]:g} fps), the config expects "
            f"{want[0]} ({want[1]}, {want[2]:g} fps); convert the data again or change the config"
        )


# Parts of a figure and the columns that they are: what an edit keeps or makes anew. A figure is cut into
# seven `PIECES` that share no column; every part is some of them. Where the figure goes and how high its root
# is belongs to the legs: whoever keeps them keeps the path. Columns that hold a step to the next frame are
# known only where both frames are, and those of joints only where the root is known too, since a joint's step
# is the world's, not the figure's.

FigurePart = Literal[
    "all", "upper", "lower", "left_arm", "right_arm", "left_hand", "right_hand", "hands", "face"
]
"""`lower` are pelvis and legs, and with them where the figure goes; `upper` is all above the pelvis but the
face; arms are without fingers; hands are the fingers."""

PIECES = ("lower", "trunk", "left_arm", "right_arm", "left_hand", "right_hand", "face")
LOWER = PIECES.index("lower")

_ARM = ("shoulder", "elbow", "wrist")
_LEG = ("pelvis", "hip", "knee", "ankle", "foot")
_UPPER = PIECES[1:6]
_OF: dict[FigurePart, tuple[str, ...]] = {"all": PIECES, "upper": _UPPER, "hands": PIECES[4:6]}


def pieces_of(parts: Iterable[FigurePart], but: Iterable[FigurePart] = ()) -> NDArray[np.bool_]:
    """Return the `PIECES` of some parts, bool [7], without those of `but`."""
    without = {piece for part in but for piece in _OF.get(part, (part,))}
    pieces = {piece for part in parts for piece in _OF.get(part, (part,))} - without
    return np.array([piece in pieces for piece in PIECES])


@lru_cache(maxsize=8)
def piece_joints(layout: MotionLayout) -> NDArray[np.int64]:
    """Return the number of every joint's piece [N]."""
    pieces = []
    for number, joint in enumerate(layout.skeleton.joints):
        side, _, rest = joint.partition("_")
        own = "lower" if (rest or joint) in _LEG else "trunk"
        if number >= BODY_JOINTS:
            own = f"{side}_hand"
        elif rest in _ARM:
            own = f"{side}_arm"
        pieces.append(PIECES.index(own))
    return np.array(pieces)


@lru_cache(maxsize=8)
def piece_columns(layout: MotionLayout) -> NDArray[np.int64]:
    """Return the number of every column's piece [D], of motion features."""
    joints = piece_joints(layout)
    columns = np.full(layout.dim, LOWER)
    for field, width, first in (("positions", 3, 1), ("rotations_6d", 6, 1), ("velocities", 3, 0)):
        if layout.has(field):
            columns[layout.slice(field)] = np.repeat(joints[first:], width)
    if layout.has("face"):
        columns[layout.slice("face")] = PIECES.index("face")
    return columns


@lru_cache(maxsize=8)
def step_columns(layout: MotionLayout) -> NDArray[np.bool_]:
    """Return which columns hold a step to the next frame, bool [D]."""
    steps = np.zeros(layout.dim, dtype=np.bool_)
    for field in ("root_yaw_velocity", "root_xz_velocity", "velocities", "foot_contacts"):
        if layout.has(field):
            steps[layout.slice(field)] = True
    return steps
