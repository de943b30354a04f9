"""Motions that a model made of a task, moved onto what it asks exactly, and measured."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.datasets.motion.body.landing import eased, landed, reached
from motionloom.datasets.motion.canonical import ground, retarget
from motionloom.datasets.motion.features.codec import encode, encode_exact, place
from motionloom.datasets.motion.features.torch_joints import torch_way
from motionloom.datasets.motion.layout import PIECES, piece_columns, piece_joints
from motionloom.datasets.schema import UserError
from motionloom.models.diffusion.observed import known_columns
from motionloom.models.metrics.dance import foot_skating
from motionloom.pipeline.contract.editing import EditReport
from motionloom.pipeline.contract.generation import Motion, MotionGenerator
from motionloom.pipeline.inference.edits.frames import EditFrames, RootPath

WORDS_EASE = 0.3
"""Seconds in which one stretch of words takes over from another [ours]."""
_REACH_SECONDS = 0.5
"""In which a figure goes to a pin and comes back [ours]."""
_SEAM_FRAMES = 2
"""Frames on either side of a seam that belong to it."""


def why_no_edits(generator: MotionGenerator) -> str | None:
    """Why a generator cannot fill in what a clip leaves free; None where it can."""
    if generator.capabilities.edit is not None:
        return None
    return (
        f"this model ({generator.method}) makes whole motions and edits none; take one whose body is made by "
        f"diffusion, such as the package's `inbetween`"
    )


def require_editor(generator: MotionGenerator) -> Callable[..., list[Motion]]:
    """The generator's `edit`, if it has one."""
    if generator.capabilities.edit is None:
        raise UserError(why_no_edits(generator))
    return generator.capabilities.edit


def require_work(frames: EditFrames) -> None:
    """Refuse a task that leaves nothing to make, and one that takes nothing from the clip."""
    present = np.isin(np.arange(len(PIECES)), piece_columns(frames.layout))
    if frames.pieces[:, present].all():
        raise UserError(
            "everything of the clip is kept, so there is nothing to make: keep less of it, or give seconds "
            "or lead for more"
        )
    if not (frames.pieces.any() or frames.pins or np.isfinite(frames.path).any()):
        raise UserError(
            "nothing of the clip is kept and nothing else is asked: say what to keep, draw a path, or pin a "
            "joint"
        )


def word_shares(frames: EditFrames) -> list[tuple[str, NDArray[np.float64]]]:
    """Each text of the task, the caption last, and its share of every frame [T]; a frame's sum to 1."""
    task, fps, at = frames.task, frames.layout.fps, np.arange(frames.frames)
    ease = max(1.0, WORDS_EASE * fps)
    out = []
    for words in task.words:
        start, end = ((seconds * fps) + frames.lead for seconds in (words.start, words.end))
        out.append((words.text, np.clip(np.minimum(at - start, end - at) / ease + 0.5, 0.0, 1.0)))
    rest = 1 - sum((share for _, share in out), np.zeros(frames.frames))
    out.append((task.caption, np.clip(rest, 0.0, 1.0)))
    total = np.sum([share for _, share in out], axis=0)
    return [(text, share / total) for text, share in out if share.any()]


def finish(
    frames: EditFrames, made: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float64], EditReport]:
    """Move features of body and hands [T, D], as a model made them, onto what the task asks exactly.

    Returns the features, the joints [T, N, 3] in the clip's world, and how near they are to the task.
    """
    layout, task = frames.layout.without_face(), frames.task
    root = _made_root(frames, made)
    joints = place(made, layout, np.exp(1j * root.heading), root.place * frames.scale)
    if frames.scale != 1.0:
        # The model's figure is not the clip's: pose the clip's bones, and put its root where the model's is.
        own = layout.skeleton.with_lengths_of(frames.joints).offsets
        joints = retarget(joints, layout.skeleton, own)
        joints = landed(joints, root.heading, root.place - ground(joints[:, 0]), np.zeros(len(joints)))[0]
        joints[..., 1] += frames.lift
    # The root is led to where it is kept or asked for, and eased between, so that nothing jumps.
    rooted, inside, exact = frames.rooted, frames.inside, task.exact
    target, targeted, heading = root.place.copy(), rooted.copy(), root.heading.copy()
    target[inside] = np.where(rooted[inside], frames.clip_root.place, target[inside])
    heading[inside] = np.where(rooted[inside], frames.clip_root.heading, heading[inside])
    if exact:
        on_path = ~np.isnan(frames.path)
        target[on_path] = frames.path[on_path]
        targeted |= on_path
    shift, turn = eased(target - root.place, targeted), eased(heading - root.heading, rooted)
    joints, heading = landed(joints, root.heading, shift, turn)
    # Kept joints are the clip's own bits, before pins bend the limbs around them.
    kept = frames.kept_joints
    joints[inside][kept[inside]] = frames.joints[kept[inside]]
    if exact:
        blend = max(2, round(_REACH_SECONDS * layout.fps))
        joints = reached(joints, layout.skeleton, frames.pins, kept, blend)
    features, report = _features(frames, joints, heading), _report(frames, joints, heading)
    return features, frames.to_world(joints), report


