"""One self-contained HTML file that plays motions: orbit, scrub, side by side on one clock.

* The file opens from disk without a network: own script and style are inlined, a policy forbids any request.
* Positions travel as 16-bit integers over each clip's own bounding box (about 0.1 mm over 8 m) in base64.
* Titles, labels and captions are untrusted: they enter the page only as JSON without `<`, `>` and `&`, and
  the script puts them on screen through `textContent`.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.files import write_text
from motionloom.datasets.schema import UserError
from motionloom.pipeline.render.figure import Figure, figure_for

SCRIPTS = (
    "viewer_space.js",
    "viewer_scene.js",
    "viewer_head.js",
    "viewer_body.js",
    "viewer_clip.js",
    "viewer_page.js",
    "viewer_app.js",
)
FACE_CONTROLS = ("smile", "brow", "eye_open", "mouth_open", "frown")
FACE_NEUTRAL = (0.0, 0.0, 1.0, 0.0, 0.0)
FACE_STEP = 1e-3


@dataclass(frozen=True)
class ViewerMotion:
    """One cell of the viewer.

    `joints` [T, N, 3] metres, Y up; `parents` [N] with -1 for the root; `label` is the chip ('truth',
    'generated'); motions with one `group` share a row. `face_controls` [T, 5] are smile, brow (-1 lowered,
    1 raised), eye-open (0 closed, 1 neutral), mouth-open and frown (mouth corners down, inner brows up);
    neutral is (0, 0, 1, 0, 0).
    """

    joints: NDArray[Any]
    fps: float
    parents: Sequence[int]
    label: str = ""
    caption: str = ""
    group: str = ""
    face_controls: NDArray[Any] | None = None


def write_viewer(path: Path, motions: Sequence[ViewerMotion], title: str, note: str = "") -> None:
    """Write the viewer page; `UserError` for motions that cannot be drawn."""
    template = resource("viewer.html")
    page = fill(
        template,
        TITLE=escape(title),
        STYLE=resource("viewer.css"),
        DATA=safe_json(viewer_data(motions, title, note)),
        SCRIPT=viewer_script(),
    )
    write_text(path, page)


def viewer_data(motions: Sequence[ViewerMotion], title: str = "", note: str = "") -> dict[str, Any]:
    """Everything the viewer's script needs, as plain JSON types."""
    if not motions:
        raise UserError("a viewer needs at least one motion")
    figures: list[Figure] = []
    clips = []
    for number, motion in enumerate(motions):
        joints = _checked(motion, number)
        figure = figure_for(motion.parents, joints)
        if figure not in figures:
            figures.append(figure)
        positions, low, step = quantise(joints)
        face = None
        if motion.face_controls is not None:
            controls = np.clip(np.asarray(motion.face_controls, np.float64), -2, 2) / FACE_STEP
            face = _base64(np.round(controls).astype("<i2"))
        clips.append(
            {
                "label": motion.label,
                "caption": motion.caption,
                "group": motion.group,
                "fps": float(motion.fps),
                "frames": len(joints),
                "joints": joints.shape[1],
                "figure": figures.index(figure),
                "scale": round(figure.scale(joints), 4),
                "low": [float(v) for v in low],
                "step": [float(v) for v in step],
                "positions": _base64(positions),
                "face": face,
            }
        )
    return {
        "title": title,
        "note": note,
        "faceNeutral": list(FACE_NEUTRAL),
        "faceStep": FACE_STEP,
        "figures": [figure.to_json() for figure in figures],
        "motions": clips,
    }


def quantise(
    joints: NDArray[Any],
) -> tuple[NDArray[np.uint16], NDArray[np.float64], NDArray[np.float64]]:
    """Joints [T, N, 3] to 16-bit integers with joints = low + step * integers, per axis."""
    exact = np.asarray(joints, np.float64)
    low = exact.min(axis=(0, 1))
    step = np.maximum((exact.max(axis=(0, 1)) - low) / 65535.0, 1e-9)
    return np.round((exact - low) / step).astype("<u2"), low, step


def viewer_script() -> str:
    """The viewer's own scripts as one, defining `motionloomViewer(element, data, options)`."""
    body = "\n".join(resource(name) for name in SCRIPTS)
    return f"(function () {{\n'use strict';\n{body}\nwindow.motionloomViewer = mountViewer;\n}})();"


def safe_json(data: Any) -> str:
    """JSON that cannot end or open a script element, whatever the strings in it say."""
    text = json.dumps(data, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def fill(template: str, **parts: str) -> str:
    """Replace each `@@NAME@@` once, in one pass, so that inserted text is never searched again."""
    out = []
    rest = template
    while "@@" in rest:
        before, name, rest = rest.split("@@", 2)
        out += [before, parts[name]]
    return "".join([*out, rest])


@cache
def resource(name: str) -> str:
    """Text of a file that ships beside this module."""
    return (resources.files("motionloom.pipeline.render") / name).read_text(encoding="utf-8")


def _checked(motion: ViewerMotion, number: int) -> NDArray[np.float64]:
    where = f"motion {number} ('{motion.label or motion.caption}')"
    joints = np.asarray(motion.joints, np.float64)
    if joints.ndim != 3 or joints.shape[2] != 3 or not len(joints):
        raise UserError(f"{where}: joints must be [T, N, 3] with T > 0, got {list(joints.shape)}")
    if len(motion.parents) != joints.shape[1]:
        raise UserError(f"{where}: {joints.shape[1]} joints but {len(motion.parents)} parents")
    if not np.isfinite(joints).all():
        raise UserError(f"{where}: joints hold NaN or infinity; run the data doctor on its source")
    if not motion.fps > 0:
        raise UserError(f"{where}: fps must be above 0, got {motion.fps}")
    if motion.face_controls is not None:
        face = np.asarray(motion.face_controls)
        if face.shape != (len(joints), len(FACE_CONTROLS)) or not np.isfinite(face).all():
            raise UserError(
                f"{where}: face_controls must be finite [T={len(joints)}, 5], got {list(face.shape)}"
            )
    return joints


def _base64(values: NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")
