"""Trivial answers: motions that need no model, to stand beside a model's."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.joints import local_joints_of
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.pipeline.evaluation.dances import DanceClip

Joints = NDArray[np.float64]


def mean_poses(pool: Sequence[Joints], fps: float, lengths: Iterable[int]) -> list[Joints]:
    """The mean pose of training motions [T, N, 3], standing still for so many frames each."""
    poses, heights = [], []
    for joints in pool:
        poses.append(local_joints_of(joints, fps).mean(0))
        heights.append(joints[:, 0, 1].mean())
    pose = np.mean(poses, axis=0)
    pose[:, 1] += np.mean(heights)
    return [np.tile(pose, (frames, 1, 1)) for frames in lengths]


def random_dances(
    pool: Sequence[DanceClip], clips: Sequence[DanceClip], rng: np.random.Generator
) -> list[Joints]:
    """For each clip a stretch of a training dance drawn at random, as long as the clip where one is."""
    out = []
    for clip in clips:
        frames = len(clip.joints)
        long = [other for other in pool if len(other.joints) >= frames] or list(pool)
        joints = long[int(rng.integers(len(long)))].joints
        start = int(rng.integers(max(0, len(joints) - frames) + 1))
        out.append(joints[start : start + frames])
    return out


def nearest_dances(
    train: ClipDataset, pool: Sequence[DanceClip], dataset: ClipDataset, clips: Sequence[DanceClip]
) -> list[Joints] | None:
    """For each clip the training dance to the most similar music, cut to its length.

    Similar: the mean over time of the stored audio features, each in units of its deviation among the
    training dances **[ours]**. Of equally long dances only where there are some. None where the data store
    no audio features.
    """
    known, wanted = _music_means(train, pool), _music_means(dataset, clips)
    if known is None or wanted is None:
        return None
    spread = known.std(0)
    spread = np.where(spread > 1e-8, spread, np.inf)
    lengths = np.array([len(other.joints) for other in pool])
    out = []
    for clip, music in zip(clips, wanted, strict=True):
        away = (((known - music) / spread) ** 2).sum(1)
        if (lengths >= len(clip.joints)).any():
            away[lengths < len(clip.joints)] = np.inf
        out.append(pool[int(away.argmin())].joints[: len(clip.joints)])
    return out


def _music_means(dataset: ClipDataset, clips: Sequence[DanceClip]) -> NDArray[np.float64] | None:
    """Mean audio features [n, 438] of clips; None where one has none."""
    rows = []
    for clip in clips:
        features = dataset.audio(clip.index)
        if features is None or not len(features):
            return None
        rows.append(features.mean(0, dtype=np.float64))
    return np.stack(rows)