def _made_root(frames: EditFrames, made: NDArray[np.float32]) -> RootPath:
    """The root's path in what a model made, in the clip's size, seen from the clip's first frame."""
    heading, x, z = (one.numpy() for one in torch_way(torch.from_numpy(made).double(), frames.layout))
    first, anchor = int(frames.places.anchor[0]), frames.anchor
    place = (z + 1j * x) * np.exp(-1j * heading[first])
    away = (place - place[first]) * np.exp(1j * anchor.heading[0]) / frames.scale
    return RootPath(heading - heading[first] + anchor.heading[0], anchor.place[0] + away)


def _features(
    frames: EditFrames, joints: NDArray[np.float64], heading: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Columns of body and hands [T, D] that decode to the joints; what is kept has the clip's own bits."""
    layout = frames.layout.without_face()
    if layout.family != "exact":
        # These are made of steps between joints, so there is one frame more of joints.
        return encode(np.concatenate([joints, 2 * joints[-1:] - joints[-2:-1]]), layout)
    features = encode_exact(joints, layout, heading)
    if frames.scale != 1.0:
        return features
    columns = frames.layout.part("bodyhand")
    known = known_columns(torch.from_numpy(frames.pieces)[None], frames.layout, columns)
    return np.where(known[0].numpy(), frames.features[:, columns], features)


def _report(frames: EditFrames, joints: NDArray[np.float64], heading: NDArray[np.float64]) -> EditReport:
    """How near joints [T, N, 3] are to the task."""
    fps, inside, pieces = frames.layout.fps, frames.inside, piece_joints(frames.layout)
    # Without the legs the figure goes elsewhere, so what is kept of it is compared within the figure.
    away = np.linalg.norm(joints[inside] - frames.joints, axis=-1)
    local = _local(joints[inside], heading[inside]) - _local(frames.joints, frames.clip_root.heading)
    away = np.where(frames.rooted[inside][:, None], away, np.linalg.norm(local, axis=-1))
    kept = frames.pieces[inside][:, pieces]
    on_path = ~np.isnan(frames.path)
    off_path = np.abs(ground(joints[on_path, 0]) - frames.path[on_path])
    names = frames.layout.skeleton.joints
    pins = {
        f"{names[joint]} at {(frame - frames.lead) / fps:.2f} s": 100
        * float(np.linalg.norm(joints[frame, joint] - np.asarray(wanted)))
        for (frame, joint), wanted in frames.pins.items()
    }
    kept_body = frames.pieces[:, np.isin(np.arange(len(PIECES)), pieces)]
    # Frames after which it changes what is kept.
    seams = np.flatnonzero((kept_body[1:] != kept_body[:-1]).any(axis=1))
    return EditReport(
        kept_cm=100 * float(away[kept].max()) if kept.any() else float("nan"),
        path_cm=100 * float(off_path.max()) if on_path.any() else float("nan"),
        pins_cm=pins,
        seams=seam_acceleration(joints, fps, seams),
        inside=float(accelerations(frames.joints, fps).mean()),
        skating=foot_skating(joints, fps),
        clip_skating=foot_skating(frames.joints, fps),
    )


def accelerations(joints: NDArray[np.floating], fps: float) -> NDArray[np.float64]:
    """Mean size of the joints' accelerations in every inner frame [T - 2], m/s², of joints [T, N, 3]."""
    second = np.diff(np.asarray(joints, dtype=np.float64), n=2, axis=0) * fps**2
    return np.asarray(np.linalg.norm(second, axis=-1).mean(axis=-1))


def seam_acceleration(joints: NDArray[np.floating], fps: float, seams: NDArray[np.int64]) -> float:
    """Mean acceleration of joints [T, N, 3] in the frames around seams; NaN where there are none [ours].

    A jump between two frames is an acceleration of twice its size in each of them.
    """
    size = accelerations(joints, fps)
    inner = np.arange(1, len(joints) - 1)
    near = (np.abs(inner[:, None] - seams - 0.5) < _SEAM_FRAMES).any(axis=1)
    return float(size[near].mean()) if near.any() else float("nan")


def _local(joints: NDArray[np.float64], heading: NDArray[np.float64]) -> NDArray[np.float64]:
    """Joints [T, N, 3] from the root's place on the floor, in the heading."""
    plane = ground(joints)
    plane = (plane - plane[:, :1]) * np.exp(-1j * heading)[:, None]
    return np.stack([plane.imag, joints[..., 1], plane.real], axis=-1)
