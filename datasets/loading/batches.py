"""Batches for training: map-style datasets whose item `k` is one rank's whole share of global step `k`.

Use with `DataLoader(batches, batch_size=None, sampler=range(first_step, last_step))`: a run resumes by
starting the range elsewhere. What a batch holds depends on the data, its order and
(seed, k) alone; the ranks' shares one after the
other are the global batch whatever their number. `batch_size` is always the *global* one.
"""

from __future__ import annotations

from typing import TypedDict

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from motionloom.datasets.base.randomness import uniform
from motionloom.datasets.conditions import Condition, Conditions
from motionloom.datasets.loading.crops import Crops, places
from motionloom.datasets.loading.plan import BatchPlan
from motionloom.datasets.loading.samples import BatchRow, listed
from motionloom.datasets.loading.spans import CaptionSpan, caption_spans
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.schema import UserError
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.datasets.text.cache import TextCache
from motionloom.datasets.text.reword import Rewordings

ENDLESS = 2**62
"""`len` of training batches: they go on for as many epochs as the sampler asks for."""

# Counters that keep the draws for different purposes apart (arguments of `uniform`).
_WINDOW, _CAPTION, _CROP, _REWORD = 1, 2, 3, 4


class MotionBatch(TypedDict):
    """`motion` float32 [B, T, C], normalised, zero behind `length` int64 [B] and where `present` is false."""

    motion: Tensor
    length: Tensor
    present: Tensor
    """bool [B, C]: columns of parts (hands, face) that the clip holds. The others must not be learnt from."""


class CaptionBatch(MotionBatch):
    """A motion batch with one caption per clip."""

    index: Tensor
    """Clip numbers in the dataset, int64 [B]."""
    valid: Tensor
    """bool [B]; false for the repeats that fill an evaluation batch up to the number of ranks."""
    caption: list[str]
    conditions: Conditions
    """"text": word features, and sentence embeddings of unit length as its pooled vectors."""
    similarity: Tensor
    """float32 [B, S], unit length: embeddings that say which captions mean the same."""


