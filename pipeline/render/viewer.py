"""One self-contained HTML file that plays motions: orbit, scrub, side by side on one clock.

* The file opens from disk without a network: own script and style are inlined, a policy forbids any request.
* Positions travel as 16-bit integers over each clip's own bounding box (about 0.1 mm over 8 m) in base64.
* The mesh is in the script, once a page; a motion brings its own bones and each joint's rotation. A rotation
  is one 32-bit number: the three smaller components of its quaternion in 10 bits each, and which one is left
  out: a quarter of a degree at worst and a tenth on average, 0.7 mm at the end of a thigh.
* Sound travels once, however many motions it belongs to, and no longer than they last: see `sound`.
* Titles, labels and captions are untrusted: they enter the page only as JSON without `<`, `>` and `&`, and
  the script puts them on screen through `textContent`.
"""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from importlib import resources
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike, NDArray

from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import write_text
from motionloom.datasets.motion.body.rigid import RigidMotion
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.render.body.face import CONTROLS, FACE_NEUTRAL
from motionloom.pipeline.render.body.mesh import (
    Posing,
    asset,
    figure_size,
    human_skeleton,
    posing_of,
    stretches,
)
from motionloom.pipeline.render.sound import Segments, embed_sounds, score_data

SCRIPTS = (
    "space", "ground", "sticks", "clip", "mesh", "bones", "shaders", "gl", "stage", "board", "score", "sound",
    "app",
)  # fmt: skip
"""The files of `web/viewer`, in the order that they need each other."""
FACE_STEP = 1e-3
"""Step of the integers that carry face controls."""
_TURN_STEPS = 1022
_STILL = 1e-5


@dataclass(frozen=True)
class ViewerMotion:
    """One cell of the viewer.

    `joints` [T, N, 3] metres, Y up; `parents` [N] with -1 for the root; `label` is the chip ('truth',
    'generated'); motions with one `group` share a row. `face_controls` [T, 5] are those of `body/face.py`.
    `sound` starts with frame 0; `beats` are seconds, ticks on the time line;
    `segments` are what drives the motion when: (start, end, label) in seconds, or `Segment`s. `figure` is the
    rigid figure whose joints these are, where there is one: its rotations pose the body. `note` stands under
    the figure.
    """

    joints: NDArray[np.floating]
    fps: float
    parents: Sequence[int]
    label: str = ""
    caption: str = ""
    group: str = ""
    face_controls: NDArray[np.floating] | None = None
    sound: Sound | None = None
    beats: Sequence[float] = ()
    segments: Segments = ()
    figure: RigidMotion | None = None
    note: str = ""


@dataclass(frozen=True)
class Clips:
    """Motions to watch under a title of their own: a `Showing` of a stage."""

    title: str
    motions: Sequence[ViewerMotion]


def write_viewer(path: Path, motions: Sequence[ViewerMotion], title: str, note: str = "") -> None:
    """Write the viewer page; `UserError` for motions that cannot be drawn."""
    write_text(path, viewer_page(motions, title, note))


def viewer_page(motions: Sequence[ViewerMotion], title: str, note: str = "") -> str:
    """The viewer page as text."""
    data = viewer_data(motions, title, note)
    return fill(
        resource("viewer/viewer.html"),
        MEDIA=media_policy(motions),
        TITLE=escape(title),
        STYLE=resource("viewer/viewer.css"),
        DATA=safe_json(data),
        SCRIPT=viewer_script(has_bodies(motions)),
    )


