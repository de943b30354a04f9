"""Clips of a split next to what the models make of them: truth, reconstruction, generation."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import FACE, PRESENT_ALL
from motionloom.datasets.loading.crops import CaptionSpan, caption_spans
from motionloom.datasets.motion.features.codec import face_of
from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.pipeline.contract.generation import MotionGenerator
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.store.networks import TrainedTokenizer

if TYPE_CHECKING:
    from motionloom.pipeline.inference.bundle import Bundle
    from motionloom.pipeline.inference.motion import GeneratedMotion


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
    tokens: tuple[str, ...] = ()
    """`word/POS` tags of the caption, where the source brings them."""

    def columns(self, layout: MotionLayout, rest: NDArray[np.float32] | float = 0.0) -> NDArray[np.float32]:
        """All columns [T, D] of the layout; of what the clip does not hold, `rest`."""
        out = np.empty((len(self.features), layout.dim), dtype=np.float32)
        out[:] = rest
        out[:, layout.part("bodyhand")] = self.features
        if self.face is not None:
            out[:, layout.slice("face")] = self.face
        return out


def recorded_seconds(truths: Sequence[Truth], generator: MotionGenerator) -> list[float]:
    """Return the recorded length of each clip, as far as the generator reaches."""
    frames = [len(truth.features) for truth in truths]
    if generator.max_frames is not None:
        frames = [min(count, generator.max_frames) for count in frames]
    return [count / generator.layout.fps for count in frames]


def perform(
    bundle: Bundle,
    truths: Sequence[Truth],
    *,
    seconds: float | None = None,
    seed: int = 0,
    sampling: SamplingConfig | None = None,
) -> list[GeneratedMotion]:
    """Motions for clips' captions, as long as the clips unless `seconds` or the model decides."""
    from motionloom.pipeline.inference.generation import generate
    from motionloom.pipeline.inference.request import Request

    maker = bundle.generator
    request = Request.of(
        [truth.caption for truth in truths],
        face=[truth.face_caption for truth in truths],
        seconds=recorded_seconds(truths, maker) if seconds is None and not maker.decides_length else seconds,
        seed=seed,
        sampling=sampling,
    )
    return generate(bundle, request)


def truth_of(
    dataset: ClipDataset, index: int, max_frames: int | None = None, *, min_frames: int = 16
) -> Truth:
    """One clip with its caption, cut to whole groups of four frames.

    A caption about the whole clip comes first. Without one, the clip is cut to what its first caption of
    `min_frames` or more is about.
    """
    span = _main_caption(dataset, index, int(dataset.frames[index]), min_frames)
    return truth_in(dataset, index, span, max_frames)


def truth_in(dataset: ClipDataset, index: int, span: CaptionSpan, max_frames: int | None = None) -> Truth:
    """Return the stretch of a clip that one caption is about, cut to whole groups of four frames."""
    motion = np.asarray(dataset.motion(index))
    whole = span.frames == len(motion)
    motion = motion[span.first : span.end]
    frames = min(len(motion), max_frames or len(motion)) // 4 * 4
    motion = motion[: max(frames, min(4, len(motion)))]
    return _truth(dataset, index, motion, span, dataset.meta(index).truth if whole else None)


def truth_at(dataset: ClipDataset, index: int, frames: int) -> Truth:
    """The first `frames` of a clip, whatever its captions are about."""
    motion = np.asarray(dataset.motion(index))
    span = _main_caption(dataset, index, len(motion))
    return _truth(dataset, index, motion[:frames], span, dataset.meta(index).truth)


