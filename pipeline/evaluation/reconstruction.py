"""Reconstruction errors of a tokenizer in millimetres, beside two reference baselines.

As the papers count it (HumanTOMATO Tables 3, 6 and 7; `joint_errors`, equal to the public code): `mpjpe` with
the root of each frame moved to the origin, `pa_mpjpe` after a similarity alignment of each frame, `accel` of
positions in the world, in mm / frame^2; of all joints, of the body's (`_body`) and of the hands' (`_hand`),
means over frames. The paper does not say what its hands are aligned by; their errors there are below the
body's, and so must be measured from the wrist, as here.

Our own **[ours]**, means over clips: `pose` with root and heading aligned, so that a figure that faces
another way is no other pose, `pose_body`, `pose_hand`; and `world`, where the path counts.

Of faces: errors of expressions, and of a head's vertices where the user has its model (v.-err. of Tables 2
and 6, which the paper does not define: the mean distance of the vertices that expressions move **[ours]**).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import HANDS
from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.motion.layout import BODY_JOINTS, FINGERS, WRISTS
from motionloom.datasets.motion.npz import NpzFile
from motionloom.models.metrics.reconstruction import JointErrors, joint_errors, mpjpe
from motionloom.pipeline.contract.units import Row
from motionloom.pipeline.evaluation.estimate import row_estimates, weighted
from motionloom.pipeline.evaluation.figures import (
    MEAN_FACE,
    MODEL,
    NEAREST,
    STILL,
    Estimate,
    Figure,
    Metric,
    Protocol,
    group_figures,
)
from motionloom.pipeline.evaluation.reference_baselines import local_joints
from motionloom.pipeline.evaluation.truth import Truth, reconstruct_all
from motionloom.pipeline.store.networks import TrainedTokenizer

_CLIP_ROWS = {"": MODEL, "_nearest_train_clip": NEAREST, "_mean_pose": STILL}
_FACE_ROWS = {"": MODEL, "_mean": MEAN_FACE}
"""End of the name of a clip's error -> the row of a table."""
_PARTS = (("", ""), ("_body", ", body"), ("_hand", ", hands"))
PUBLISHED = (
    *(
        Metric(f"reconstruction.{name}{part}", f"{title}{of}", "lower", "mm")
        for name, title in (("mpjpe", "MPJPE"), ("pa_mpjpe", "PA-MPJPE"), ("accel", "ACCEL"))
        for part, of in _PARTS
    ),
    Metric("reconstruction.bits_per_second", "bit/s"),
)
OURS = (
    Metric("reconstruction.pose", "pose", "lower", "mm"),
    Metric("reconstruction.pose_body", "body", "lower", "mm"),
    Metric("reconstruction.pose_hand", "fingers from the wrist", "lower", "mm"),
    Metric("reconstruction.world", "in the world", "lower", "mm"),
)

FACES = (
    Metric("face.expression", "expression error", "lower"),
    Metric("face.vertex", "vertex error", "lower", "mm"),
)
_SHAPES = 300
_EXPRESSIONS = 50
"""Directions of shape, which come first in a model's file, and those of expression that layouts have."""
_MODEL_BYTES = 2**30


def clip_errors(
    tokenizer: TrainedTokenizer,
    nearest: tuple[NDArray[np.float64], NDArray[np.float64]],
    truth: Truth,
    rebuilt: NDArray[np.float32],
) -> Row:
    """Both families of errors of one clip: of its reconstruction, of the mean pose (`_mean_pose`) and of the
    nearest training clip (`_nearest_train_clip`). The papers' are weighted by frames.

    `nearest` is that clip's motion (`NearestClip`), `rebuilt` [T, D] the tokenizer's reconstruction. For a
    clip without hands only the body's joints count, and there is no `_hand`.
    """
    layout = tokenizer.layout
    body = tokenizer.stats.mean[layout.part("bodyhand")].astype(np.float32)
    real = torch.from_numpy(local_joints(truth.features, layout))
    target = torch.from_numpy(truth.joints)
    constant = np.broadcast_to(body, truth.features.shape)
    compared = {
        "": (local_joints(rebuilt, layout), joints_of(rebuilt, layout)),
        "_mean_pose": (local_joints(constant, layout), joints_of(constant, layout)),
        "_nearest_train_clip": nearest,
    }
    # Hands that were never recorded are no truth to be compared with.
    joints = slice(None) if truth.present & HANDS else slice(BODY_JOINTS)
    out: Row = {}
    for suffix, motion in compared.items():
        pose, place = (torch.from_numpy(array)[:, joints] for array in motion)
        for part, errors in published_errors(place, target[:, joints]).items():
            for name, frames in (
                ("mpjpe", errors.frames),
                ("pa_mpjpe", errors.frames),
                ("accel", errors.accel_frames),
            ):
                out |= weighted(f"{name}{part}{suffix}", getattr(errors, name).item(), frames.item())
        ours = pose_errors(pose, real[:, joints])
        ours.setdefault("pose_body", ours["pose"])  # a body without hands is all body
        ours["world"] = mpjpe(place, target[:, joints], root=None)
        out |= {f"{name}{suffix}": float(value.mean()) for name, value in ours.items()}
    return out


