"""How far a tokenizer's motions are from what was recorded, beside two trivial answers, in millimetres.

As the papers count it (HumanTOMATO Tables 3, 6 and 7; `joint_errors`, equal to the public code): `mpjpe` with
the root of each frame moved to the origin, `pa_mpjpe` after a similarity alignment of each frame, `accel` of
positions in the world, in mm / frame^2; of all joints, of the body's (`_body`) and of the hands' (`_hand`),
means over frames. The paper does not say what its hands are aligned by; their errors there are below the
body's, and so must be measured from the wrist, as here.

Our own **[ours]**, means over clips: `pose` with root and heading aligned, so that a figure that faces
another way is no other pose, `pose_body`, `pose_hand`; and `world`, where the path counts.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from motionloom.datasets.motion.joints import joints_of
from motionloom.datasets.motion.layout import BODY_JOINTS, WRISTS
from motionloom.datasets.schema import HANDS
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.models.metrics.reconstruction import JointErrors, joint_errors, mpjpe
from motionloom.pipeline.contract.units import Row
from motionloom.pipeline.evaluation.nearest import NearestClip, local_joints
from motionloom.pipeline.evaluation.truth import Truth, reconstruct_all, reconstruct_truth
from motionloom.pipeline.store.networks import TrainedTokenizer

FINGERS = (range(22, 37), range(37, 52))
"""Joints of `smplx52`, left and right."""

_SUM = "sum"
"""Begins the names of a clip's sums over frames: "sum_hand_mean_pose/mpjpe"."""


def clip_errors(
    tokenizer: TrainedTokenizer, nearest: NearestClip, truth: Truth, found: NDArray[np.float32]
) -> Row:
    """Both families of errors of one clip, through the tokenizer, as the mean pose (`_mean_pose`) and as the
    nearest training clip (`_nearest_train_clip`): sums over frames of the papers', means of ours.

    `found` [T, D] is what the tokenizer makes of the clip (`reconstruct_truth`). Of a clip without hands the
    body's joints alone count, and nothing in `_hand`.
    """
    layout = tokenizer.layout
    body = tokenizer.stats.mean[layout.part("bodyhand")].astype(np.float32)
    real = torch.from_numpy(local_joints(truth.features, layout))
    target = torch.from_numpy(truth.joints)
    constant = np.broadcast_to(body, truth.features.shape)
    compared = {
        "": (local_joints(found, layout), joints_of(found, layout)),
        "_mean_pose": (local_joints(constant, layout), joints_of(constant, layout)),
        "_nearest_train_clip": nearest.motion(truth.features, truth.present),
    }
    joints = slice(None) if truth.present & HANDS else slice(BODY_JOINTS)
    out: Row = {}
    for suffix, motion in compared.items():
        pose, place = (torch.from_numpy(array)[:, joints] for array in motion)
        for part, errors in published_errors(place, target[:, joints]).items():
            if layout.num_joints == BODY_JOINTS and part:
                continue  # all of its joints are the body's
            sums = {name: float(value) for name, value in errors._asdict().items()}
            out |= {f"{_SUM}{part}{suffix}/{name}": value for name, value in sums.items()}
        ours = pose_errors(pose, real[:, joints])
        if layout.num_joints > BODY_JOINTS:
            ours.setdefault("pose_body", ours["pose"])
        ours["world"] = mpjpe(place, target[:, joints], root=None)
        out |= {f"{name}{suffix}": float(value.mean()) for name, value in ours.items()}
    return out


def mean_errors(clips: Iterable[Row]) -> dict[str, float]:
    """Of `clip_errors`: the papers' figures over all frames, ours over all clips."""
    sums: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
    ours: dict[str, list[float]] = defaultdict(list)
    for clip in clips:
        for name, value in clip.items():
            key, _, kind = name.removeprefix(_SUM).partition("/")
            if kind:
                sums[key][kind] += value
            else:
                ours[name].append(value)
    out = {name: float(np.mean(values)) for name, values in ours.items()}
    for key, errors in sums.items():
        means = JointErrors(**{name: torch.tensor(value) for name, value in errors.items()}).means()
        out |= {f"{name}{key}": value for name, value in means.items()}
    return out


