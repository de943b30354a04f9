"""BVH files of a standing, swaying figure on our own body skeleton, with the joint map that reads them."""

from __future__ import annotations

import json
import tarfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from motionloom.datasets.motion.bvh.motion import write_bvh
from motionloom.datasets.motion.skeleton import Skeleton

SKELETON = Skeleton.named("smpl22")


def write_clip(path: Path, seed: int, frames: int = 90, fps: float = 30.0, *, z_up: bool = False) -> Path:
    """Every joint swings a little about its own axis, at its own pace, while the figure walks off slowly.

    With `z_up` the file's z axis points up, as some tools export it.
    """
    rng = np.random.default_rng(seed)
    times = np.arange(frames)[:, None, None] / fps
    axes = rng.standard_normal((1, len(SKELETON), 3)) * 0.08
    turns = axes * np.sin(times * rng.uniform(0.5, 3.0, (1, len(SKELETON), 1)))
    rotations = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix().reshape(frames, -1, 3, 3)
    root = np.array([0.0, 0.95, 0.0]) + times[:, 0] * rng.uniform(-0.3, 0.3, 3) * [1, 0, 1]
    if z_up:
        turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
        rotations[:, 0], root = turn @ rotations[:, 0], root @ turn.T
    write_bvh(path, SKELETON, rotations, root, fps)
    return path


def write_source(folder: Path, names: Iterable[str]) -> Path:
    """Clips of 36 frames, some in folders, and `map.json`, which reads them."""
    for seed, name in enumerate(names):
        (folder / name).parent.mkdir(exist_ok=True)
        write_clip(folder / f"{name}.bvh", seed, frames=36)
    write_map(folder / "map.json")
    return folder


def write_map(path: Path) -> Path:
    """The joint map of these files: every joint by its own name."""
    rows = [[number, name, name] for number, name in enumerate(SKELETON.joints)]
    path.write_text(json.dumps({"smpl22": rows, "unmapped": []}))
    return path


BANDAI = (
    "bow_active", "bow_childish", "bow_chimpira", "bow_angry", "bow_feminine", "bow_giant", "dash_normal",
)  # fmt: skip
"""Real clips, the last one of 0.67 s."""


def unpack_bandai(shared: Path, folder: Path) -> dict[str, Path]:
    """Files of the clips `BANDAI` in a folder, by name."""
    found = {}
    with tarfile.open(shared / "data/bandai/dataset-1.tar.xz", "r|*") as archive:
        for member in archive:
            name = Path(member.name).name.removeprefix("dataset-1_").removesuffix("_001.bvh")
            file = archive.extractfile(member) if name in BANDAI else None
            if file is not None:
                found[name] = folder / Path(member.name).name
                found[name].write_bytes(file.read())
    return found
