"""`Conversion`: one source, planned and ready to be written; the same few steps for every converter.

A converter is one function, `prepare(config) -> Conversion`: it looks at the whole source, decides what
becomes of every file and names the function that makes one clip. `run_conversion` then goes straight down:
features step (where the source needs one), shards, index, manifest.
"""

from __future__ import annotations

import contextlib
import dataclasses
import operator
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic

from motionloom.datasets.convert.common.config import ConvertConfig
from motionloom.datasets.convert.common.feature_step import FeatureStep
from motionloom.datasets.convert.common.look import Look, SourceJoints, look_at
from motionloom.datasets.convert.common.plan import C, ConversionPlan, limited
from motionloom.datasets.schema import Manifest, UserError
from motionloom.datasets.shards.options import DatasetFacts, Part, WriteOptions
from motionloom.datasets.shards.sample import Sample
from motionloom.datasets.shards.writer import dataset_writer

SCAN_FILE = ".scan.json"
"""Inside the folder of the shards: what converters remember of their source; may be deleted at any time."""

_TRIAL_CLIPS, _TRIAL_SECONDS = 8, 5.0
"""Clips converted for the time estimate, and when to stop earlier."""

_CLIPS_PER_SHARD = 256

_label = operator.methodcaller("label")


def _one_subset(_: object) -> str:
    return ""


def _quiet(_: str) -> None:
    """Say nothing."""


@dataclass(frozen=True)
class Conversion(Generic[C]):
    """What to write. `convert` and the clips must be picklable; `convert` may raise `DropClip(reason)`."""

    config: ConvertConfig
    plan: ConversionPlan[C]
    convert: Callable[[C], Sample | list[Sample]]
    licence: str
    converter: str
    version: int
    options: dict[str, Any]
    """What the output depends on, as plain JSON; never a local path."""
    audio: dict[str, Any] | None = None
    features: FeatureStep[C] | None = None
    """For sources where clips cannot be read one by one; `convert` must then give the same samples."""
    see: Callable[[C], SourceJoints] | None = None
    """The joints of a clip as they are read, for the look at a source before it is converted."""
    subset_of: Callable[[C], str] | None = None
    """The subset that a clip is in: some clips of each are looked at."""
    in_order: Callable[[C], bool] | None = None
    """Whether the first clips of a clip's subset are the cheapest to look at, as in an archive."""

    def facts(self) -> DatasetFacts:
        """What the plan knows of the manifest."""
        return DatasetFacts(
            name=self.config.name,
            layout=self.config.motion_layout(),
            licence=self.licence,
            converter=self.converter,
            converter_version=self.version,
            options=self.options,
            motion_type=self.config.motion_type,
            licences=self.plan.licences,
            audio=self.audio,
            dropped=self.plan.left_out(),
            notes=self.plan.notes,
        )

    def look(self) -> Look | None:
        """Read and measure a few clips of every subset (`config.look`); None when none is to be looked at."""
        if self.see is None or not self.config.look or not self.plan.items:
            return None
        subset_of: Callable[[C], str] = self.subset_of or _one_subset
        clips = [clip for _, clip in self.plan.items]
        return look_at(clips, self.see, subset_of, self.config, label=_label, in_order=self.in_order)

    def looked(self) -> Conversion[C]:
        """The same, its plan with what a few clips show."""
        return dataclasses.replace(self, plan=dataclasses.replace(self.plan, look=self.look()))

    def estimated(self, workers: int, started: float | None = None) -> ConversionPlan[C]:
        """The plan with disk and time: bytes by the frame counts, time by converting a few clips.

        `started` is when this process began to plan (`time.perf_counter()`): a conversion needs that long
        again before its first clip, and every worker process about as long to start.
        """
        plan = self.plan
        start_up = 0.0 if started is None else time.perf_counter() - started
        width = self.config.motion_layout().dim * (2 if self.config.motion_type == "float16" else 4)
        needed = sum(plan.frames.values()) * width + len(plan.items) * 4096
        trial = self._trial()
        seconds = None
        if trial is not None:
            first, each = trial
            pool = min(workers, self._tasks())
            # What the first clip takes longer is imports, which every process of a pool pays for once more.
            once = start_up + max(0.0, first - each) * (2 if pool > 1 else 1)
            seconds = once + each * len(plan.items) / max(1, pool)
        return dataclasses.replace(plan, bytes_needed=needed, seconds_needed=seconds)

    def _tasks(self) -> int:
        """How many processes can have work at once, at the usual number of clips a shard."""
        if self.features is not None:
            return len(self.features.batches)
        return sum(-(-count // _CLIPS_PER_SHARD) for count in self.plan.counts().values())

    def _trial(self) -> tuple[float, float] | None:
        """Seconds that the first clip takes and those after it, from a few; None without any."""
        if not self.plan.items:
            return None
        start = time.perf_counter()
        if self.features is not None:
            batch = self.features.batches[self.features.batch_of(self.plan.items[0][1])]
            batch.trial(0.0)  # pays for imports
            first, start = time.perf_counter() - start, time.perf_counter()
            clips = batch.trial(_TRIAL_SECONDS)
            return (first, (time.perf_counter() - start) / clips) if clips else None
        # The first clip pays for imports, so it is converted twice and only the second time counts.
        chosen = [item for _, item in limited(self.plan.items, _label, _TRIAL_CLIPS)]
        first, done = 0.0, 0
        for position, item in enumerate([chosen[0], *chosen]):
            with contextlib.suppress(Exception):  # the real run reports it; here only time counts
                self.convert(item)
            if position == 0:
                first, start = time.perf_counter() - start, time.perf_counter()
                continue
            done += 1
            if time.perf_counter() - start > _TRIAL_SECONDS:
                break
        return first, (time.perf_counter() - start) / done


def run_conversion(
    conversion: Conversion[C],
    out: Path,
    *,
    workers: int = 1,
    strict: bool = False,
    seed: int = 0,
    clips_per_shard: int = _CLIPS_PER_SHARD,
    progress: bool = True,
    part: Part | None = None,
    say: Callable[[str], None] = _quiet,
) -> Manifest:
    """Write the shards. `strict` stops when anything is missing or cannot be read.

    Before the first clip a few are looked at (`config.look`): `UserError` when these are no people standing
    on a floor. `say` gets a line about what an earlier run has finished, and about what the look found odd.

    Same input and options give the same bytes for any `workers`; a killed run goes on at the first unfinished
    shard. With `part`, only that part is made, without a manifest (the one returned covers the part); the run
    without one then finds the shards of all parts, makes what is missing and writes index and manifest.
    """
    how = WriteOptions(workers, clips_per_shard, seed, strict, progress, part)
    plan, features, convert = conversion.plan, conversion.features, conversion.convert
    plan.require_settled()
    if strict:
        plan.require_whole()
    if features is None and how.features_only:
        raise UserError(
            f"{conversion.converter}: this source has no features step; run the parts of 'shards'"
        )
    with dataset_writer(out, plan.items, conversion.facts(), how, describe=_label) as writer:
        if writer.progress_line:
            say(writer.progress_line)
        if part is None and writer.pending():
            seen = plan.look or conversion.look()
            if seen is not None:
                seen.require_people(plan.name)
                for warning in seen.warnings:
                    say(f"warning: {warning}")
        if features is not None:
            convert = features.make(writer.pending(), writer.work_folder, writer.pool, how, say)
        return writer.write(convert)
