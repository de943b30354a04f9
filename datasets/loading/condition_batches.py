"""Batches of clips with their conditions (UDE section 3): text, music, both or neither, in one batch.

Item `k` is one rank's whole share of global batch `k`, a pure function of (data, seed, k), as in `batches`.
A row without a modality has an all-false mask in it. Crops cut motion and music alike: row t of the audio is
frame t of the motion. A caption with start and end seconds gives that stretch of its clip, as everywhere.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from motionloom.datasets.base.randomness import uniform
from motionloom.datasets.conditions import MODALITIES, Condition
from motionloom.datasets.loading.audio_statistics import AudioStats
from motionloom.datasets.loading.batches import ENDLESS, MotionBatch
from motionloom.datasets.loading.crops import Crops, places
from motionloom.datasets.loading.modalities import KINDS, Balance, Drop, Kind, KindPlan, kinds_of
from motionloom.datasets.loading.samples import BatchRow, listed
from motionloom.datasets.loading.spans import CaptionSpan, caption_spans
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.schema import UserError
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.datasets.text.cache import TextCache

# The counters of `batches`, so that clips with captions alone give the batches of `CaptionBatches`.
_CAPTION, _CROP, _DROP = 2, 3, 4


class ConditionBatch(MotionBatch):
    """A motion batch with what each clip comes with."""

    index: Tensor
    """Clip numbers in the dataset, int64 [B]."""
    closed: Tensor
    """bool [B]: whether the row ends where its clip, or its caption's stretch, does."""
    valid: Tensor
    """bool [B]; false for the repeats that fill an evaluation batch up to the number of ranks."""
    caption: list[str]
    """Empty where a row has no text."""
    conditions: dict[str, Condition]
    """Modality -> features [B, L, E] and mask [B, L], for the modalities that were asked for. Text: word
    features, pooled [B, E] is the sentence's embedding, unit length, 0 without text. Audio: normalised
    features, L is the motion's T."""