class WindowBatches(Dataset[MotionBatch]):
    """Fixed windows for the tokenizers (HumanTOMATO appendix C, T2M-GPT's 64 frames).

    `windows_per_clip` windows are cut from each clip read. A clip shorter than `window` is taken whole and
    padded. A clip that holds none of the columns is never drawn; a column that no clip holds is refused.
    """

    def __init__(
        self,
        dataset: ClipDataset,
        stats: FeatureStats,
        *,
        window: int,
        batch_size: int,
        windows_per_clip: int = 1,
        seed: int = 0,
        rank: int = 0,
        world: int = 1,
        columns: NDArray[np.int64] | None = None,
    ) -> None:
        if windows_per_clip < 1 or batch_size % windows_per_clip:
            raise UserError(f"batch_size {batch_size} is no multiple of windows_per_clip {windows_per_clip}")
        if window < 1:
            raise UserError(f"a window needs at least one frame, not {window}")
        self.crops = Crops(dataset, stats, columns)
        self.dataset = dataset
        self.window = window
        self.windows_per_clip = windows_per_clip
        self.seed, self.rank, self.world = seed, rank, world
        self.clips = self.crops.clips
        if len(self.clips) == 0 or not self.crops.present[np.unique(dataset.present)].any(axis=0).all():
            raise UserError(
                f"{dataset.where}: no clip of split '{dataset.split}' holds hands or a face that the chosen "
                f"part has columns for; choose another `part` or another data set"
            )
        sources = dataset.sources(self.clips)
        self.plan = BatchPlan(len(self.clips), batch_size // windows_per_clip, seed, sources=sources)
        self.plan.local(0, rank, world)  # an indivisible batch is refused now, not in a loader worker

    def __len__(self) -> int:
        return ENDLESS

    def samples(self, k: int) -> list[BatchRow]:
        """Which windows batch `k` holds."""
        clips, starts, length = self._windows(k)
        each = self.windows_per_clip
        return listed(self.dataset.ids, np.repeat(clips, each), starts.ravel(), np.repeat(length, each))

    def _windows(self, k: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Clips [n], first frames [n, windows_per_clip] and lengths [n] of batch `k`."""
        turns, items = self.plan.local(k, self.rank, self.world)
        clips = self.clips[items]
        frames = self.dataset.frames[clips]
        numbers = np.arange(self.windows_per_clip)[None]
        draws = uniform(self.seed, _WINDOW, turns[:, None], clips[:, None], numbers)
        starts = (draws * (np.maximum(frames - self.window, 0) + 1)[:, None]).astype(np.int64)
        return clips, starts, np.minimum(frames, self.window)

    def __getitem__(self, k: int) -> MotionBatch:
        clips, starts, length = self._windows(k)
        per_clip = self.windows_per_clip
        motion = np.empty((len(clips) * per_clip, self.window, self.crops.width), dtype=np.float32)
        present = self.dataset.present[clips]
        self.dataset.prefetch(clips.tolist(), ("motion.npy",))
        for row, clip in enumerate(clips.tolist()):
            source = self.dataset.motion(clip)
            for j in range(per_clip):
                place = motion[row * per_clip + j]
                self.crops.fill(place, source, int(starts[row, j]), int(length[row]), int(present[row]))
        return {
            "motion": torch.from_numpy(motion),
            "length": torch.from_numpy(np.repeat(length, per_clip)),
            "present": torch.from_numpy(self.crops.present[np.repeat(present, per_clip)]),
        }


class _CaptionedClips:
    """What training and evaluation share: which clips qualify, and making a batch of them."""

    def __init__(
        self,
        dataset: ClipDataset,
        stats: FeatureStats,
        text: TextCache | None,
        *,
        max_frames: int,
        min_frames: int,
        face: bool,
        columns: NDArray[np.int64] | None,
    ) -> None:
        if not 1 <= min_frames <= max_frames:
            raise UserError(f"need 1 <= min_frames ({min_frames}) <= max_frames ({max_frames})")
        if face and columns is None:
            columns = dataset.layout.part("face")
        self.crops = Crops(dataset, stats, columns)
        self.dataset, self.text, self.face = dataset, text, face
        self.min_frames, self.max_frames = min_frames, max_frames
        usable = dataset.frames >= min_frames
        if text is not None:
            usable &= dataset.has("face_texts.json" if face else "texts.json")
        self.clips = self.crops.clips[usable[self.crops.clips]]
        if len(self.clips) == 0:
            kind = "face captions" if face else "captions"
            holding = (
                "" if len(self.crops.clips) == len(dataset) else ", the hands or face that are asked for"
            )
            raise UserError(
                f"{dataset.where}: no clip of split '{dataset.split}' has {kind}{holding} and {min_frames} "
                f"frames; lower min_frames or convert data with {kind}"
            )

    def prefetch(self, clips: NDArray[np.int64]) -> None:
        """Have the dataset bring in what `captions` and `make` will read of `clips`."""
        texts = ["face_texts.json" if self.face else "texts.json"] if self.text is not None else []
        self.dataset.prefetch(clips.tolist(), ["motion.npy", *texts])

    def captions(self, clip: int) -> list[CaptionSpan]:
        """The captions of a clip that cover `min_frames` or more, else the one that covers most."""
        found = self.dataset.face_texts(clip) if self.face else self.dataset.texts(clip)
        frames = int(self.dataset.frames[clip])
        return caption_spans(found, self.dataset.layout.fps, frames, self.min_frames)

    def make(
        self,
        clips: NDArray[np.int64],
        spans: list[CaptionSpan],
        crop: NDArray[np.float64],
        reworded: tuple[Rewordings, NDArray[np.float64]] | None = None,
    ) -> CaptionBatch:
        """The batch of `clips` [B] and their spans; `crop` in [0, 1) places the crop of too long a span.

        `reworded` may put other words in a caption's place, by draws in [0, 1) [B]; `caption` and
        `similarity` stay the caption's.
        """
        cut = self.crops.cut(clips, spans, crop, self.max_frames)
        captions = [span.text for span in spans]
        batch = {
            "motion": torch.from_numpy(cut.motion),
            "length": torch.from_numpy(cut.length),
            "present": torch.from_numpy(cut.present),
            "index": torch.from_numpy(clips.copy()),
            "valid": torch.ones(len(clips), dtype=torch.bool),
            "caption": captions,
            "conditions": {},
        }
        if self.text is not None:
            if reworded is None:
                words = (*self.text.tokens(captions), self.text.sentence(captions))
            else:
                words = reworded[0].read(captions, reworded[1], self.text)
            batch["conditions"] = {"text": Condition(*map(torch.from_numpy, words))}
            batch["similarity"] = torch.from_numpy(self.text.similarity(captions))
        return batch  # type: ignore[return-value]


class CaptionBatches(Dataset[CaptionBatch]):
    """Whole clips with one caption each, for TMA and the GPTs.

    Caption and crop are drawn by (seed, epoch, clip). A caption with start and end seconds gives that stretch
    of the clip; a stretch longer than `max_frames` is cropped at random. `face` takes face captions and,
    unless `columns` says otherwise, the face columns. `rewordings` stand in for captions now and then, drawn
    likewise.
    """

    def __init__(
        self,
        dataset: ClipDataset,
        stats: FeatureStats,
        text: TextCache,
        *,
        batch_size: int,
        max_frames: int,
        min_frames: int,
        seed: int = 0,
        rank: int = 0,
        world: int = 1,
        face: bool = False,
        columns: NDArray[np.int64] | None = None,
        rewordings: Rewordings | None = None,
    ) -> None:
        self.source = _CaptionedClips(
            dataset, stats, text, max_frames=max_frames, min_frames=min_frames, face=face, columns=columns
        )
        if rewordings is not None and rewordings.cache.encoder != text.encoder:
            raise UserError(
                f"{rewordings.folder}: rewordings by the encoder {rewordings.cache.encoder}, captions by "
                f"{text.encoder}; give both stages the same text stage"
            )
        self.rewordings = rewordings
        self.seed, self.rank, self.world = seed, rank, world
        clips = self.source.clips
        self.plan = BatchPlan(len(clips), batch_size, seed, sources=dataset.sources(clips))
        self.plan.local(0, rank, world)  # an indivisible batch is refused now, not in a loader worker

    def __len__(self) -> int:
        return ENDLESS

    def __getitem__(self, k: int) -> CaptionBatch:
        turns, items = self.plan.local(k, self.rank, self.world)
        clips = self.source.clips[items]
        self.source.prefetch(clips)
        spans = self._spans(turns, clips)
        reworded = None
        if self.rewordings is not None:
            reworded = self.rewordings, uniform(self.seed, _REWORD, turns, clips)
        return self.source.make(clips, spans, uniform(self.seed, _CROP, turns, clips), reworded)

    def samples(self, k: int) -> list[BatchRow]:
        """Which stretches batch `k` holds."""
        turns, items = self.plan.local(k, self.rank, self.world)
        clips = self.source.clips[items]
        crop = uniform(self.seed, _CROP, turns, clips)
        begin, length, _ = places(self._spans(turns, clips), crop, self.source.max_frames)
        return listed(self.source.dataset.ids, clips, begin, length)

    def _spans(self, turns: NDArray[np.int64], clips: NDArray[np.int64]) -> list[CaptionSpan]:
        """One caption of each clip."""
        spans = []
        for clip, draw in zip(clips.tolist(), uniform(self.seed, _CAPTION, turns, clips), strict=True):
            choices = self.source.captions(clip)
            spans.append(choices[int(draw * len(choices))])
        return spans


class EvalBatches(Dataset[CaptionBatch]):
    """Every qualifying clip of a split once, in order: first caption, first `max_frames` frames.

    `text` None leaves captions out (`caption` is then empty strings, no text tensors, every long enough clip
    that holds any of the columns qualifies). Each rank gets the same number of rows; where the clips do not
    divide, the last batch repeats its last clip with `valid` false.
    """

    def __init__(
        self,
        dataset: ClipDataset,
        stats: FeatureStats,
        text: TextCache | None = None,
        *,
        batch_size: int,
        max_frames: int,
        min_frames: int = 1,
        rank: int = 0,
        world: int = 1,
        face: bool = False,
        columns: NDArray[np.int64] | None = None,
    ) -> None:
        if batch_size < 1 or batch_size % world:
            raise UserError(f"an evaluation batch of {batch_size} clips does not divide over {world} ranks")
        self.source = _CaptionedClips(
            dataset, stats, text, max_frames=max_frames, min_frames=min_frames, face=face, columns=columns
        )
        self.batch_size, self.rank, self.world = batch_size, rank, world

    def __len__(self) -> int:
        return -(-len(self.source.clips) // self.batch_size)

    def __getitem__(self, k: int) -> CaptionBatch:
        if not 0 <= k < len(self):
            raise IndexError(f"evaluation batch {k} of {len(self)}")
        source = self.source
        rows = np.arange(k * self.batch_size, min((k + 1) * self.batch_size, len(source.clips)))
        missing = -len(rows) % self.world
        valid = np.concatenate([np.ones(len(rows), bool), np.zeros(missing, bool)])[self.rank :: self.world]
        rows = np.concatenate([rows, np.repeat(rows[-1:], missing)])[self.rank :: self.world]
        clips = source.clips[rows]
        source.prefetch(clips)
        if source.text is None:
            spans = [CaptionSpan("", 0, int(frames)) for frames in source.dataset.frames[clips]]
        else:
            spans = [source.captions(clip)[0] for clip in clips.tolist()]
        batch = source.make(clips, spans, np.zeros(len(clips)))
        batch["valid"] = torch.from_numpy(valid)
        return batch
