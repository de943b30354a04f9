"""Facts about a data set, gathered for its page in two passes over the shards and bounded memory.

Counts, lengths, captions and licences are of every clip. Feature statistics and the search for outliers and
for clips to watch look at no more than `MEASURED` clips of a split, spread evenly over it.
"""

from __future__ import annotations

import hashlib
import heapq
import re
from array import array
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.progress import Progress, TaskID

from motionloom.datasets.loading.statistics import STD_FLOOR, Moments
from motionloom.datasets.motion.canonical import canonicalize, resample
from motionloom.datasets.motion.features.codec import face_of
from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import SPLITS, Caption, Manifest
from motionloom.datasets.shards.reader import ShardDataset, load_manifest, manifest_layout
from motionloom.pipeline.render.body.face import synthetic_face_controls
from motionloom.pipeline.render.viewer import ViewerMotion

MEASURED = 20_000
OUTLIERS = 12

_WORD = re.compile(r"[^\W\d_]+(?:['’][^\W\d_]+)?")
_SUBJECT = re.compile(
    r"\b(?:person|man|woman|someone|somebody|figure|human|individual|dancer|character|he|she|they)\s+"
    r"(?:(?:is|are|was|then|[a-z]+ly)\s+)*([a-z]+)",
    re.IGNORECASE,
)
_FILLERS = frozenset(
    re.findall(
        r"\w+",
        "a an and are as at back be being both by for from has have he her his i in into is it its of off on "
        "one or other out over she so some someone somebody something that the their them then there they "
        "this to up was were what while who with person man woman figure human",
    )
)


@dataclass(frozen=True)
class SplitFacts:
    """Counts of one split. `seconds` is the length of every clip [n]."""

    name: str
    shards: int
    bytes: int
    seconds: NDArray[np.float32]
    captioned: int
    with_face_text: int
    with_sound: int


@dataclass
class CaptionFacts:
    """Captions of all splits."""

    per_clip: Counter[int] = field(default_factory=Counter)
    words_each: Counter[int] = field(default_factory=Counter)
    words: Counter[str] = field(default_factory=Counter)
    """Without fillers such as 'the'."""
    vocabulary: set[str] = field(default_factory=set)
    verbs: Counter[str] = field(default_factory=Counter)
    tagged: bool = False
    """Whether `verbs` come from the source's part-of-speech tags; else they are words after a subject."""
    count: int = 0
    distinct: int = 0
    examples: list[tuple[str, str, str]] = field(default_factory=list)
    """(split, clip id, text), spread over the set."""
    repeated: list[tuple[str, int]] = field(default_factory=list)
    """(text, uses) of the captions used most often."""


@dataclass(frozen=True)
class Outlier:
    """The value of a training clip that is furthest from its column's mean, in deviations."""

    deviations: float
    clip: int
    frame: int
    column: int
    value: float


@dataclass
class DataFacts:
    """Everything the page shows, except the check and the pictures."""

    manifest: Manifest
    layout: MotionLayout
    splits: list[SplitFacts]
    captions: CaptionFacts
    licences: Counter[str]
    without_hands: int
    without_face: int
    mirrored: int
    measured_split: str
    """The split the statistics are of: training, or the first there is."""
    measured: int
    """Clips the statistics are of."""
    moments: Moments
    low: NDArray[np.float32]
    high: NDArray[np.float32]
    outliers: list[Outlier]
    candidates: list[tuple[str, int]]
    """(split, clip number) of the clips that may be shown."""
    described: NDArray[np.float32]
    """What distinguishes the candidates [n, K]."""


