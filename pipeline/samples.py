"""Clips of a split next to what the models make of them: truth, reconstruction, generation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.datasets.motion.features import decode, face_of
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import FACE, HELD_ALL
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.datasets.shards.statistics import FeatureStats
from motionloom.models.tokenizer.base import Tokenizer


@dataclass(frozen=True)
class Truth:
    """A clip of the data set: features of the body-hand part, joints, expression, captions.

    `face` is None where the clip holds none; `held` are the bits of `ClipMeta.held`.
    """

    id: str
    features: NDArray[np.float32]
    joints: NDArray[np.float64]
    face: NDArray[np.float32] | None
    caption: str
    face_caption: str
    truth: dict | None
    held: int = HELD_ALL


def joint_layout(layout: MotionLayout) -> MotionLayout:
    """The layout of the body-hand columns alone."""
    if not layout.has("face"):
        return layout
    return MotionLayout.named("wholebody313", fps=layout.fps, family=layout.family)


def truth_of(dataset: ClipDataset, index: int, max_frames: int | None = None) -> Truth:
    """One clip, cut to whole groups of four frames."""
    layout = dataset.layout
    motion = np.asarray(dataset.motion(index))
    frames = min(len(motion), max_frames or len(motion)) // 4 * 4
    motion = motion[: max(frames, min(4, len(motion)))]
    body = motion[:, layout.part("bodyhand")]
    texts, faces = dataset.texts(index), dataset.face_texts(index)
    caption = texts[0].text if texts else ""
    held = int(dataset.held[index])
    return Truth(
        id=dataset.ids[index],
        features=body,
        joints=decode(body, joint_layout(layout)),
        face=face_of(motion, layout) if layout.has("face") and held & FACE else None,
        caption=caption,
        face_caption=faces[0].text if faces else caption,
        truth=dataset.meta(index).truth,
        held=held,
    )


@torch.no_grad()
def reconstruct(
    tokenizer: Tokenizer, stats: FeatureStats, features: NDArray[np.float32], held: int = HELD_ALL
) -> NDArray[np.float32]:
    """Through the tokenizer and back, in the features' own units [T, D]; T a multiple of four.

    `held` says what the clip holds; of what it does not hold, nothing is read and the mean comes back.
    """
    columns = tokenizer.columns.numpy()
    mean, std = stats.mean[columns], stats.std[columns]
    motion = torch.from_numpy(((features - mean) / std).astype(np.float32))[None]
    mask = torch.from_numpy(tokenizer.layout.held_columns[held, columns])[None]
    rebuilt = tokenizer.decode(tokenizer.encode(motion, held=mask), held=mask)
    out = rebuilt.masked_fill(~mask[:, None], 0.0)[0].numpy()
    return np.asarray(out * std + mean, dtype=np.float32)


def spread(dataset: ClipDataset, count: int) -> list[int]:
    """Clip numbers spread evenly over a split, at most `count`, different captions first."""
    seen: set[str] = set()
    first: list[int] = []
    rest: list[int] = []
    order = np.random.default_rng(0).permutation(len(dataset))
    for index in order.tolist():
        texts = dataset.texts(index)
        caption = texts[0].text if texts else ""
        (rest if caption in seen else first).append(index)
        seen.add(caption)
    return (first + rest)[:count]