class ConditionedClips:
    """What training and evaluation share: which clips qualify, and making a batch of them."""

    def __init__(
        self,
        dataset: ClipDataset,
        stats: FeatureStats,
        text: TextCache | None,
        audio: AudioStats | None,
        *,
        max_frames: int,
        min_frames: int,
        columns: NDArray[np.int64] | None = None,
    ) -> None:
        if not 1 <= min_frames <= max_frames:
            raise UserError(f"need 1 <= min_frames ({min_frames}) <= max_frames ({max_frames})")
        self.crops = Crops(dataset, stats, columns)
        self.dataset, self.text, self.audio = dataset, text, audio
        self.min_frames, self.max_frames = min_frames, max_frames
        self.clips = self.crops.clips[dataset.frames[self.crops.clips] >= min_frames]
        if not len(self.clips):
            raise UserError(
                f"{dataset.where}: no clip of split '{dataset.split}' has {min_frames} frames and the body "
                f"parts that are asked for; lower min_frames or choose other data"
            )
        none = np.zeros(len(dataset), dtype=np.bool_)
        self.kinds = kinds_of(
            none if text is None else dataset.has(MODALITIES["text"].member),
            none if audio is None else dataset.has(MODALITIES["audio"].member),
        )
        """Kind of every clip of the dataset, places in `KINDS`, [n]."""

    def prefetch(self, clips: NDArray[np.int64]) -> None:
        """Have the dataset bring in what a batch of `clips` reads."""
        members = ["motion.npy"]
        members += [MODALITIES["text"].member] if self.text is not None else []
        members += [MODALITIES["audio"].member] if self.audio is not None else []
        self.dataset.prefetch(clips.tolist(), members)

    def spans(
        self, clips: NDArray[np.int64], kinds: NDArray[np.int64], draws: NDArray[np.float64]
    ) -> list[CaptionSpan]:
        """One caption, chosen by draws [B] in [0, 1), for every row with text; else the whole clip."""
        out = []
        for clip, kind, draw in zip(clips.tolist(), kinds.tolist(), draws.tolist(), strict=True):
            frames = int(self.dataset.frames[clip])
            choices = [CaptionSpan("", 0, frames)]
            if KINDS[kind] in ("text", "both"):
                found = self.dataset.texts(clip)
                choices = caption_spans(found, self.dataset.layout.fps, frames, self.min_frames)
            out.append(choices[int(draw * len(choices))])
        return out

    def make(
        self,
        clips: NDArray[np.int64],
        kinds: NDArray[np.int64],
        spans: list[CaptionSpan],
        crop: NDArray[np.float64],
    ) -> ConditionBatch:
        """The batch of `clips` [B] of `kinds` [B]; `crop` in [0, 1) places the window of too long a span."""
        cut = self.crops.cut(clips, spans, crop, self.max_frames)
        captions = [span.text for span in spans]
        conditions: dict[str, Condition] = {}
        if self.text is not None:
            read = np.isin(kinds, [KINDS.index("text"), KINDS.index("both")])
            conditions["text"] = self._text(self.text, captions, read)
        if self.audio is not None:
            heard = np.isin(kinds, [KINDS.index("audio"), KINDS.index("both")])
            conditions["audio"] = self._audio(
                self.audio, clips, heard, cut.begin, cut.length, cut.motion.shape[1]
            )
        return {
            "motion": torch.from_numpy(cut.motion),
            "length": torch.from_numpy(cut.length),
            "present": torch.from_numpy(cut.present),
            "index": torch.from_numpy(clips.copy()),
            "closed": torch.from_numpy(cut.closed),
            "valid": torch.ones(len(clips), dtype=torch.bool),
            "caption": captions,
            "conditions": conditions,
        }

    @staticmethod
    def _text(cache: TextCache, captions: list[str], read: NDArray[np.bool_]) -> Condition:
        rows = np.flatnonzero(read)
        chosen = [captions[row] for row in rows.tolist()]
        tokens, known = cache.tokens(chosen)
        # A batch without any text keeps one position, so that attention has something to mask.
        places = max(1, tokens.shape[1])
        features = np.zeros((len(captions), places, cache.dim), dtype=np.float32)
        mask = np.zeros((len(captions), places), dtype=np.bool_)
        pooled = np.zeros((len(captions), cache.dim), dtype=np.float32)
        if len(rows):
            features[rows], mask[rows], pooled[rows] = tokens, known, cache.sentence(chosen)
        return Condition(torch.from_numpy(features), torch.from_numpy(mask), torch.from_numpy(pooled))

    def _audio(
        self,
        stats: AudioStats,
        clips: NDArray[np.int64],
        heard: NDArray[np.bool_],
        begin: NDArray[np.int64],
        length: NDArray[np.int64],
        places: int,
    ) -> Condition:
        features = np.zeros((len(clips), places, stats.dim), dtype=np.float32)
        mask = (np.arange(places)[None] < length[:, None]) & heard[:, None]
        for row in np.flatnonzero(heard).tolist():
            clip = int(clips[row])
            rows = self.dataset.audio(clip)
            frames = int(self.dataset.frames[clip])
            if rows is None or rows.shape != (frames, stats.dim):
                shape = "none" if rows is None else str(list(rows.shape))
                raise UserError(
                    f"{self.dataset.where}: clip {self.dataset.ids[clip]} has audio features {shape} for "
                    f"{frames} frames of motion, expected [{frames}, {stats.dim}]; convert it with one row a "
                    f"motion frame (audio_fps equal to fps)"
                )
            first, count = int(begin[row]), int(length[row])
            features[row, :count] = stats.normalize(rows[first : first + count])
        return Condition(torch.from_numpy(features), torch.from_numpy(mask))


