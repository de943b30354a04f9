"""One self-contained HTML file that plays motions: orbit, scrub, side by side on one clock.

* The file opens from disk without a network: own script and style are inlined, a policy forbids any request.
* Positions travel as 16-bit integers over each clip's own bounding box (about 0.1 mm over 8 m) in base64.
* Sound travels once, however many motions it belongs to, and no longer than they last: see `sound`.
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
from motionloom.datasets.motion.rigid import RigidMotion
from motionloom.datasets.schema import UserError
from motionloom.pipeline.render.body.embed import mesh_data, pose_data
from motionloom.pipeline.render.body.posing import human_skeleton, posing_of
from motionloom.pipeline.render.figure import Figure, figure_for
from motionloom.pipeline.render.score import Segments, score_data
from motionloom.pipeline.render.sound import Playing, Soundtrack, embed_sounds

SCRIPTS = (
    "viewer_space.js",
    "viewer_scene.js",
    "viewer_head.js",
    "viewer_body.js",
    "viewer_clip.js",
    "viewer_mesh.js",
    "viewer_bones.js",
    "viewer_shaders.js",
    "viewer_skin.js",
    "viewer_gl.js",
    "viewer_stage.js",
    "viewer_page.js",
    "viewer_score.js",
    "viewer_sound.js",
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
    neutral is (0, 0, 1, 0, 0). `sound` starts with frame 0; `beats` are seconds, ticks on the time line;
    `segments` are what drives the motion when: (start, end, label) in seconds, or `Segment`s. `figure` is the
    rigid figure whose joints these are, where there is one: its rotations pose the body.
    """

    joints: NDArray[Any]
    fps: float
    parents: Sequence[int]
    label: str = ""
    caption: str = ""
    group: str = ""
    face_controls: NDArray[Any] | None = None
    sound: Soundtrack | None = None
    beats: Sequence[float] = ()
    segments: Segments = ()
    figure: RigidMotion | None = None


def write_viewer(path: Path, motions: Sequence[ViewerMotion], title: str, note: str = "") -> None:
    """Write the viewer page; `UserError` for motions that cannot be drawn."""
    write_text(path, viewer_page(motions, title, note))


def viewer_page(motions: Sequence[ViewerMotion], title: str, note: str = "") -> str:
    """The viewer page as text."""
    data = viewer_data(motions, title, note)
    return fill(
        resource("viewer.html"),
        MEDIA=media_policy("sounds" in data),
        TITLE=escape(title),
        STYLE=resource("viewer.css"),
        DATA=safe_json(data),
        SCRIPT=viewer_script(has_bodies(data)),
    )


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
                "pose": _pose(motion, joints),
            }
        )
    tracks = _tracks(motions, clips)
    return {
        "title": title,
        "note": note,
        "faceNeutral": list(FACE_NEUTRAL),
        "faceStep": FACE_STEP,
        "figures": [figure.to_json() for figure in figures],
        "motions": clips,
        **tracks,
    }


def has_bodies(data: dict[str, Any]) -> bool:
    """Whether any of `viewer_data`'s motions is one that the body can be posed by."""
    return any(clip["pose"] is not None for clip in data["motions"])


def media_policy(sounding: bool) -> str:
    """What a page's content policy adds for sound: media made by its own script, from no address."""
    return "; media-src blob:" if sounding else ""


def _tracks(motions: Sequence[ViewerMotion], clips: list[dict[str, Any]]) -> dict[str, Any]:
    """Distinct `sounds` and `scores`, where there are any; each clip gets the numbers of its own."""
    names = [_name(motion, number) for number, motion in enumerate(motions)]
    lengths = [len(motion.joints) / motion.fps for motion in motions]
    sounds, playing = embed_sounds(
        [Playing(name, m.sound, length) for name, m, length in zip(names, motions, lengths, strict=True)]
    )
    scores: list[dict[str, Any]] = []
    for motion, clip, name, length, sound in zip(motions, clips, names, lengths, playing, strict=True):
        if sound is not None:
            clip["sound"] = sound
        score = score_data(motion.beats, motion.segments, length, name)
        if any(score.values()):
            if score not in scores:
                scores.append(score)
            clip["score"] = scores.index(score)
    encoded = [
        {"mime": s.mime, "seconds": s.seconds, "data": base64.b64encode(s.data).decode("ascii")}
        for s in sounds
    ]
    return ({"sounds": encoded} if encoded else {}) | ({"scores": scores} if scores else {})


def quantise(
    joints: NDArray[Any],
) -> tuple[NDArray[np.uint16], NDArray[np.float64], NDArray[np.float64]]:
    """Joints [T, N, 3] to 16-bit integers with joints = low + step * integers, per axis."""
    exact = np.asarray(joints, np.float64)
    low = exact.min(axis=(0, 1))
    step = np.maximum((exact.max(axis=(0, 1)) - low) / 65535.0, 1e-9)
    return np.round((exact - low) / step).astype("<u2"), low, step


def viewer_script(bodies: bool = True) -> str:
    """The viewer's own scripts as one, defining `motionloomViewer(element, data, options)`.

    Without `bodies` it lacks the skinned body's mesh (about 0.5 MB) and draws flat figures only.
    """
    body = "\n".join(resource(name) for name in SCRIPTS)
    mesh = safe_json(mesh_data()) if bodies else "null"
    head, foot = f"'use strict';\nconst BODY = {mesh};", "window.motionloomViewer = mountViewer;"
    return f"(function () {{\n{head}\n{body}\n{foot}\n}})();"


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
    where = _name(motion, number)
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


def _pose(motion: ViewerMotion, joints: NDArray[np.float64]) -> dict[str, Any] | None:
    skeleton = human_skeleton(motion.parents)
    return None if skeleton is None else pose_data(posing_of(joints, skeleton, motion.figure))


def _name(motion: ViewerMotion, number: int) -> str:
    return f"motion {number} ('{motion.label or motion.caption}')"


def _base64(values: NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")
