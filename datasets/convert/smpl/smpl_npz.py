"""One clip of SMPL parameters in an .npz file, as AMASS publishes them (SMPL-H `poses` [T, 156], SMPL-X
[T, 165], also SMPL [T, 72]), or with the pose in parts (`root_orient`, `pose_body`, `pose_hand`).

Only the named arrays are opened, so pickled extras of a file (marker lists) are never looked at.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.convert.common.arrays import check_values
from motionloom.datasets.convert.common.release import Figure
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.datasets.motion.npz import NpzFile

KINDS = {72: "SMPL", 156: "SMPL-H", 165: "SMPL-X"}
"""Width of `poses` -> body model."""

BODY = 3 * BODY_JOINTS
HANDS = 90
"""Columns of the finger rotations, always the last ones."""

MAX_ANGLE = 100.0
"""Radians. Fits may wind up a few turns; more than this is no rotation anybody meant."""

MAX_METRES = 1e4

_RATES = ("mocap_framerate", "mocap_frame_rate")
_PARTS = {"root_orient": 3, "pose_body": BODY - 3, "pose_hand": HANDS}


@dataclass(frozen=True)
class MotionHeader:
    """Length, rate and model of a file, read without its motion."""

    frames: int
    fps: float | None
    """None when the file has no frame rate."""
    kind: str
    """SMPL, SMPL-H or SMPL-X."""
    gender: str
    hands: bool
    """Whether there are finger rotations."""


class RateError(UserError):
    """The frame rate that a file states cannot be."""


def read_motion_header(path: Path, label: str, fps: float | None = None) -> MotionHeader:
    """Length, frame rate and model of a clip without reading its motion; `UserError` when it is not one.

    With `fps` it does not matter what the file states.
    """
    with NpzFile(path, label) as file:
        if "poses" in file.names:
            frames, width = _matrix(file, "poses", None)
            if width not in KINDS:
                raise UserError(
                    f"{label}: poses is [T, {width}]; SMPL has 72 columns, SMPL-H 156, SMPL-X 165"
                )
            kind = KINDS[width]
            hands = width > 72
        else:
            if "root_orient" not in file.names or "pose_body" not in file.names:
                names = ", ".join(sorted(file.names)) or "nothing"
                raise UserError(f"{label}: no array 'poses', nor root_orient and pose_body; there is {names}")
            hands = "pose_hand" in file.names
            kind = "SMPL-X" if "pose_jaw" in file.names else "SMPL-H" if hands else "SMPL"
            frames = _matrix(file, "root_orient", 3)[0]
            for part in ("pose_body", "pose_hand")[: 1 + hands]:
                _same(label, part, _matrix(file, part, _PARTS[part])[0], frames)
        trans = _trans(file)
        _same(label, trans, _matrix(file, trans, 3)[0], frames)
        if frames < 1:
            raise UserError(f"{label}: no frames")
        if "betas" in file.names and len(file.header("betas").shape) not in (1, 2):
            raise UserError(f"{label}: betas is {list(file.header('betas').shape)}, not one shape [B]")
        return MotionHeader(frames, fps or _rate(file), kind, _gender(file), hands)


def read_motion(
    path: Path, label: str, *, hands: bool, palms: bool = False, frames: slice = slice(None)
) -> Figure:
    """The 22 body joints, and the 30 finger joints with `hands`, of the given frames.

    With `palms` SMPL's two hand joints follow the body's: SMPL-H and SMPL-X have none, theirs are at rest.

    `UserError` for values that are not finite or absurd, naming frame and column.
    """
    first = frames.start or 0
    with NpzFile(path, label) as file:
        if "poses" in file.names:
            poses = file.numbers("poses")[frames]
            check_values(poses, MAX_ANGLE, f"{label}: poses", first_frame=first)
            parts = [poses[:, :BODY], poses[:, -HANDS:]]
            extra = poses[:, BODY:72] if poses.shape[1] == 72 else np.zeros((len(poses), 6))
        else:
            parts = []
            for name in _PARTS if hands else ("root_orient", "pose_body"):
                parts.append(file.numbers(name)[frames])
                check_values(parts[-1], MAX_ANGLE, f"{label}: {name}", first_frame=first)
            parts = [np.concatenate(parts[:2], axis=1), *parts[2:]]
            extra = np.zeros((len(parts[0]), 6))
        trans = file.numbers(_trans(file))[frames]
        check_values(trans, MAX_METRES, f"{label}: trans", first_frame=first)
        betas = _betas(file) if "betas" in file.names else None
    rotations = np.concatenate(parts, axis=1) if hands else parts[0]
    if palms:
        rotations = np.concatenate([rotations, extra], axis=1)
    return Figure(rotations=rotations.reshape(len(rotations), -1, 3), trans=trans, betas=betas)


def _trans(file: NpzFile) -> str:
    """AMASS's name of the translation, or the other one (`transl`) where only that is there."""
    return "transl" if "transl" in file.names and "trans" not in file.names else "trans"


def _matrix(file: NpzFile, name: str, width: int | None) -> tuple[int, int]:
    header = file.header(name)
    if len(header.shape) != 2 or (width is not None and header.shape[1] != width):
        wanted = "D" if width is None else width
        raise UserError(f"{file.label}: {name} is {list(header.shape)}, not [T, {wanted}]")
    if header.dtype.kind != "f":
        raise UserError(f"{file.label}: {name} holds {header.dtype}, not floats")
    return header.shape[0], header.shape[1]


def _same(label: str, name: str, found: int, frames: int) -> None:
    if found != frames:
        raise UserError(f"{label}: {found} frames of {name}, but {frames} frames of poses")


def _rate(file: NpzFile) -> float | None:
    found: dict[str, float] = {}
    for name in _RATES:
        if name in file.names:
            value = file.numbers(name, limit=4096)
            fps = float(value.reshape(-1)[0]) if value.size == 1 else float("nan")
            if not 0 < fps <= 10_000:
                raise RateError(f"{file.label}: {name} is {value.tolist()}, not a number of frames a second")
            found[name] = fps
    if found and not math.isclose(min(found.values()), max(found.values()), rel_tol=1e-3):
        stated = " and ".join(f"{name} {fps:g}" for name, fps in found.items())
        raise RateError(f"{file.label}: {stated} differ")
    return next(iter(found.values()), None)


def _gender(file: NpzFile) -> str:
    """`female`, `male` or `neutral` (anything else, and none)."""
    if "gender" not in file.names:
        return "neutral"
    stored: Any = file.array("gender", limit=4096)
    value = stored.reshape(-1)[0] if stored.size == 1 else ""
    text = value.decode("ascii", "replace") if isinstance(value, bytes) else str(value)
    return text.lower() if text.lower() in ("female", "male") else "neutral"


def _betas(file: NpzFile) -> NDArray[np.float64]:
    """One shape [B]; a clip that changes its shape is two people."""
    betas = np.atleast_2d(file.numbers("betas", limit=2**27))
    check_values(betas, 1e3, f"{file.label}: betas")
    if not len(betas) or (betas != betas[0]).any():
        raise UserError(f"{file.label}: betas change during the clip ({len(betas)} rows); give one shape")
    return np.asarray(betas[0])