def gather(root: Path, *, progress: bool = False) -> tuple[DataFacts, dict[str, ShardDataset]]:
    """The facts of a data set, and its splits, opened."""
    manifest = load_manifest(root)
    layout = manifest_layout(manifest)
    splits = [split for split in SPLITS if any(shard.split == split for shard in manifest.shards)]
    opened: dict[str, ShardDataset] = {split: ShardDataset.open(root, split) for split in splits}
    texts, facts = _Texts(), []
    tally = _Tally()
    with Progress(disable=not progress) as bar:
        for split, dataset in opened.items():
            facts.append(_read_records(dataset, split, manifest, texts, tally, bar))
        measured_split = splits[0]
        chosen = {split: _spread(len(dataset)) for split, dataset in opened.items()}
        moments, low, high = (
            Moments.none(layout.dim),
            np.full(layout.dim, np.inf),
            np.full(layout.dim, -np.inf),
        )
        candidates: list[tuple[str, int]] = []
        described = []
        for split, dataset in opened.items():
            task = bar.add_task(f"measuring {split}", total=len(chosen[split]))
            for clip in chosen[split]:
                motion = dataset.motion(clip)
                candidates.append((split, clip))
                described.append(_describe(motion, layout))
                if split == measured_split:
                    present = layout.present_columns[dataset.present[clip]]
                    moments = moments.merge(Moments.of(motion, present))
                    low[present] = np.minimum(low, motion.min(axis=0))[present]
                    high[present] = np.maximum(high, motion.max(axis=0))[present]
                bar.advance(task)
        task = bar.add_task("outliers", total=len(chosen[measured_split]))
        outliers = _outliers(opened[measured_split], chosen[measured_split], moments, bar, task)
    return DataFacts(
        manifest=manifest,
        layout=layout,
        splits=facts,
        captions=texts.finish(opened),
        licences=tally.licences,
        without_hands=tally.without_hands,
        without_face=tally.without_face,
        mirrored=tally.mirrored,
        measured_split=measured_split,
        measured=len(chosen[measured_split]),
        moments=moments,
        low=np.where(moments.count > 0, low, 0.0).astype(np.float32),
        high=np.where(moments.count > 0, high, 0.0).astype(np.float32),
        outliers=outliers,
        candidates=candidates,
        described=np.asarray(described, dtype=np.float32),
    ), opened


@dataclass
class _Tally:
    licences: Counter[str] = field(default_factory=Counter)
    without_hands: int = 0
    without_face: int = 0
    mirrored: int = 0


def _read_records(
    dataset: ShardDataset, split: str, manifest: Manifest, texts: _Texts, tally: _Tally, bar: Progress
) -> SplitFacts:
    task = bar.add_task(f"reading {split}", total=len(dataset))
    captioned = 0
    examples = set(_spread(len(dataset), 8))
    for clip in range(len(dataset)):
        meta, captions = dataset.meta(clip), dataset.texts(clip)
        captioned += bool(captions)
        texts.add(split, clip, captions)
        if clip in examples and captions:
            texts.facts.examples.append((split, meta.id, captions[0].text))
        tally.licences[meta.licence] += 1
        tally.without_hands += not meta.has_hands
        tally.without_face += not meta.has_face
        tally.mirrored += meta.mirror_of is not None
        bar.advance(task)
    shards = [shard for shard in manifest.shards if shard.split == split]
    sound = dataset.has("audio.npy") | dataset.has("audio.flac")
    return SplitFacts(
        name=split,
        shards=len(shards),
        bytes=sum(shard.bytes for shard in shards),
        seconds=(dataset.frames / dataset.layout.fps).astype(np.float32),
        captioned=captioned,
        with_face_text=int(dataset.has("face_texts.json").sum()),
        with_sound=int(sound.sum()),
    )


class _Texts:
    """Counts captions; of the texts themselves only hashes are kept, 16 bytes a caption."""

    def __init__(self) -> None:
        self.facts = CaptionFacts()
        self._hashes, self._clips, self._splits = array("Q"), array("I"), array("B")

    def add(self, split: str, clip: int, captions: list[Caption]) -> None:
        facts = self.facts
        facts.per_clip[len(captions)] += 1
        for caption in captions:
            words = [word.lower() for word in _WORD.findall(caption.text)]
            facts.words_each[len(words)] += 1
            facts.vocabulary.update(words)
            facts.words.update(word for word in words if word not in _FILLERS)
            self._count_verbs(caption)
            self._hashes.append(_hash(caption.text))
            self._clips.append(clip)
            self._splits.append(SPLITS.index(split))

    def finish(self, opened: dict[str, ShardDataset]) -> CaptionFacts:
        facts = self.facts
        facts.count = len(self._hashes)
        values, first, uses = np.unique(
            np.array(self._hashes, dtype=np.uint64), return_index=True, return_counts=True
        )
        facts.distinct = len(values)
        for row in np.lexsort((first, -uses))[:10]:
            if uses[row] > 1:
                place = int(first[row])
                captions = opened[SPLITS[self._splits[place]]].texts(self._clips[place])
                text = next(c.text for c in captions if _hash(c.text) == int(values[row]))
                facts.repeated.append((text, int(uses[row])))
        return facts

    def _count_verbs(self, caption: Caption) -> None:
        if caption.tokens:
            if not self.facts.tagged:
                self.facts.tagged = True
                self.facts.verbs.clear()
            tags = (token.rpartition("/") for token in caption.tokens)
            self.facts.verbs.update(word.lower() for word, _, tag in tags if tag == "VERB" and word)
        elif not self.facts.tagged:
            self.facts.verbs.update(word.lower() for word in _SUBJECT.findall(caption.text))


