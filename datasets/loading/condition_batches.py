"""Batches of clips with their conditions: captions for TMA and the GPTs, or any set of modalities a row,
mixed in one batch (UDE section 3).

Item `k` is one rank's whole share of global batch `k`, a pure function of (data, seed, k), as in `batches`.
A row without a modality has an all-false mask in it. Crops cut motion and timed modalities alike: row t
of music is frame t of the motion. A caption with start and end seconds gives that stretch of its clip, as
everywhere.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NotRequired, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.randomness import uniform
from motionloom.datasets.conditions import Condition
from motionloom.datasets.loading.batches import MotionBatch
from motionloom.datasets.loading.crops import CaptionSpan, Crops, caption_spans
from motionloom.datasets.loading.kinds import KindPlan, drop_some
from motionloom.datasets.loading.plan import ALONE, Share
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.modalities.modality import Rows
from motionloom.datasets.modalities.table import MODALITIES, modality
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.datasets.text.cache import TextCache

# Counters that keep the draws for different purposes apart (arguments of `uniform`).
_CAPTION = 2
_CROP = 3
_DROP = 4

_KEPT = 2**15
"""Clips whose captions a process keeps, about 20 MB: all of HumanML3D's."""

Captioned = Literal["body", "face"]
"""Subject of the captions that every clip must have."""


class ConditionBatch(MotionBatch):
    """A motion batch with what each clip comes with."""

    index: Tensor
    """Clip numbers in the dataset, int64 [B]."""
    closed: Tensor
    """bool [B]: whether the row ends where its clip, or its caption's stretch, does."""
    caption: list[str]
    """Empty where a row has no text."""
    conditions: dict[str, Condition]
    """Modality -> features [B, L, E] and mask [B, L], for the modalities that were asked for. Text: word
    features, pooled [B, E] is the sentence's embedding, unit length, 0 without text. Timed ones: normalised
    features, L is the motion's T."""
    similarity: NotRequired[Tensor]
    """float32 [B, S], unit length: embeddings that say which captions mean the same. Of captioned clips."""


class ConditionedClips:
    """Clips that qualify, and batches of them: shared by training and evaluation.

    `stats` normalise the motion, or are crops that read it otherwise. `readers` read each modality, by name;
    others are left out. With `captioned` only clips with a caption qualify; for "face" captions are those
    about the face and `columns` by default the face's.
    """

    def __init__(
        self,
        dataset: ClipDataset,
        stats: FeatureStats | Crops,
        readers: Mapping[str, object],
        *,
        max_frames: int,
        min_frames: int,
        columns: NDArray[np.int64] | None = None,
        captioned: Captioned | None = None,
    ) -> None:
        if not 1 <= min_frames <= max_frames:
            raise UserError(f"need 1 <= min_frames ({min_frames}) <= max_frames ({max_frames})")
        self.face = captioned == "face"
        if self.face and columns is None:
            columns = dataset.layout.part("face")
        self.crops = stats if isinstance(stats, Crops) else Crops(dataset, stats, columns)
        self.dataset = dataset
        self.readers = {name: readers[name] for name in MODALITIES if name in readers}
        self.members = {name: modality(name).members[0] for name in self.readers}
        if self.face:
            self.members["text"] = "face_texts.json"
        self.min_frames = min_frames
        self.max_frames = max_frames
        self.captioned = captioned
        # What a clip holds is known from the index: no shard is opened to say which clips qualify.
        usable = dataset.frames >= min_frames
        if captioned:
            usable &= dataset.has(self.members["text"])
        self.clips = self.crops.clips[usable[self.crops.clips]]
        if not len(self.clips):
            kind = "face captions, " if self.face else "captions, " if captioned else ""
            raise UserError(
                f"{dataset.where}: no clip of split '{dataset.split}' has {kind}{min_frames} frames and the "
                f"body parts that are asked for; lower min_frames or choose other data"
            )
        self.present = np.zeros((len(dataset), len(self.readers)), dtype=np.bool_)
        """Which of the modalities that are read every clip of the dataset has, [n, M]."""
        for column, member in enumerate(self.members.values()):
            self.present[:, column] = dataset.has(member)
        self._captions: dict[int, list[CaptionSpan]] = {}
        """Captions of clips that were drawn, by clip."""

    @property
    def names(self) -> list[str]:
        return list(self.readers)

    def spans(
        self, clips: NDArray[np.int64], present: NDArray[np.bool_], draws: NDArray[np.float64]
    ) -> list[CaptionSpan]:
        """One caption, chosen by draws [B] in [0, 1), for every row with text; else the whole clip.

        Captions that cover `min_frames` or more, else the one that covers most.
        """
        out = []
        read = present[:, self.names.index("text")] if "text" in self.readers else np.zeros(len(clips), bool)
        for clip, text, draw in zip(clips.tolist(), read.tolist(), draws.tolist(), strict=True):
            if not text:
                out.append(CaptionSpan("", 0, int(self.dataset.frames[clip])))
                continue
            if clip not in self._captions:
                if len(self._captions) >= _KEPT:
                    self._captions.clear()
                self._captions[clip] = self._read_captions(clip)
            choices = self._captions[clip]
            out.append(choices[int(draw * len(choices))])
        return out

    def _read_captions(self, clip: int) -> list[CaptionSpan]:
        captions = self.dataset.face_texts(clip) if self.face else self.dataset.texts(clip)
        frames = int(self.dataset.frames[clip])
        return caption_spans(captions, self.dataset.layout.fps, frames, self.min_frames)

    def make(
        self,
        clips: NDArray[np.int64],
        present: NDArray[np.bool_],
        spans: list[CaptionSpan],
        crop: NDArray[np.float64],
    ) -> ConditionBatch:
        """The batch of `clips` [B] that come with `present` [B, M]; `crop` in [0, 1) places the window of too
        long a span.
        """
        cut = self.crops.cut(clips, spans, crop, self.max_frames)
        captions = [span.text for span in spans]
        frames = cut.motion.shape[1]
        batch: ConditionBatch = {
            "motion": torch.from_numpy(cut.motion),
            "length": torch.from_numpy(cut.length),
            "present": torch.from_numpy(cut.present),
            "index": torch.from_numpy(clips.copy()),
            "closed": torch.from_numpy(cut.closed),
            "caption": captions,
            "conditions": {},
        }
        for column, (name, reader) in enumerate(self.readers.items()):
            rows = Rows(clips, present[:, column], cut.begin, cut.length, frames, captions)
            batch["conditions"][name] = MODALITIES[name].batch(reader, self.dataset, rows)
        if self.captioned:
            similarity = cast(TextCache, self.readers["text"]).similarity(captions)
            batch["similarity"] = torch.from_numpy(similarity)
        return batch