def viewer_data(motions: Sequence[ViewerMotion], title: str = "", note: str = "") -> dict[str, object]:
    """Everything the viewer's script needs, as plain JSON types; arrays are base64."""
    skeletons: list[dict[str, object]] = []
    clips: list[dict[str, object]] = []
    scores: list[dict[str, object]] = []
    chosen: list[int | None] = []
    for number, motion in enumerate(motions):
        joints = np.asarray(motion.joints, np.float64)
        if not np.isfinite(joints).all():
            named = f"motion {number} ('{motion.label or motion.caption}')"
            raise UserError(f"{named}: joints hold NaN or infinity; run the data doctor on its source")
        human = human_skeleton(motion.parents)
        skeleton = _skeleton(motion.parents, human, joints)
        if skeleton not in skeletons:  # motions of one skeleton share it
            skeletons.append(skeleton)
        positions, low, step = quantise(joints)
        face = None
        if motion.face_controls is not None:
            controls = np.clip(np.asarray(motion.face_controls, np.float64), -2, 2) / FACE_STEP
            face = packed(np.round(controls), "<i2")
        clips.append(
            {
                "label": motion.label,
                "caption": motion.caption,
                "group": motion.group,
                "fps": float(motion.fps),
                "frames": len(joints),
                "joints": joints.shape[1],
                "skeleton": skeletons.index(skeleton),
                "low": [float(v) for v in low],
                "step": [float(v) for v in step],
                "positions": packed(positions),
                "face": face,
                "pose": None if human is None else pose_data(posing_of(joints, human, motion.figure)),
            }
        )
        if motion.note:
            clips[-1]["note"] = motion.note
        score = score_data(motion.beats, motion.segments, len(joints) / motion.fps)
        if any(score.values()) and score not in scores:
            scores.append(score)
        chosen.append(scores.index(score) if any(score.values()) else None)
    # Each sound is carried once, however many motions play it.
    sounds, playing = embed_sounds((motion.sound, len(motion.joints) / motion.fps) for motion in motions)
    for clip, sound_number, score_number in zip(clips, playing, chosen, strict=True):
        if sound_number is not None:
            clip["sound"] = sound_number
        if score_number is not None:
            clip["score"] = score_number
    out: dict[str, object] = {
        "title": title,
        "note": note,
        "faceNeutral": list(FACE_NEUTRAL),
        "faceStep": FACE_STEP,
        "skeletons": skeletons,
        "motions": clips,
    }
    if sounds:
        out["sounds"] = sounds
    if scores:
        out["scores"] = scores
    return out


def _skeleton(
    parents: Sequence[int], human: Skeleton | None, joints: NDArray[np.float64]
) -> dict[str, object]:
    """The tree of a motion: `sides` (0 middle, 1 left, 2 right) and `head` (-1 where it is not known) by the
    names of a person's joints, else sides by places in the first pose.
    """
    own = [int(parent) for parent in parents]
    if human is not None:
        sides = [{"left": 1, "right": 2}.get(name.split("_")[0], 0) for name in human.joints]
        return {"parents": own, "sides": sides, "head": human.index("head")}
    across = joints[0, :, 0] - joints[0, 0, 0]
    sides = np.where(across > 0.03, 1, np.where(across < -0.03, 2, 0)).tolist()
    return {"parents": own, "sides": sides, "head": -1}


def has_bodies(motions: Sequence[ViewerMotion]) -> bool:
    """Whether any of the motions is one that the body can be posed by."""
    return any(human_skeleton(motion.parents) is not None for motion in motions)


def media_policy(motions: Sequence[ViewerMotion]) -> str:
    """The part of a page's content policy for sound: media made by its own script, from no address."""
    return "; media-src blob:" if any(motion.sound is not None for motion in motions) else ""


@cache
def mesh_data() -> dict[str, object]:
    """The body in its details, as plain JSON types."""
    skeleton = Skeleton.named("smplx52")
    return {
        "parents": list(skeleton.parents),
        "rest": packed(skeleton.rest_joints, "<f4"),
        "details": [_detail(detail) for detail in ("near", "far", "shadow")],
    }


def _detail(name: str) -> dict[str, object]:
    arrays = asset()
    low, step, shapes = (arrays[f"{name}_{key}"].tolist() for key in ("low", "step", "shapes"))
    chosen = [shapes.index(shape) for shape in CONTROLS] if shapes else []
    moves = arrays[f"{name}_moves"][:, chosen] * arrays[f"{name}_move_step"].astype(float)
    size = max(float(np.abs(moves).max(initial=0.0)), 1e-3) / 127
    moves = np.round(moves / size)
    # Most vertices never move; only the others have a row.
    moving = np.flatnonzero(moves.any(axis=(1, 2)))
    out: dict[str, object] = {
        key: packed(arrays[f"{name}_{key}"])
        for key in ("places", "normals", "joints", "shares", "swatch", "triangles")
    }
    return out | {
        "low": low,
        "step": step,
        "shapes": len(CONTROLS),
        "moving": packed(arrays[f"{name}_moving"][moving]),
        "moves": packed(moves[moving], "i1"),
        "moveStep": size,
    }


