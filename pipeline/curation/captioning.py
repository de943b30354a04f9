"""Captions of clips in files, by a model's captioner."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import temporary_folder
from motionloom.datasets.base.records import HANDS, PRESENT_ALL, Dropped
from motionloom.datasets.convert.bvh.config import BvhConfig
from motionloom.datasets.convert.registry import prepare
from motionloom.datasets.motion.layout import BODY_JOINTS, MotionLayout
from motionloom.datasets.shards.left_out import drop
from motionloom.datasets.shards.sample import Sample
from motionloom.pipeline.contract.captioning import Sentence
from motionloom.pipeline.inference.clip_file import LEAST_FRAMES, features_for, read_clip
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.inference.motion import GeneratedMotion

MACHINE = "captioner"
"""`source` of captions that no person wrote."""


@dataclass(frozen=True)
class CaptionedPart:
    """Sentences about a part of a clip, likeliest first; times in seconds."""

    start: float
    end: float
    sentences: tuple[Sentence, ...]


@dataclass(frozen=True)
class CaptionedClip:
    """What is said of one clip: of all of it, or of equal parts as long as the captioner can read."""

    id: str
    """Name of the clip, as a conversion of the same source has it."""
    file: str
    """Place of the clip in the source."""
    seconds: float
    parts: tuple[CaptionedPart, ...]

    def record(self) -> dict[str, object]:
        """A line for `data convert --captions`, which reads the captions; probabilities inform people."""
        texts = [
            {"text": one.text, "source": MACHINE, "start": part.start, "end": part.end}
            for part in self.parts
            for one in part.sentences
        ]
        likely = [one.probability for part in self.parts for one in part.sentences]
        return {"id": self.id, "file": self.file, "captions": texts, "probabilities": likely}


class ReadClip(NamedTuple):
    """A clip in the layout of a captioner."""

    id: str
    file: str
    features: NDArray[np.float32]
    """[T, D]."""
    present: int
    """Parts that it holds, by the bits of `ClipMeta.present`."""


def captions(
    model: MotionModel, clips: Iterable[Path | str | GeneratedMotion], count: int = 3
) -> Iterator[CaptionedClip | Dropped]:
    """Yield up to `count` sentences about each part of a clip, likeliest first, or why it cannot be read.

    A clip is a motion, a file, or a folder of files (`read_clips`). `UserError` where the model
    has no captioner.
    """
    if isinstance(clips, (str, Path, GeneratedMotion)):
        raise UserError(f"clips is one, {clips!r:.60}; give a list, also of one")
    captioner = model.bundle.captioner
    layout = captioner.layout
    columns = captioner.layout.part(captioner.part)
    least = max(captioner.min_frames, LEAST_FRAMES)
    for given in clips:
        if isinstance(given, GeneratedMotion):
            features = features_for(given.joints, given.fps, layout, given.face)
            found: Iterable[ReadClip | Dropped] = [ReadClip("", given.words, *features)]
        else:
            found = read_clips(Path(given), layout)
        for clip in found:
            if isinstance(clip, Dropped):
                yield clip
                continue
            frames = len(clip.features)
            if frames < least:
                yield Dropped(
                    source=clip.file,
                    reason=f"{frames} frames at {layout.fps:g} a second; a captioner reads {least} or more",
                )
                continue
            # Without a part that the tokens cannot do without, it is read at rest.
            present = clip.present if captioner.reads(clip.present) else PRESENT_ALL
            windows = math.ceil(frames / captioner.max_frames)
            bounds = [round(frames * at / windows) for at in range(windows + 1)]
            cut = [clip.features[first:end, columns] for first, end in pairwise(bounds)]
            said = captioner.caption(cut, count, [present] * windows)
            times = [round(at / layout.fps, 3) for at in bounds]
            parts = [
                CaptionedPart(start, end, tuple(sentences))
                for (start, end), sentences in zip(pairwise(times), said, strict=True)
            ]
            yield CaptionedClip(clip.id, clip.file, frames / layout.fps, tuple(parts))


def read_clips(source: Path, layout: MotionLayout) -> Iterator[ReadClip | Dropped]:
    """The clips of a file or a folder: BVH and ASF/AMC as the converter reads them; npz and GLB
    as they are written here. `UserError` where there are none.
    """
    if not source.exists():
        raise UserError(f"{source}: no such file or folder")
    paths = sorted(source.rglob("*")) if source.is_dir() else [source]
    root = source if source.is_dir() else source.parent
    recorded = [path for path in paths if path.suffix.lower() in (".npz", ".glb")]
    if len(recorded) < len(paths) or not recorded:
        try:
            yield from _of_mocap(source, layout)
        except UserError:
            if not recorded:
                raise
    for path in recorded:
        name = path.relative_to(root).as_posix()
        try:
            clip = read_clip(path)
            yield ReadClip(
                name.rpartition(".")[0], name, *features_for(clip.joints, clip.fps, layout, clip.face)
            )
        except UserError as error:
            yield Dropped(source=str(path), reason=str(error).removeprefix(f"{path}: "))


def _of_mocap(source: Path, layout: MotionLayout) -> Iterator[ReadClip | Dropped]:
    """Fingers where a skeleton has them; else hands at rest, which count as none."""
    given = {"source": source, "layout": layout.name, "fps": layout.fps, "uncaptioned": "keep"}
    ways = ("recorded", "missing") if layout.num_joints > BODY_JOINTS else ("recorded",)
    read = set[str]()
    left_out = list[Dropped]()
    for fingers in ways:
        config = BvhConfig.parse({**given, "min_seconds": 0, "fingers": fingers}, str(source))
        with temporary_folder() as maps:
            try:
                conversion = prepare(config, out=maps)
            except UserError:
                if fingers == ways[-1] and not read:
                    raise
                continue  # none of these skeletons has fingers, or none is a person's
            plan = conversion.plan
            converter = conversion.converter
            left_out = [*plan.broken, *plan.rejected, *plan.dropped]
            for clip in (clip for _, clip in plan.items if clip.found.path not in read):
                try:
                    sample = converter.convert(clip)
                except MemoryError:
                    raise
                except Exception as error:  # whatever a bad file makes of the libraries below
                    yield drop(clip.label(), error)
                    continue
                assert isinstance(sample, Sample)
                yield ReadClip(clip.id, clip.found.path, sample.motion, HANDS * (fingers == "recorded"))
            read.update(clip.found.path for _, clip in plan.items)
        if not left_out:
            return
    yield from (one for one in left_out if one.source not in read)