class ConditionBatches(Dataset[ConditionBatch]):
    """Windows of at most `max_frames` of clips with their conditions, for training.

    A caption with start and end seconds gives that stretch of the clip; a stretch longer than `max_frames` is
    cropped at random. `balance` decides how often each kind of clip comes, `homogeneous` has every batch hold
    one kind, `drop` makes clips with several modalities come without some now and then (`kinds.py`).
    Caption, window and drop are drawn by (seed, turn, clip).
    """

    def __init__(
        self,
        dataset: ClipDataset,
        stats: FeatureStats | Crops,
        readers: Mapping[str, object],
        *,
        batch_size: int,
        max_frames: int,
        min_frames: int = 1,
        captioned: Captioned | None = None,
        balance: Mapping[str, float] | None = None,
        drop: Mapping[str, float] | None = None,
        homogeneous: bool = False,
        seed: int = 0,
        share: Share = ALONE,
        columns: NDArray[np.int64] | None = None,
    ) -> None:
        self.source = ConditionedClips(
            dataset, stats, readers, max_frames=max_frames, min_frames=min_frames, columns=columns,
            captioned=captioned,
        )  # fmt: skip
        self.seed = seed
        self.share = share
        self.drop = drop or {}
        clips = self.source.clips
        present = self.source.present[clips]
        names = self.source.names
        self.plan = KindPlan(dataset, clips, present, names, batch_size, seed, balance, homogeneous)
        self.plan.local(0, self.share)  # an indivisible batch is refused now, not in a loader worker

    def __getitem__(self, k: int) -> ConditionBatch:
        turns, clips = self.plan.local(k, self.share)
        source = self.source
        coming = self.plan.local(k + self.plan.ahead * self.share.parts, self.share)[1]
        source.dataset.fetch(np.concatenate([clips, coming]))
        # Each purpose draws by a counter of its own, so that a change of one leaves the others as they were.
        draws = uniform(self.seed, _DROP, turns, clips)
        present = drop_some(self.drop, source.present[clips], source.names, draws)
        spans = source.spans(clips, present, uniform(self.seed, _CAPTION, turns, clips))
        return source.make(clips, present, spans, uniform(self.seed, _CROP, turns, clips))


class EvalBatches(Dataset[ConditionBatch]):
    """Every qualifying clip of a split once, in order: first caption, first `max_frames` frames."""

    def __init__(
        self,
        dataset: ClipDataset,
        stats: FeatureStats | Crops,
        readers: Mapping[str, object] | None = None,
        *,
        batch_size: int,
        max_frames: int,
        min_frames: int = 1,
        captioned: Captioned | None = None,
        columns: NDArray[np.int64] | None = None,
    ) -> None:
        self.source = ConditionedClips(
            dataset, stats, readers or {}, max_frames=max_frames, min_frames=min_frames, columns=columns,
            captioned=captioned,
        )  # fmt: skip
        self.clips = self.source.clips
        self.batch_size = batch_size

    def __len__(self) -> int:
        return -(-len(self.clips) // self.batch_size)

    def __getitem__(self, k: int) -> ConditionBatch:
        if not 0 <= k < len(self):
            raise IndexError(f"evaluation batch {k} of {len(self)}")
        clips = self.clips[k * self.batch_size : (k + 1) * self.batch_size]
        source = self.source
        present = source.present[clips]
        first = np.zeros(len(clips))
        return source.make(clips, present, source.spans(clips, present, first), first)
