"""Figures of a run on held-out clips, each beside its trivial answer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from motionloom.datasets.motion.joints import joints_of, local_joints_of
from motionloom.datasets.motion.layout import BODY_JOINTS, WRISTS, MotionLayout
from motionloom.datasets.schema import HANDS, PRESENT_ALL
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.datasets.synth.measure import agrees
from motionloom.models.metrics.reconstruction import accel, mpjpe, pa_mpjpe
from motionloom.models.metrics.retrieval import recall
from motionloom.pipeline.evaluation.truth import Truth, reconstruct_truth
from motionloom.pipeline.store.networks import LoadedTma, TrainedTokenizer

KEY_FRAMES = 16
"""Moments of a clip that the nearest-clip search compares."""

LEFT_FINGERS, RIGHT_FINGERS = range(22, 37), range(37, 52)
"""Joints of `smplx52`."""


@dataclass(frozen=True)
class Interval:
    """Mean and half-width of the 95 % interval over repetitions."""

    mean: float
    half_width: float

    @staticmethod
    def of(values: Sequence[float]) -> Interval:
        """Of repeated measurements."""
        array = np.asarray(values, dtype=np.float64)
        half = 1.96 * array.std(ddof=1) / np.sqrt(len(array)) if len(array) > 1 else 0.0
        return Interval(float(array.mean()), float(half))


def local_joints(features: NDArray[np.float32], layout: MotionLayout) -> NDArray[np.float64]:
    """Joints [T, N, 3] relative to the root, turned into its heading: the pose without its path.

    Layouts that hold such positions are read as they are, so that errors of the path play no part.
    """
    if not layout.has("positions"):
        return local_joints_of(joints_of(features, layout), layout.fps)
    positions = features[..., layout.slice("positions")].astype(np.float64)
    positions = positions.reshape(*positions.shape[:-1], layout.num_joints - 1, 3)
    height = features[..., layout.slice("root_height")].astype(np.float64)
    positions[..., 1] -= height
    return np.concatenate([np.zeros_like(positions[..., :1, :]), positions], axis=-2)


def reconstruction_figures(
    tokenizer: TrainedTokenizer, train: ClipDataset, truths: Sequence[Truth]
) -> dict[str, float]:
    """Errors in millimetres of the tokenizer, of the mean pose and of the nearest training clip.

    `mpjpe_*` compares poses (root and heading aligned), `global_*` compares positions in the world, the path
    included. Of a clip without hands the body's joints alone count, and nothing in `mpjpe_hand`.
    """
    layout = tokenizer.layout
    body = tokenizer.stats.mean[tokenizer.layout.part("bodyhand")].astype(np.float32)
    nearest = NearestClip(train)
    rows: dict[str, list[float]] = {}
    for truth in truths:
        real = local_joints(truth.features, layout)
        found = reconstruct_truth(tokenizer, truth)
        constant = np.broadcast_to(body, truth.features.shape)
        compared = {
            "": (local_joints(found, layout), joints_of(found, layout)),
            "_mean_pose": (local_joints(constant, layout), joints_of(constant, layout)),
            "_nearest_train_clip": nearest.motion(truth.features, truth.present),
        }
        joints = slice(None) if truth.present & HANDS else slice(BODY_JOINTS)
        frames = len(truth.features)
        target = torch.from_numpy(truth.joints)[:, joints]
        rebuilt = torch.from_numpy(compared[""][1])[:, joints]
        values = {"pa_mpjpe": pa_mpjpe(rebuilt, target)}
        if frames > 2:
            values["accel"] = accel(rebuilt, target)
        for suffix, motion in compared.items():
            pose, place = (torch.from_numpy(array)[:, joints] for array in motion)
            errors = pose_errors(pose, torch.from_numpy(real)[:, joints])
            if layout.num_joints > BODY_JOINTS:
                errors.setdefault("mpjpe_body", errors["mpjpe"])
            values |= {f"{k}{suffix}": v for k, v in errors.items()}
            values[f"global_mpjpe{suffix}"] = mpjpe(place, target, root=None)
        for name, value in values.items():
            rows.setdefault(name, []).append(float(value.mean()))
    return {name: float(np.mean(values)) for name, values in rows.items()}


def pose_errors(pose: Tensor, real: Tensor) -> dict[str, Tensor]:
    """Errors per frame [T] in mm of poses [T, N, 3]: all joints and the body's from the root (`mpjpe`,
    `mpjpe_body`), fingers from their wrists (`mpjpe_hand`), the parts of Tables 6 and 7.
    """
    out = {"mpjpe": mpjpe(pose, real)}
    if pose.shape[1] > BODY_JOINTS:
        out["mpjpe_body"] = mpjpe(pose[:, :BODY_JOINTS], real[:, :BODY_JOINTS])
        hands = []
        for wrist, fingers in zip(WRISTS, (LEFT_FINGERS, RIGHT_FINGERS), strict=True):
            hands.append([wrist, *fingers])
        # The wrist itself is at the origin of both, so its zero is taken out of the mean again.
        each = [mpjpe(pose[:, hand], real[:, hand]) * len(hand) / (len(hand) - 1) for hand in hands]
        out["mpjpe_hand"] = torch.stack(each).mean(0)
    return out


class NearestClip:
    """The training clip whose poses, stretched to the same length, come nearest.

    Hands are compared where both clips have them. A motion with hands finds none without, if there are any.
    """

    def __init__(self, train: ClipDataset) -> None:
        self.train = train
        self.columns = train.layout.part("bodyhand")
        keys = [self._key(np.asarray(train.motion(i))[:, self.columns]) for i in range(len(train))]
        self.keys = [np.stack(part) for part in zip(*keys, strict=True)]
        self.norms = [np.square(part).sum(1) for part in self.keys]
        self.with_hands = (train.present & HANDS) > 0

    def _key(self, features: NDArray[np.float32]) -> list[NDArray[np.float64]]:
        """Positions of the body's joints and of the hands', each flat."""
        layout = self.train.layout
        if layout.has("positions"):
            key = stretch(features[:, layout.slice("positions")], KEY_FRAMES)
        else:
            key = stretch(local_joints(features, layout)[:, 1:].reshape(len(features), -1), KEY_FRAMES)
        return [part.ravel() for part in np.split(key, [3 * (BODY_JOINTS - 1)], axis=1)]

    def motion(
        self, features: NDArray[np.float32], present: int = PRESENT_ALL
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(pose, joints) of that clip, [T, N, 3] each, stretched to the T frames of `features`.

        Features are stretched and their velocities scaled with time; where the layout has none, the joints
        are stretched, since angles cannot be averaged. `present` says what `features` hold.
        """
        body, hands = (
            norms - 2 * keys @ key
            for norms, keys, key in zip(self.norms, self.keys, self._key(features), strict=True)
        )
        distance = body
        if present & HANDS and self.with_hands.any():
            distance = np.where(self.with_hands, body + hands, np.inf)
        found = np.asarray(self.train.motion(int(distance.argmin())))[:, self.columns]
        layout = self.train.layout
        if not layout.has("positions"):
            joints = joints_of(found, layout)
            path = stretch(joints.reshape(len(joints), -1), len(features)).reshape(-1, *joints.shape[1:])
            return local_joints_of(path, layout.fps), path
        out = stretch(found, len(features))
        for field in ("root_yaw_velocity", "root_xz_velocity", "velocities"):
            out[:, layout.slice(field)] *= len(found) / len(features)
        near = out.astype(np.float32)
        return local_joints(near, layout), joints_of(near, layout)


