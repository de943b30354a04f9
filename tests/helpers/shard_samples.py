"""Converters and clips for the shard tests; a module of its own, so that spawned workers can import it."""

from __future__ import annotations

import hashlib
import os
import signal
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from motionloom.datasets.base.records import Caption, Manifest, Split
from motionloom.datasets.motion.features.codec import encode
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.options import DatasetFacts, WriteOptions
from motionloom.datasets.shards.sample import DropClip, Sample
from motionloom.datasets.shards.writer import write_dataset

T = TypeVar("T")
LAYOUT = MotionLayout.named("body133")
SPLIT_OF: tuple[Split, ...] = ("train", "train", "train", "val", "test")


def items(count: int) -> list[tuple[Split, int]]:
    return [(SPLIT_OF[i % 5], i) for i in range(count)]


def clip_motion(i: int) -> np.ndarray:
    """Somebody who stands and trembles, each clip in its own way."""
    frames = 20 + i % 70
    joints = LAYOUT.skeleton.rest_joints[None].repeat(2, axis=0)
    joints[..., 1] -= joints[..., 1].min()
    stands = encode(joints, LAYOUT)[:1]
    trembles = 0.05 * np.random.default_rng(i).standard_normal((frames, LAYOUT.dim))
    return np.asarray(stands + trembles, dtype=np.float32)


def clip(i: int, split: Split = "train") -> Sample:
    motion = clip_motion(i)
    meta = LAYOUT.clip_meta(f"clip-ä-{i}", source="made", split=split, frames=len(motion), licence="CC0")
    texts = [Caption(text=f"person {i} walks"), Caption(text=f"person {i} turns", start=0.25, end=0.75)]
    return Sample(
        meta,
        motion,
        texts=texts,
        face_texts=[Caption(text="happy")] if i % 2 else [],
        audio=np.full((4, 438), i, dtype=np.float32) if i % 3 == 0 else None,
        wav=(np.sin(np.arange(800) / 10 + i).astype(np.float32) / 2, 8000) if i % 4 == 0 else None,
    )


@dataclass(frozen=True)
class Convert:
    """Item i -> clip i; items in `drop` are left out, those in `bad` fail, one may kill the process once."""

    drop: tuple[int, ...] = ()
    bad: tuple[int, ...] = ()
    kill_at: int | None = None
    kill_parent: bool = False
    mark: Path | None = None

    def __call__(self, i: int) -> Sample:
        if i == self.kill_at and self.mark is not None and not self.mark.exists():
            self.mark.touch()
            if self.kill_parent:
                os.kill(os.getppid(), signal.SIGKILL)
            os.kill(os.getpid(), signal.SIGKILL)
        if i in self.drop:
            raise DropClip("on the ignore list")
        if i in self.bad:
            raise RuntimeError("unreadable")
        return clip(i)


def digests(folder: Path) -> dict[str, str]:
    """sha256 of all files below a folder, by their paths."""
    found = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in found}


def facts(**changes: Any) -> DatasetFacts:
    return replace(
        DatasetFacts("made", LAYOUT, licence="CC0", converter="test", converter_version=1, options={}),
        **changes,
    )


def write_made(
    out: Path,
    made: Sequence[tuple[Split, T]],
    convert: Callable[[T], Sample],
    layout: MotionLayout = LAYOUT,
    describe: Callable[[T], str] = str,
    **how: Any,
) -> Path:
    """Write a data set named made, of any items; `how` are fields of `WriteOptions`."""
    options = WriteOptions(**{"progress": False, **how})
    write_dataset(out, made, convert, facts(layout=layout), options, describe=describe)
    return out


def write(out: Path, count: int = 60, convert: Convert | None = None, **changes: Any) -> Manifest:
    """Write clips; `changes` are fields of `DatasetFacts` or of `WriteOptions`."""
    about = {key: changes.pop(key) for key in list(changes) if key in DatasetFacts.__dataclass_fields__}
    how = WriteOptions(**{"clips_per_shard": 8, "progress": False, **changes})
    given = facts(**{"options": {"size": count}, **about})
    return write_dataset(out, items(count), convert or Convert(), given, how)


def joined(clip: dict[str, Any], column: dict[str, Any]) -> Any:
    """A clip with what a column holds for it, as Megatron-Energon joins two data sets."""
    return type(clip)({**clip, **column})