class ConditionBatches(Dataset[ConditionBatch]):
    """Windows of at most `max_frames` of clips with their conditions, for training.

    `text` and `audio` are what reads the modalities; None leaves one out of every row. `balance` decides how
    often each kind of clip comes, `homogeneous` has every batch hold one kind, `drop` makes clips with both
    come with one now and then. Caption, window and drop are drawn by (seed, turn, clip).
    """

    def __init__(
        self,
        dataset: ClipDataset,
        stats: FeatureStats,
        text: TextCache | None,
        audio: AudioStats | None,
        *,
        batch_size: int,
        max_frames: int,
        min_frames: int = 1,
        balance: Balance | None = None,
        drop: Drop | None = None,
        homogeneous: bool = False,
        seed: int = 0,
        rank: int = 0,
        world: int = 1,
        columns: NDArray[np.int64] | None = None,
    ) -> None:
        self.source = ConditionedClips(
            dataset, stats, text, audio, max_frames=max_frames, min_frames=min_frames, columns=columns
        )
        self.seed, self.rank, self.world = seed, rank, world
        self.drop = drop or Drop()
        clips = self.source.clips
        kinds = self.source.kinds[clips]
        self.plan = KindPlan(dataset, clips, kinds, batch_size, seed, balance, homogeneous)
        self.plan.local(0, rank, world)  # an indivisible batch is refused now, not in a loader worker

    def __len__(self) -> int:
        return ENDLESS

    def __getitem__(self, k: int) -> ConditionBatch:
        turns, clips = self.plan.local(k, self.rank, self.world)
        source = self.source
        source.prefetch(clips)
        kinds, spans = self._spans(turns, clips)
        return source.make(clips, kinds, spans, uniform(self.seed, _CROP, turns, clips))

    def samples(self, k: int) -> list[BatchRow]:
        """Which stretches batch `k` holds."""
        turns, clips = self.plan.local(k, self.rank, self.world)
        _, spans = self._spans(turns, clips)
        begin, length, _ = places(spans, uniform(self.seed, _CROP, turns, clips), self.source.max_frames)
        return listed(self.source.dataset.ids, clips, begin, length)

    def _spans(
        self, turns: NDArray[np.int64], clips: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], list[CaptionSpan]]:
        """Kind and stretch of each clip."""
        source = self.source
        kinds = self.drop.kinds(source.kinds[clips], uniform(self.seed, _DROP, turns, clips))
        return kinds, source.spans(clips, kinds, uniform(self.seed, _CAPTION, turns, clips))


class EvalConditionBatches(Dataset[ConditionBatch]):
    """Every qualifying clip of a split once, in order: first caption, first `max_frames` frames.

    `kinds` None takes all; otherwise only clips of these kinds. Each rank gets the same number of rows; where
    the clips do not divide, the last batch repeats its last clip with `valid` false.
    """

    def __init__(
        self,
        dataset: ClipDataset,
        stats: FeatureStats,
        text: TextCache | None,
        audio: AudioStats | None,
        *,
        batch_size: int,
        max_frames: int,
        min_frames: int = 1,
        kinds: Collection[Kind] | None = None,
        rank: int = 0,
        world: int = 1,
        columns: NDArray[np.int64] | None = None,
    ) -> None:
        if batch_size < 1 or batch_size % world:
            raise UserError(f"an evaluation batch of {batch_size} clips does not divide over {world} ranks")
        self.source = ConditionedClips(
            dataset, stats, text, audio, max_frames=max_frames, min_frames=min_frames, columns=columns
        )
        self.clips = self.source.clips
        if kinds is not None:
            wanted = [KINDS.index(kind) for kind in kinds]
            self.clips = self.clips[np.isin(self.source.kinds[self.clips], wanted)]
            if not len(self.clips):
                raise UserError(
                    f"{dataset.where}: no usable clip of split '{dataset.split}' is of kind "
                    f"{' or '.join(kinds)} (text alone, audio alone, both, none)"
                )
        self.batch_size, self.rank, self.world = batch_size, rank, world

    def __len__(self) -> int:
        return -(-len(self.clips) // self.batch_size)

    def __getitem__(self, k: int) -> ConditionBatch:
        if not 0 <= k < len(self):
            raise IndexError(f"evaluation batch {k} of {len(self)}")
        rows = np.arange(k * self.batch_size, min((k + 1) * self.batch_size, len(self.clips)))
        missing = -len(rows) % self.world
        valid = np.concatenate([np.ones(len(rows), bool), np.zeros(missing, bool)])[self.rank :: self.world]
        rows = np.concatenate([rows, np.repeat(rows[-1:], missing)])[self.rank :: self.world]
        clips, source = self.clips[rows], self.source
        source.prefetch(clips)
        kinds, first = source.kinds[clips], np.zeros(len(clips))
        batch = source.make(clips, kinds, source.spans(clips, kinds, first), first)
        batch["valid"] = torch.from_numpy(valid)
        return batch