def pose_data(posing: Posing) -> dict[str, object]:
    """The bones, and rotations of the joints that turn by themselves (`turning`); arrays are base64."""
    skeleton = posing.skeleton
    parents = np.asarray(posing.skeleton.parents)
    known = human_skeleton(skeleton.parents)
    assert known is not None  # only bodies are posed
    alike = np.abs(posing.turns - posing.turns[:, parents]).max(axis=(0, 2, 3)) < _STILL
    alike[0] = False
    return {
        "turning": np.flatnonzero(~alike).tolist(),
        "turns": packed(pack_turns(posing.turns[:, ~alike]), "<u4"),
        "rest": packed(skeleton.rest_joints, "<f4"),
        "stretch": packed(stretches(known, skeleton), "<f4"),
        "size": round(figure_size(known, skeleton), 5),
    }


def pack_turns(turns: NDArray[np.floating]) -> NDArray[np.uint32]:
    """Rotation matrices [..., 3, 3] as 32-bit numbers [...]."""
    from scipy.spatial.transform import Rotation

    quaternions = Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_quat()
    largest = np.abs(quaternions).argmax(axis=1)
    rows = np.arange(len(quaternions))
    # q and -q are one rotation: with the largest component positive, the reader can compute it.
    quaternions *= np.sign(quaternions[rows, largest])[:, None]
    others = np.stack([quaternions[rows, (largest + k) % 4] for k in (1, 2, 3)], axis=1)
    # The middle step is exactly 0, so that a figure at rest is.
    steps = np.round((others * np.sqrt(0.5) + 0.5) * _TURN_STEPS).astype(np.uint32)
    out = largest.astype(np.uint32) << 30 | steps[:, 0] << 20 | steps[:, 1] << 10 | steps[:, 2]
    return np.asarray(out.reshape(turns.shape[:-2]), dtype=np.uint32)


def packed(values: NDArray[np.generic], kind: DTypeLike | None = None) -> str:
    """The bytes of an array, little-endian, as base64."""
    return base64.b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode("ascii")


def quantise(
    joints: NDArray[np.floating],
) -> tuple[NDArray[np.uint16], NDArray[np.float64], NDArray[np.float64]]:
    """Joints [T, N, 3] to 16-bit integers with joints = low + step * integers, per axis."""
    exact = np.asarray(joints, np.float64)
    low = exact.min(axis=(0, 1))
    # An axis without extent must not divide by zero.
    step = np.maximum((exact.max(axis=(0, 1)) - low) / 65535.0, 1e-9)
    return np.round((exact - low) / step).astype("<u2"), low, step


def viewer_script(bodies: bool = True) -> str:
    """The viewer's own scripts as one, defining `motionloomViewer(element, data, options)`.

    Without `bodies` it lacks the skinned body's mesh (about 0.5 MB) and draws sticks only.
    """
    body = "\n".join(resource(f"viewer/{name}.js") for name in SCRIPTS)
    mesh = safe_json(mesh_data()) if bodies else "null"
    head = f"'use strict';\nconst BODY = {mesh};"
    foot = "window.motionloomViewer = mountViewer;"
    return f"(function () {{\n{head}\n{body}\n{foot}\n}})();"


def safe_json(data: object) -> str:
    """JSON that cannot end or open a script element, whatever the strings in it say."""
    text = json.dumps(data, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def fill(template: str, **parts: str) -> str:
    """Replace each `@@NAME@@`, in one pass, so that inserted text is never searched again."""
    return re.sub("@@([A-Z]+)@@", lambda match: parts[match[1]], template)


@cache
def resource(name: str) -> str:
    """Text of a file of the folder `web`."""
    return (resources.files("motionloom.pipeline.render") / "web" / name).read_text(encoding="utf-8")
