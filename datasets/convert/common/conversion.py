"""`Conversion`: one source, planned and ready to be written; the same few steps for every converter.

A converter is one function, `prepare(config) -> Conversion`: it looks at the whole source, decides what
becomes of every file and names the function that makes one clip. Writing, resuming, licences, limits,
estimates and the manifest are here, once.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from pydantic import ConfigDict, Field

from motionloom.datasets.base.pool import Workers
from motionloom.datasets.convert.common.first_step import FirstStep, Take
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import Config, Dropped, Manifest, Split, UserError
from motionloom.datasets.shards.sample import MotionType, Sample
from motionloom.datasets.shards.tasks import Part
from motionloom.datasets.shards.writer import WORK_FOLDER, write_dataset

T = TypeVar("T")

SCAN_FILE = ".scan.json"
"""Inside the folder of the shards: what converters remember of their source; may be deleted at any time."""

_TRIAL_CLIPS, _TRIAL_SECONDS = 8, 5.0
"""Clips converted for the time estimate, and when to stop earlier."""


class ConvertConfig(Config):
    """Options that every converter has. The docstrings of the fields are the command line's help."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    source: Path
    """Folder of the source, as its authors publish it."""
    name: str
    """Name of the data set; part of the shards' file names."""
    layout: str
    """Feature layout of the shards (docs/data.md lists them)."""
    fps: float = Field(gt=0, le=240)
    """Frame rate of the shards; clips are resampled by time."""
    licence: str | None = None
    """Overrides the licence the converter states for the source."""
    allow_licence: tuple[str, ...] = ()
    """Convert only clips under these licences; empty means all."""
    min_seconds: float = Field(default=1.0, ge=0)
    """Shorter clips are left out."""
    max_seconds: float | None = Field(default=None, gt=0)
    """Longer clips are left out."""
    limit: int | None = Field(default=None, ge=1)
    """Convert only this many clips, chosen by a hash of the id so that they stay spread over the source."""
    motion_type: MotionType = "float32"
    """`float16` halves the shards; positions then keep about a millimetre."""

    def motion_layout(self) -> MotionLayout:
        """The layout of the written shards."""
        return MotionLayout.named(self.layout, fps=self.fps)

    def options(self, *local: str) -> dict[str, Any]:
        """What the output depends on, for the manifest: without `source` and other `local` paths."""
        return {key: value for key, value in self.dump().items() if key not in ("source", *local)}

    def licence_problem(self, licence: str) -> str:
        """Why a clip under `licence` is left out; empty when it may come."""
        if not self.allow_licence or licence in self.allow_licence:
            return ""
        return f"licence '{licence}' is not allowed (--allow-licence {', '.join(self.allow_licence)})"

    def length_problem(self, seconds: float) -> str:
        """Why a clip of this length is left out; empty when it may come."""
        if seconds < self.min_seconds:
            return f"{seconds:.2f} s, shorter than {self.min_seconds:g} s"
        if self.max_seconds is not None and seconds > self.max_seconds:
            return f"{seconds:.2f} s, longer than {self.max_seconds:g} s"
        return ""


