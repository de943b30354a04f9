"""What a model made of a task, put where it must be; and how well it keeps to the task."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.datasets.motion.body.landing import eased, landed, reached
from motionloom.datasets.motion.canonical import ground, retarget
from motionloom.datasets.motion.features.codec import encode
from motionloom.datasets.motion.features.exact import encode_exact, place
from motionloom.datasets.motion.features.torch_joints import torch_way
from motionloom.datasets.motion.figure_parts import PIECES, piece_joints
from motionloom.models.diffusion.observed import known_columns
from motionloom.models.metrics.dance import foot_skating
from motionloom.models.metrics.editing import accelerations, seam_acceleration, seams_of
from motionloom.pipeline.contract.editing import EditReport
from motionloom.pipeline.inference.edits.frames import EditFrames

_REACH_SECONDS = 0.5
"""In which a figure goes to a pin and comes back."""


@dataclass(frozen=True)
class Edit:
    """One result."""

    joints: NDArray[np.float64]
    """[T, N, 3] in the clip's world, the floor at height 0."""
    features: NDArray[np.float32]
    """Columns of body and hands [T, D]."""
    face: NDArray[np.float32] | None
    """[T, 50]."""
    report: EditReport


def finish(asked: EditFrames, made: NDArray[np.float32], face: NDArray[np.float32] | None) -> Edit:
    """The result of features of body and hands [T, D], as a model made them."""
    layout = asked.layout.without_face()
    heading, way = _way_of(asked, made)
    joints = place(made, layout, np.exp(1j * heading), way * asked.scale)
    if asked.scale != 1.0:
        own = layout.skeleton.with_lengths_of(asked.joints).offsets
        joints = retarget(joints, layout.skeleton, own)
        joints = landed(joints, heading, way - ground(joints[:, 0]), np.zeros(len(joints)))[0]
        joints[..., 1] += asked.lift

    rooted, inside = asked.rooted, asked.inside
    aim, aimed = way.copy(), rooted.copy()
    turn = heading.copy()
    aim[inside] = np.where(rooted[inside], asked.clip_way.place, aim[inside])
    turn[inside] = np.where(rooted[inside], asked.clip_way.heading, turn[inside])
    if asked.task.exact:
        on_path = ~np.isnan(asked.path)
        aim[on_path] = asked.path[on_path]
        aimed |= on_path
    joints, heading = landed(joints, heading, eased(aim - way, aimed), eased(turn - heading, rooted))
    kept = asked.kept_joints
    joints[inside][kept[inside]] = asked.joints[kept[inside]]
    if asked.task.exact:
        blend = max(2, round(_REACH_SECONDS * layout.fps))
        joints = reached(joints, layout.skeleton, asked.pins, kept, blend)
    features = _features(asked, joints, heading)
    report = _report(asked, joints, heading)
    return Edit(asked.to_world(joints), features, face, report)


def _way_of(
    asked: EditFrames, made: NDArray[np.float32]
) -> tuple[NDArray[np.float64], NDArray[np.complex128]]:
    """Heading and place of the root [T] on the clip's size, seen from the clip's first frame."""
    heading, x, z = (one.numpy() for one in torch_way(torch.from_numpy(made).double(), asked.layout))
    first, anchor = asked.way.anchor, asked.anchor
    place = (z + 1j * x) * np.exp(-1j * heading[first])
    away = (place - place[first]) * np.exp(1j * anchor.heading[0]) / asked.scale
    return heading - heading[first] + anchor.heading[0], anchor.place[0] + away


def _features(
    asked: EditFrames, joints: NDArray[np.float64], heading: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Columns of body and hands [T, D] that decode to the joints; what is kept has the clip's own bits."""
    layout = asked.layout.without_face()
    if layout.family != "exact":
        # These are made of steps between joints, so there is one frame more of joints.
        return encode(np.concatenate([joints, 2 * joints[-1:] - joints[-2:-1]]), layout)
    features = encode_exact(joints, layout, heading)
    if asked.scale != 1.0:
        return features
    known = known_columns(torch.from_numpy(asked.pieces)[None], asked.layout, asked.layout.part("bodyhand"))
    own = asked.features[:, asked.layout.part("bodyhand")]
    return np.where(known[0].numpy(), own, features)


def _report(asked: EditFrames, joints: NDArray[np.float64], heading: NDArray[np.float64]) -> EditReport:
    fps, inside = asked.layout.fps, asked.inside
    made = joints[inside]
    away = np.linalg.norm(made - asked.joints, axis=-1)
    local = _local(made, heading[inside]) - _local(asked.joints, asked.clip_way.heading)
    away = np.where(asked.rooted[inside][:, None], away, np.linalg.norm(local, axis=-1))
    kept = asked.pieces[inside][:, piece_joints(asked.layout)]
    on_path = ~np.isnan(asked.path)
    off = np.abs(ground(joints[on_path, 0]) - asked.path[on_path])
    names = asked.layout.skeleton.joints
    pins = {
        f"{names[joint]} at {(frame - asked.lead) / fps:.2f} s": 100
        * float(np.linalg.norm(joints[frame, joint] - np.asarray(wanted)))
        for (frame, joint), wanted in asked.pins.items()
    }
    body = np.isin(np.arange(len(PIECES)), piece_joints(asked.layout))
    return EditReport(
        kept_cm=100 * float(away[kept].max()) if kept.any() else float("nan"),
        path_cm=100 * float(off.max()) if on_path.any() else float("nan"),
        pins_cm=pins,
        seams=seam_acceleration(joints, fps, seams_of(asked.pieces[:, body])),
        inside=float(accelerations(asked.joints, fps).mean()),
        skating=foot_skating(joints, fps),
        clip_skating=foot_skating(asked.joints, fps),
    )


def _local(joints: NDArray[np.float64], heading: NDArray[np.float64]) -> NDArray[np.float64]:
    """Joints [T, N, 3] from the root's place on the floor, in the heading."""
    plane = ground(joints)
    plane = (plane - plane[:, :1]) * np.exp(-1j * heading)[:, None]
    return np.stack([plane.imag, joints[..., 1], plane.real], axis=-1)