def stretch(values: NDArray[Any], frames: int) -> NDArray[np.float64]:
    """Linear resampling of [T, D] to `frames` rows, first and last kept."""
    at = np.linspace(0, len(values) - 1, frames)
    low = np.floor(at).astype(int)
    high = np.minimum(low + 1, len(values) - 1)
    weight = (at - low)[:, None]
    wide = values.astype(np.float64)
    return np.asarray(wide[low] * (1 - weight) + wide[high] * weight)


def embed_motions(
    tma: LoadedTma,
    motions: Sequence[NDArray[np.float32]],
    present: Sequence[int] | None = None,
    batch: int = 64,
) -> Tensor:
    """TMA latents [n, 256] of body-hand features; longer motions are cut at the model's length.

    `present` [n]: what each holds (all when None); the rest is 0, the mean, as in training.
    """
    columns = tma.layout.part(tma.part)
    mean, std = tma.stats.mean[columns], tma.stats.std[columns]
    order = np.argsort([len(m) for m in motions], kind="stable")
    masks = tma.layout.present_columns[:, columns][
        [PRESENT_ALL] * len(motions) if present is None else present
    ]
    out: dict[int, Tensor] = {}
    for start in range(0, len(order), batch):
        rows = order[start : start + batch].tolist()
        cut = [(motions[i][: tma.max_frames] - mean) / std for i in rows]
        length = torch.tensor([len(m) for m in cut])
        motion = torch.zeros(len(cut), int(length.max()), len(columns))
        for row, values in enumerate(cut):
            motion[row, : len(values)] = torch.from_numpy(values.astype(np.float32))
        near = torch.from_numpy(masks[rows])
        for i, latent in zip(rows, tma.embed_motion(motion, length, near).cpu(), strict=True):
            out[i] = latent
    return torch.stack([out[i] for i in range(len(motions))])


def retrieval_figures(
    text: Tensor, motion: Tensor, *, size: int, repeats: int, seed: int
) -> dict[str, Interval]:
    """Recall@1/2/3 both ways among `size` (protocols C and D): mean over batches, interval over repeats."""
    rows: dict[str, list[float]] = {}
    for repeat in range(repeats):
        for name, value in recall(
            text, motion, batch=size, recalls=(1, 2, 3), seed=seed * 1000 + repeat
        ).items():
            if "/R@" in name:
                rows.setdefault(name.replace("/R@", "_r"), []).append(value)
    return {name: Interval.of(values) for name, values in rows.items()}


def chance(k: int, size: int) -> float:
    """Recall@k of a guess."""
    return k / size


def truth_agreement(
    motions: Sequence[tuple[Truth, NDArray[np.float64], NDArray[np.float32] | None]], fps: float
) -> dict[str, float]:
    """Share of motions that do what their clip's caption says, for each attribute that can be measured.

    Only clips of the synthetic source know what they really do.
    """
    rows: dict[str, list[bool]] = {}
    for truth, joints, face in motions:
        if truth.truth is None:
            continue
        found = agrees(truth.truth, joints, face, fps)
        for name, value in found.items():
            rows.setdefault(name, []).append(value)
        rows.setdefault("everything", []).append(all(found.values()))
    return {name: float(np.mean(values)) for name, values in rows.items()}