def _hash(text: str) -> int:
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little")


def _spread(count: int, most: int = MEASURED) -> list[int]:
    """At most `most` clip numbers, evenly spread."""
    return sorted({int(k) for k in np.linspace(0, count - 1, min(count, most))})


def _describe(motion: NDArray[np.float32], layout: MotionLayout) -> NDArray[np.float32]:
    """What a clip is like: its length, how much each kind of feature moves, and where the root goes."""
    values = [np.log(len(motion))]
    moves = motion.std(axis=0, dtype=np.float64)
    for name, _ in layout.fields:
        values.append(moves[layout.slice(name)].mean())
    for name in ("root_yaw_velocity", "root_xz_velocity", "root_height"):
        if layout.has(name):
            values += motion[:, layout.slice(name)].mean(axis=0, dtype=np.float64).tolist()
    return np.asarray(values, dtype=np.float32)


def _outliers(
    dataset: ShardDataset, clips: list[int], moments: Moments, bar: Progress, task: TaskID
) -> list[Outlier]:
    """The clips with the most unusual values, one value a clip; columns that never move are left out."""
    std = np.where(moments.std < STD_FLOOR, np.inf, moments.std)
    best: list[tuple[float, int, Outlier]] = []
    for clip in clips:
        motion = dataset.motion(clip)
        away = np.abs(motion - moments.mean) / std
        away[:, ~dataset.layout.present_columns[dataset.present[clip]]] = 0.0
        frame, column = np.unravel_index(int(away.argmax()), away.shape)
        most = float(away[frame, column])
        found = Outlier(most, clip, int(frame), int(column), float(motion[frame, column]))
        heapq.heappush(best, (most, -clip, found))
        if len(best) > OUTLIERS:
            heapq.heappop(best)
        bar.advance(task)
    return [found for _, _, found in sorted(best, reverse=True)]


# Clips to watch.

WATCH_FPS, WATCH_SECONDS = 20.0, 10.0
"""Clips are thinned and cut to this for the page."""


def choose(facts: DataFacts, opened: dict[str, ShardDataset], count: int) -> list[tuple[str, int]]:
    """At most `count` (split, clip number): the most ordinary first, then each as unlike the rest as can be.

    The same data give the same choice. A caption is not shown twice while there are others.
    """
    values = facts.described.astype(np.float64)
    middle = np.median(values, axis=0)
    spread = np.percentile(values, 95, axis=0) - np.percentile(values, 5, axis=0)
    # Cut at both ends: otherwise only glitches and the longest clips would be chosen.
    values = np.clip((values - middle) / np.where(spread > 1e-9, spread, np.inf), -1, 1)
    distance = np.linalg.norm(values, axis=1)
    order, seen, spare = int(np.argmin(distance)), set(), []
    chosen: list[int] = []
    apart = np.full(len(values), np.inf)
    while len(chosen) < count and np.isfinite(order):
        split, clip = facts.candidates[order]
        texts = opened[split].texts(clip)
        words = texts[0].text if texts else None
        apart[order] = -1.0
        if words is not None and words in seen:
            spare.append(order)
        else:
            seen.add(words or "")
            chosen.append(order)
            nearer = np.linalg.norm(values - values[order], axis=1)
            apart = np.where(apart < 0, apart, np.minimum(apart, nearer))
        order = int(np.argmax(apart))
        if apart[order] < 0:
            break
    chosen += spare[: count - len(chosen)]
    return [facts.candidates[k] for k in chosen]


def watch(dataset: ShardDataset, clip: int) -> ViewerMotion:
    """One clip for the viewer."""
    layout = dataset.layout
    motion = dataset.motion(clip)[: int(WATCH_SECONDS * layout.fps)]
    joints = joints_of(motion, layout)
    if layout.family == "raw":
        joints = canonicalize(joints)  # sources have their own axes
    face = None
    if dataset.manifest.converter == "synth" and layout.has("face"):
        face = synthetic_face_controls(face_of(motion, layout))
    fps = layout.fps
    if fps > WATCH_FPS:
        joints = resample(joints, fps, WATCH_FPS)
        face = None if face is None else resample(face, fps, WATCH_FPS)
        fps = WATCH_FPS
    texts = dataset.texts(clip)
    whole = [caption for caption in texts if caption.end is None] or texts
    caption = whole[0].text if whole else "no caption"
    return ViewerMotion(
        joints, fps, layout.skeleton.parents, f"{dataset.split} · {dataset.ids[clip]}", caption, "", face
    )