def reconstruction_figures(
    tokenizer: TrainedTokenizer, train: ClipDataset, truths: Sequence[Truth]
) -> dict[str, float]:
    """Errors over all of the clips `truths`, millimetres."""
    nearest = NearestClip(train)
    rebuilt = ((truth, reconstruct_truth(tokenizer, truth)) for truth in truths)
    return mean_errors(clip_errors(tokenizer, nearest, truth, found) for truth, found in rebuilt)


def published_errors(made: Tensor, real: Tensor) -> dict[str, JointErrors]:
    """Sums over the frames of positions [T, N, 3]: "" of all joints, "_body", and "_hand" where there are."""
    length = torch.tensor([len(real)])
    pair = (made[None], real[None], length)
    out = {"": joint_errors(*pair), "_body": joint_errors(*pair, joints=torch.arange(BODY_JOINTS))}
    if real.shape[1] > BODY_JOINTS:
        left, right = (
            joint_errors(*pair, joints=torch.tensor(list(fingers)), root=wrist)
            for wrist, fingers in zip(WRISTS, FINGERS, strict=True)
        )
        out["_hand"] = left + right
    return out


def pose_errors(pose: Tensor, real: Tensor) -> dict[str, Tensor]:
    """Errors per frame [T] in mm of poses [T, N, 3] that are aligned already: all joints and the body's from
    the root (`pose`, `pose_body`), fingers from their wrists (`pose_hand`).
    """
    out = {"pose": mpjpe(pose, real)}
    if pose.shape[1] > BODY_JOINTS:
        out["pose_body"] = mpjpe(pose[:, :BODY_JOINTS], real[:, :BODY_JOINTS])
        hands = []
        for wrist, fingers in zip(WRISTS, FINGERS, strict=True):
            hands.append([wrist, *fingers])
        # The wrist itself is at the origin of both, so its zero is taken out of the mean again.
        each = [mpjpe(pose[:, hand], real[:, hand]) * len(hand) / (len(hand) - 1) for hand in hands]
        out["pose_hand"] = torch.stack(each).mean(0)
    return out


def face_errors(tokenizer: TrainedTokenizer, truth: Truth, basis: NDArray[np.float64] | None = None) -> Row:
    """Of one clip with a face, sums over its frames: length of the difference of the expressions (50 values)
    by a tokenizer of faces or of everything (`expression`), and of the mean expression; nothing without.

    With a `basis` [V, 3, 50], metres of a head's vertices for each value, also the mean distance of the
    vertices in mm (`vertex`; v.-err. of Tables 2 and 6).
    """
    real = truth.face
    if real is None:
        return {}
    columns = tokenizer.layout.slice("face")
    made, mean = reconstruct_all(tokenizer, truth)[:, columns], tokenizer.stats.mean[columns]

    out = {"frames": float(len(real))}
    for suffix, answer in (("", made), ("_mean", mean)):
        error = (answer - real).astype(np.float64)
        out[f"expression{suffix}"] = float(np.linalg.norm(error, axis=-1).sum())
        if basis is not None:
            moved = np.einsum("vce,te->tvc", basis, error)
            out[f"vertex{suffix}"] = float(1000 * np.linalg.norm(moved, axis=-1).mean(-1).sum())
    return out


def mean_face_errors(clips: Iterable[Row]) -> dict[str, float]:
    """Of `face_errors`: means over the frames of all clips with a face; without such clips nothing."""
    found = [clip for clip in clips if clip]
    frames = sum(clip["frames"] for clip in found)
    names = [name for name in found[0] if name != "frames"] if found else []
    return {name: sum(clip[name] for clip in found) / frames for name in names}


def face_figures(tokenizer: TrainedTokenizer, truths: Sequence[Truth]) -> dict[str, float]:
    """Errors of expressions over all of the clips `truths`."""
    return mean_face_errors(face_errors(tokenizer, truth) for truth in truths)
