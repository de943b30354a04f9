"""Made-up clips in AMASS's form, for the tests of its converter."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from motionloom.datasets.base.records import Manifest, Split
from motionloom.datasets.convert.common.conversion import run_conversion
from motionloom.datasets.convert.registry import prepare
from motionloom.datasets.convert.sets.amass import AmassConfig
from motionloom.datasets.motion.body.smpl import BodyModel, smpl_joints
from motionloom.datasets.motion.canonical import canonicalize
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.shards.reader import ShardDataset

SPEED, TURN = 0.7, 0.6
"""Metres and radians (to the left) a second of the clip that all tests use."""

SPLITS: tuple[Split, ...] = ("train", "val", "test")
LEFT_KNEE, LEFT_ELBOW, LEFT_INDEX = 4, 18, 22


def walk(fps: float, seconds: float = 3.0, *, hands: bool = True) -> dict[str, NDArray[Any]]:
    """SMPL-H parameters, Z up: walks a left turn, bends the left knee and elbow, curls the left index."""
    times = np.arange(int(seconds * fps + 1e-6) + 1) / fps
    upright = Rotation.from_rotvec([math.pi / 2, 0, 0])  # Y up to Z up: the figure then faces -Y
    turn = Rotation.from_rotvec(np.outer(0.4 + TURN * times, [0, 0, 1]))
    poses = np.zeros((len(times), 52, 3))
    poses[:, 0] = (turn * upright).as_rotvec()
    poses[:, LEFT_KNEE, 0] = 0.5 + 0.3 * np.sin(2 * times)
    poses[:, LEFT_ELBOW, 1] = -0.6 - 0.4 * np.cos(3 * times)
    if hands:
        poses[:, LEFT_INDEX, 2] = 0.5 * np.sin(2 * times)
    angle = 0.4 + TURN * times
    # Integral of SPEED * (sin angle, -cos angle): the facing direction of a figure turned by `angle`.
    trans = np.stack([-np.cos(angle), -np.sin(angle), np.zeros(len(times))], axis=1) * SPEED / TURN
    return {
        "poses": poses.reshape(len(times), 156),
        "trans": trans + np.array([3.0, -2.0, 0.9]),
        "betas": np.linspace(-1, 1, 16),
        "gender": np.array("female"),
        "mocap_framerate": np.array(fps),
    }


def save(path: Path, **members: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **members)
    return path


def as_smplx(clip: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """The same clip in SMPL-X form, with a jaw that must not reach the fingers."""
    poses = clip["poses"]
    face = np.full((len(poses), 9), 0.3)
    out = {k: v for k, v in clip.items() if k not in ("poses", "mocap_framerate")}
    return out | {
        "poses": np.concatenate([poses[:, :66], face, poses[:, 66:]], axis=1),
        "mocap_frame_rate": clip["mocap_framerate"],
        "surface_model_type": np.array("smplx"),
    }


def in_parts(clip: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    poses = clip["poses"]
    parts = {"root_orient": poses[:, :3], "pose_body": poses[:, 3:66], "pose_hand": poses[:, 66:]}
    return {k: v for k, v in clip.items() if k != "poses"} | parts | {"pose_jaw": np.zeros((len(poses), 3))}


def make(source: Path, out: Path, *, workers: int = 1, **options: Any) -> Manifest:
    conversion = prepare(AmassConfig(source=source, **options), workers=workers)
    return run_conversion(conversion, out, workers=workers, progress=False)


def features(folder: Path) -> dict[str, NDArray[np.float32]]:
    """Motion of every clip by id."""
    out = {}
    for split in SPLITS:
        if any(shard.split == split for shard in Manifest.load_json(folder / "manifest.json").shards):
            dataset = ShardDataset.open(folder, split)
            out |= {clip_id: dataset.motion(i) for i, clip_id in enumerate(dataset.ids)}
    return out


def meta_of(folder: Path, clip_id: str) -> Any:
    for shard in Manifest.load_json(folder / "manifest.json").shards:
        dataset = ShardDataset.open(folder, shard.split)
        if clip_id in list(dataset.ids):
            position = list(dataset.ids).index(clip_id)
            return dataset.meta(position), dataset.texts(position)
    raise AssertionError(f"{clip_id} is in no split")


def expected_joints(fps: float, seconds: float = 3.0, joints: int = 22) -> NDArray[np.float64]:
    """Canonical joints of `walk` at `fps`, straight from its formula, with the neutral skeleton."""
    clip = walk(fps, seconds)
    body = BodyModel.neutral("smpl22" if joints == 22 else "smplx52")
    world = smpl_joints(clip["poses"].reshape(-1, 52, 3)[:, :joints], clip["trans"], body)
    return np.asarray(canonicalize(world[..., [0, 2, 1]] * [1, 1, -1]))


def reasons(manifest: Manifest) -> dict[str, str]:
    return {drop.source: drop.reason for drop in manifest.dropped}


def body_model(path: Path, joints: int, scale: float) -> Path:
    """A model whose rest joints are the neutral skeleton's times `scale`, and grow with the first beta."""
    rest = Skeleton.named("smplx52").rest_joints
    if joints == 55:
        rest = np.insert(rest, 22, np.zeros((3, 3)), axis=0)
    parents = np.array(Skeleton.named("smplx52").parents)
    if joints == 55:
        later = np.where(parents > 21, parents + 3, parents)[22:]
        parents = np.concatenate([parents[:22], [15, 15, 15], later])
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(
        path,
        J_regressor=np.eye(joints),
        v_template=rest * scale + [0.0, 0.3, 0.1],
        shapedirs=0.05 * rest[:, :, None],
        kintree_table=np.stack([parents, np.arange(joints)]),
    )
    return path
