"""Clips of a split next to what the models make of them: truth, reconstruction, generation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.datasets.loading.spans import CaptionSpan, caption_spans
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.motion.features import decode, face_of
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import FACE, PRESENT_ALL, UserError
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.models.tokenizer.base import Tokenizer
from motionloom.pipeline.store.networks import device_of


@dataclass(frozen=True)
class Truth:
    """A clip of the data set, or the stretch its caption is about: features of the body-hand part, joints,
    expression, captions.

    `face` is None where the clip holds none; `present` are the bits of `ClipMeta.present`.
    """

    id: str
    features: NDArray[np.float32]
    joints: NDArray[np.float64]
    face: NDArray[np.float32] | None
    caption: str
    face_caption: str
    truth: dict | None
    present: int = PRESENT_ALL


def joint_layout(layout: MotionLayout) -> MotionLayout:
    """The layout of the body-hand columns alone."""
    if not layout.has("face"):
        return layout
    return MotionLayout.named("wholebody313", fps=layout.fps, family=layout.family)


def truth_of(
    dataset: ClipDataset, index: int, max_frames: int | None = None, *, min_frames: int = 16
) -> Truth:
    """One clip with its caption, cut to whole groups of four frames.

    A caption about the whole clip comes first. Without one, the clip is cut to what its first caption of
    `min_frames` or more is about.
    """
    layout = dataset.layout
    motion = np.asarray(dataset.motion(index))
    span = _main_caption(dataset, index, len(motion), min_frames)
    whole, motion = span.frames == len(motion), motion[span.first : span.end]
    faces = caption_spans(dataset.face_texts(index), layout.fps, int(dataset.frames[index]))
    frames = min(len(motion), max_frames or len(motion)) // 4 * 4
    motion = motion[: max(frames, min(4, len(motion)))]
    body = motion[:, layout.part("bodyhand")]
    present = int(dataset.present[index])
    return Truth(
        id=dataset.ids[index],
        features=body,
        joints=decode(body, joint_layout(layout)),
        face=face_of(motion, layout) if layout.has("face") and present & FACE else None,
        caption=span.text,
        face_caption=max(faces, key=lambda face: _overlap(face, span)).text if faces else span.text,
        truth=dataset.meta(index).truth if whole else None,
        present=present,
    )


def _main_caption(dataset: ClipDataset, index: int, frames: int, min_frames: int = 16) -> CaptionSpan:
    """The caption that stands for a clip, and what it is about; no words where there is none."""
    spans = caption_spans(dataset.texts(index), dataset.layout.fps, frames, min_frames)
    whole = [span for span in spans if span.frames == frames]
    return (whole or spans or [CaptionSpan("", 0, frames)])[0]


def _overlap(one: CaptionSpan, other: CaptionSpan) -> int:
    """Frames that both are about."""
    return min(one.end, other.end) - max(one.first, other.first)


@torch.no_grad()
def reconstruct(
    tokenizer: Tokenizer, stats: FeatureStats, features: NDArray[np.float32], present: int = PRESENT_ALL
) -> NDArray[np.float32]:
    """Through the tokenizer and back, in the features' own units [T, D]; T a multiple of four.

    `present` says what the clip holds; of what it does not hold, nothing is read and the mean comes back.
    """
    columns, device = tokenizer.columns.cpu().numpy(), device_of(tokenizer)
    mean, std = stats.mean[columns], stats.std[columns]
    motion = torch.from_numpy(((features - mean) / std).astype(np.float32))[None].to(device)
    mask = torch.from_numpy(tokenizer.layout.present_columns[present, columns])[None].to(device)
    rebuilt = tokenizer.decode(tokenizer.encode(motion, present=mask), present=mask)
    out = rebuilt.masked_fill(~mask[:, None], 0.0)[0].cpu().numpy()
    return np.asarray(out * std + mean, dtype=np.float32)


def reconstruct_truth(tokenizer: Tokenizer, stats: FeatureStats, truth: Truth) -> NDArray[np.float32]:
    """A clip's body-hand features [T, D] through a tokenizer of any part of the body, face included or not.

    Of columns that it does not model, the mean comes back.
    """
    layout = tokenizer.layout
    out = np.tile(stats.mean.astype(np.float32), (len(truth.features), 1))
    given = out.copy()
    given[:, layout.part("bodyhand")] = truth.features
    if truth.face is not None:
        given[:, layout.slice("face")] = truth.face
    columns = tokenizer.columns.cpu().numpy()
    out[:, columns] = reconstruct(tokenizer, stats, given[:, columns], truth.present)
    return out[:, layout.part("bodyhand")]


def captioned(dataset: ClipDataset) -> NDArray[np.bool_]:
    """Clips with a caption, [n]; a `UserError` when there is none."""
    found = dataset.has("texts.json")
    if not found.any():
        raise UserError(f"{dataset.where}: no clip of split '{dataset.split}' has a caption")
    return found


def spread(dataset: ClipDataset, count: int) -> list[int]:
    """Numbers of captioned clips spread evenly over a split, at most `count`, different captions first."""
    seen: set[str] = set()
    first: list[int] = []
    rest: list[int] = []
    usable = captioned(dataset)
    order = np.random.default_rng(0).permutation(len(dataset))
    for index in order[usable[order]].tolist():
        caption = _main_caption(dataset, index, int(dataset.frames[index])).text
        (rest if caption in seen else first).append(index)
        seen.add(caption)
    return (first + rest)[:count]
