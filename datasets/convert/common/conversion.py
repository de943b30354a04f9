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
from motionloom.datasets.convert.common.plan import C, ConversionPlan, limited
from motionloom.datasets.schema import Manifest, UserError
from motionloom.datasets.shards.options import DatasetFacts, Part, WriteOptions
from motionloom.datasets.shards.sample import Sample
from motionloom.datasets.shards.writer import dataset_writer

SCAN_FILE = ".scan.json"
"""Inside the folder of the shards: what converters remember of their source; may be deleted at any time."""

_TRIAL_CLIPS, _TRIAL_SECONDS = 8, 5.0
"""Clips converted for the time estimate, and when to stop earlier."""

_label = operator.methodcaller("label")


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

    def estimated(self, workers: int) -> ConversionPlan[C]:
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
        if self.features is not None:
            batch = self.features.batches[self.features.batch_of(self.plan.items[0][1])]
            batch.trial(0.0)  # pays for imports
            start = time.perf_counter()
            clips = batch.trial(_TRIAL_SECONDS)
            return (time.perf_counter() - start) / clips if clips else None
        # The first clip pays for imports, so it is converted twice and only the second time counts.
        chosen = [item for _, item in limited(self.plan.items, _label, _TRIAL_CLIPS)]
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
    conversion: Conversion[C],
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
        if features is not None:
            convert = features.make(writer.pending(), writer.work_folder, writer.pool, how)
        return writer.write(convert)