@dataclass(frozen=True)
class Conversion(Generic[T]):
    """What to write. `convert` and the items must be picklable; `convert` may raise `DropClip(reason)`."""

    config: ConvertConfig
    plan: ConversionPlan[T]
    convert: Callable[[T], Sample | list[Sample]]
    describe: Callable[[T], str]
    """Name of an item in reports. A changed file must change it: name and size will do."""
    licence: str
    converter: str
    version: int
    options: dict[str, Any]
    """What the output depends on, as plain JSON; never a local path."""
    audio: dict[str, Any] | None = None
    first: FirstStep[T] | None = None
    """For sources where clips cannot be read one by one; `convert` must then give the same samples."""

    def estimated(self, workers: int) -> ConversionPlan[T]:
        """The plan with disk and time: bytes by the frame counts, time by converting a few clips."""
        plan = self.plan
        width = self.config.motion_layout().dim * (2 if self.config.motion_type == "float16" else 4)
        needed = sum(plan.frames.values()) * width + len(plan.items) * 4096
        each = self._trial()
        seconds = None if each is None else each * len(plan.items) / workers
        return dataclasses.replace(plan, bytes_needed=needed, seconds_needed=seconds)

    def _trial(self) -> float | None:
        """Seconds a clip takes, measured on a few; None when there are none."""
        if not self.plan.items:
            return None
        if self.first is not None:
            batch = self.first.batches[self.first.batch_of(self.plan.items[0][1])]
            batch.trial(0.0)  # pays for imports
            start = time.perf_counter()
            clips = batch.trial(_TRIAL_SECONDS)
            return (time.perf_counter() - start) / clips if clips else None
        # The first clip pays for imports, so it is converted twice and only the second time counts.
        chosen = [item for _, item in limited(self.plan.items, self.describe, _TRIAL_CLIPS)]
        start, done = time.perf_counter(), 0
        for position, item in enumerate([chosen[0], *chosen]):
            with contextlib.suppress(Exception):  # the real run reports it; here only time counts
                self.convert(item)
            if position == 0:
                start = time.perf_counter()
                continue
            done += 1
            if time.perf_counter() - start > _TRIAL_SECONDS:
                break
        return (time.perf_counter() - start) / done


def run_conversion(
    conversion: Conversion[T],
    out: Path,
    *,
    workers: int = 1,
    strict: bool = False,
    seed: int = 0,
    clips_per_shard: int = 256,
    progress: bool = True,
    part: Part | None = None,
) -> Manifest:
    """Write the shards. `strict` stops when anything is missing or cannot be read.

    Same input and options give the same bytes for any `workers`; a killed run goes on at the first unfinished
    shard. With `part`, only that part is made, without a manifest (the one returned tells of the part); the
    run without one then finds the shards of all parts, makes what is missing and writes index and manifest.
    """
    config, plan = conversion.config, conversion.plan
    if strict:
        plan.require_whole()
    folder, first = out / WORK_FOLDER, conversion.first
    if first is None and part is not None and part.step == "features":
        raise UserError(
            f"{conversion.converter}: this source has no features step; run the parts of 'shards'"
        )

    def run_first(items: Sequence[T], pool: Workers) -> None:
        assert first is not None
        first.run(items, folder, pool, part=part, progress=progress)

    return write_dataset(
        out,
        plan.items,
        conversion.convert if first is None else Take(first.take, folder),
        name=config.name,
        layout=config.motion_layout(),
        licence=conversion.licence,
        converter=conversion.converter,
        converter_version=conversion.version,
        options=conversion.options,
        workers=workers,
        clips_per_shard=clips_per_shard,
        seed=seed,
        strict=strict,
        progress=progress,
        describe=conversion.describe,
        motion_type=config.motion_type,
        dropped=plan.left_out(),
        licences=plan.licences,
        audio=conversion.audio,
        notes=plan.notes,
        first=None if first is None else run_first,
        part=part,
    )


def limited(
    items: Sequence[tuple[Split, T]],
    key: Callable[[T], str],
    limit: int | None,
    notes: list[str] | None = None,
) -> list[tuple[Split, T]]:
    """At most `limit` items, chosen by a hash of their key, in the old order; `notes` tell of a choice."""
    if limit is None or len(items) <= limit:
        return list(items)
    if notes is not None:
        notes.append(f"limited to {limit} of {len(items)} clips")
    kept = set(sorted((digest(key(item)) for _, item in items))[:limit])
    return [item for item in items if digest(key(item[1])) in kept]


def count_licences(licences: Sequence[str]) -> dict[str, int]:
    """Clips under each licence."""
    return dict(sorted(Counter(licences).items()))


def drop(label: str, error: Exception) -> Dropped:
    """The manifest's record of a clip that failed."""
    text = str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}"
    return Dropped(source=label, reason=text.removeprefix(f"{label}: "))


def digest(value: Any) -> str:
    """sha256 of plain JSON data."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