def _truth(
    dataset: ClipDataset, index: int, motion: NDArray[np.float32], span: CaptionSpan, truth: dict | None
) -> Truth:
    layout = dataset.layout
    faces = caption_spans(dataset.face_texts(index), layout.fps, int(dataset.frames[index]))
    # Of several captions of the face, the one that shares most frames with the caption.
    faces = sorted(faces, key=lambda face: max(face.first, span.first) - min(face.end, span.end))
    body = motion[:, layout.part("bodyhand")]
    present = int(dataset.present[index])
    return Truth(
        id=dataset.ids[index],
        features=body,
        joints=joints_of(body, layout),
        face=face_of(motion, layout) if layout.has("face") and present & FACE else None,
        caption=span.text,
        face_caption=faces[0].text if faces else span.text,
        truth=truth,
        present=present,
        tokens=span.tokens,
    )


def _main_caption(dataset: ClipDataset, index: int, frames: int, min_frames: int = 16) -> CaptionSpan:
    """The caption that stands for a clip, and what it is about; no words where there is none."""
    spans = caption_spans(dataset.texts(index), dataset.layout.fps, frames, min_frames)
    whole = [span for span in spans if span.frames == frames]
    return (whole or spans or [CaptionSpan("", 0, frames)])[0]


def digest_of(truths: Sequence[Truth]) -> str:
    """Return the sha256 of captions and motions, which does not depend on the name of their data set."""
    found = hashlib.sha256()
    for truth in truths:
        found.update(f"{truth.caption}\n{truth.face_caption}\n{truth.features.shape}".encode())
        found.update(np.ascontiguousarray(truth.features, "<f4").tobytes())
    return found.hexdigest()


def reconstruct_truth(tokenizer: TrainedTokenizer, truth: Truth) -> NDArray[np.float32]:
    """A clip's features [T, D] through a body tokenizer; columns it does not model become the mean."""
    return reconstruct_all(tokenizer, truth)[:, tokenizer.layout.part("bodyhand")]


def reconstruct_all(tokenizer: TrainedTokenizer, truth: Truth) -> NDArray[np.float32]:
    """All columns [T, D] of the layout, likewise."""
    mean = tokenizer.stats.mean.astype(np.float32)
    columns = tokenizer.columns
    out = np.tile(mean, (len(truth.features), 1))
    given = truth.columns(tokenizer.layout, mean)
    out[:, columns] = tokenizer.reconstruct(given[:, columns], truth.present)
    return out


def has_caption(dataset: ClipDataset) -> NDArray[np.bool_]:
    """Clips with a caption, [n]."""
    return dataset.has("texts.json")


def spread_any(dataset: ClipDataset, count: int | None) -> list[int]:
    """Numbers of clips spread evenly over a split, at most `count`, captioned or not."""
    order: list[int] = np.random.default_rng(0).permutation(len(dataset)).tolist()
    return order[:count]


def drawn(dataset: ClipDataset, count: int | None) -> list[int]:
    """Numbers of captioned clips drawn at random from a split, at most `count`, as the papers' evaluations
    draw them: two may have the same caption. `UserError` where there is none.
    """
    usable = has_caption(dataset)
    if not usable.any():
        raise UserError(f"{dataset.where}: no clip of split '{dataset.split}' has a caption")
    order = np.random.default_rng(0).permutation(len(dataset))
    out: list[int] = order[usable[order]].tolist()
    return out[:count]


def spread(dataset: ClipDataset, count: int | None) -> list[int]:
    """Numbers of captioned clips spread evenly over a split, at most `count`, different captions first."""
    chosen = drawn(dataset, None)
    captions = [_main_caption(dataset, index, int(dataset.frames[index])).text for index in chosen]
    return different_first(chosen, captions)[:count]


def spread_truths(dataset: ClipDataset, count: int) -> list[Truth]:
    """The clips of `spread` with their captions; none where no clip has one."""
    chosen = spread(dataset, count) if count and has_caption(dataset).any() else []
    return [truth_of(dataset, clip) for clip in chosen]


def different_first(clips: Sequence[int], names: Sequence[str]) -> list[int]:
    """The clips whose name none before them has, and then the others."""
    first = set({name: place for place, name in reversed(list(enumerate(names)))}.values())
    return [clips[k] for k in sorted(range(len(clips)), key=lambda k: k not in first)]