def clip_error_figures(clips: Sequence[Row], bits_per_second: float, protocol: Protocol) -> list[Figure]:
    """Figures of `clip_errors`: the papers' over all frames, ours over all clips."""
    rows = _by_row(row_estimates([clips]), "reconstruction", _CLIP_ROWS)
    rows[MODEL]["reconstruction.bits_per_second"] = Estimate(bits_per_second)
    return [
        *group_figures("Reconstruction as the papers count it (lower is better)", PUBLISHED, rows, protocol),
        *group_figures(
            "Reconstruction with root and heading aligned, and in the world (lower is better)",
            OURS,
            rows,
            protocol,
        ),
    ]


def _by_row(
    estimates: Mapping[str, Estimate], prefix: str, rows: Mapping[str, str]
) -> dict[str, dict[str, Estimate]]:
    """Estimates by row of a table; the end of a name says the row (`rows`)."""
    out: dict[str, dict[str, Estimate]] = {row: {} for row in rows.values()}
    for name, value in estimates.items():
        end = max((end for end in rows if name.endswith(end)), key=len)
        out[rows[end]][f"{prefix}.{name.removesuffix(end)}"] = value
    return out


def published_errors(motion: Tensor, real: Tensor) -> dict[str, JointErrors]:
    """Sums over the frames of positions [T, N, 3]: "" of all joints, "_body", and "_hand" if any."""
    length = torch.tensor([len(real)])
    pair = (motion[None], real[None], length)
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


def expression_directions(path: Path) -> NDArray[np.float64]:
    """How far each expression value moves each vertex that they move, metres [V, 3, 50], of a body model.

    `path` is an .npz with `shapedirs` [V, 3, 300 + 50 or more], as SMPL-X's of 2020 and FLAME's are. Its
    licence lets nobody pass it on, so it is the user's.
    """
    with NpzFile(path) as file:
        directions = file.numbers("shapedirs", limit=_MODEL_BYTES)
    if directions.ndim != 3 or directions.shape[1] != 3 or directions.shape[2] < _SHAPES + _EXPRESSIONS:
        raise UserError(
            f"{path}: shapedirs is {list(directions.shape)}, not [V, 3, {_SHAPES} + {_EXPRESSIONS}]; take "
            f"the model with 300 shape and 100 expression directions, such as SMPLX_NEUTRAL_2020.npz"
        )
    expression = directions[:, :, _SHAPES : _SHAPES + _EXPRESSIONS]
    moved = np.abs(expression).max(axis=(1, 2)) > 1e-9
    if not moved.any() or not np.isfinite(expression).all():
        raise UserError(f"{path}: the expression directions of shapedirs are all 0, or NaN or infinity")
    return np.asarray(expression[moved], dtype=np.float64)


def face_errors(
    tokenizer: TrainedTokenizer, truth: Truth, directions: NDArray[np.float64] | None = None
) -> Row:
    """Errors of one clip with a face, weighted by its frames: the norm of the difference of the expressions
    (50 values) by a tokenizer of faces or of everything (`expression`), and of the mean one (`_mean`).

    With `directions` [V, 3, 50] (`expression_directions`) also the mean distance of vertices in mm
    (`vertex`): shape moves both faces alike, so it is that of the expressions' difference.
    """
    real = truth.face
    if real is None:
        return {}
    columns = tokenizer.layout.slice("face")
    rebuilt = reconstruct_all(tokenizer, truth)[:, columns]
    mean = tokenizer.stats.mean[columns]
    out = Row()
    frames = float(len(real))
    for suffix, expression in (("", rebuilt), ("_mean", mean)):
        error = (expression - real).astype(np.float64)
        out |= weighted(f"expression{suffix}", float(np.linalg.norm(error, axis=-1).sum()), frames)
        if directions is not None:
            moved = 1000 * np.linalg.norm(error @ directions.swapaxes(-1, -2), axis=-1)  # [V, T]
            out |= weighted(f"vertex{suffix}", float(moved.mean(0).sum()), frames)
    return out


def face_figures(clips: Sequence[Row], protocol: Protocol) -> list[Figure]:
    """Figures of `face_errors`, over the frames of all clips with a face; without such clips none."""
    rows = _by_row(row_estimates([clips]), "face", _FACE_ROWS)
    return group_figures("Reconstruction of faces (lower is better)", FACES, rows, protocol)
