"""`Conversion`: one source, planned and ready to be written; the same few steps for every converter."""

from __future__ import annotations

import copy
import hashlib
import json
import operator
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Generic

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import (
    MANIFEST_FILE,
    SPLITS,
    ClipMeta,
    Dropped,
    Manifest,
    MotionType,
    Split,
)
from motionloom.datasets.convert.common.config import ConvertConfig
from motionloom.datasets.convert.common.converter import Converter, PlanSettings
from motionloom.datasets.convert.common.files import read_in_threads
from motionloom.datasets.convert.common.look import Look, look_at, sampled
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.convert.common.planned import C
from motionloom.datasets.shards.index import load_index
from motionloom.datasets.shards.left_out import doubtful, grouped_notes, write_left_out
from motionloom.datasets.shards.options import SOURCE_CHECKSUM, DatasetFacts, Part, WriteOptions
from motionloom.datasets.shards.reader import load_manifest
from motionloom.datasets.shards.sample import meta_from_json
from motionloom.datasets.shards.store import RemoteStore
from motionloom.datasets.shards.tasks import ShardItem, ShardTask, convert_item, doubts_of, plan_shards
from motionloom.datasets.shards.writer import dataset_writer

_label = operator.methodcaller("label")


@dataclass(frozen=True)
class Conversion(Generic[C]):
    """A source, opened by its converter, and the plan for each of its files."""

    converter: Converter[Any, C]
    plan: ConversionPlan[C]
    settings: PlanSettings
    moved: str = ""
    """Clips of an earlier run that are in another split now, counted."""

    @property
    def config(self) -> ConvertConfig:
        config: ConvertConfig = self.converter.config
        return config

    @cached_property
    def options(self) -> dict[str, object]:
        """Everything the output depends on, as plain JSON; never a local path."""
        clips = [clip for _, clip in self.plan.items]
        read = self.converter.depends_on
        settings = self.settings
        content = read_in_threads(read, clips, workers=settings.workers, progress=settings.progress)
        # That of the list of all, of which a million clips have a gigabyte.
        whole = hashlib.sha256(b"[")
        for number, one in enumerate(content):
            whole.update(f"{', ' if number else ''}{json.dumps(one, sort_keys=True)}".encode())
        whole.update(b"]")
        return self.converter.options() | {SOURCE_CHECKSUM: whole.hexdigest()}

    def facts(self) -> DatasetFacts:
        # Of a few chosen clips (`limit`) those count that were tried.
        lost = [] if self.config.limit else [*self.plan.broken, *self.plan.rejected]
        return DatasetFacts(
            name=self.config.name,
            layout=self.converter.layout,
            licence=self.converter.licence(self.plan),
            converter=self.converter.name,
            converter_version=self.converter.version,
            options=self.options,
            motion_type=self.config.motion_type,
            licences=self.plan.totals.licences,
            credits=self.converter.credits(self.plan),
            audio=self.converter.audio(),
            dropped=self.plan.left_out(),
            not_ours=self.plan.not_ours,
            lost=lost,
            most_lost=self.config.most_rejected,
            notes=grouped_notes([*self.plan.notes, *self.converter.copies(self.plan)]),
        )

    def look(self) -> Look | None:
        """Read and measure a few clips of every subset (`config.look`); None when none is to be looked at."""
        if not self.config.look or not self.plan.items:
            return None
        clips = [clip for _, clip in self.plan.items]
        converter = self.converter
        return look_at(clips, converter.joints, converter.subset, self.config, label=_label)

    def share(self, part: Part) -> dict[str, int]:
        """Numbers of shards and clips that a part would make."""
        plan = self.plan
        how = WriteOptions()
        tasks = plan_shards(
            Path(), plan.items, self.facts(), how, _label, self.converter.depends_on, plan.removed
        )
        own = [task for at, task in enumerate(tasks) if part.has(at)]
        return {"shards": len(own), "clips": sum(len(task.items) for task in own)}

    def looked(self) -> Conversion[C]:
        """Itself, with a look at the source, what becomes of a sample of its clips, and the disk that shards
        will take in its plan.
        """
        plan = self.plan
        plan.look = self.look()
        notes = [*plan.notes, *self.converter.copies(plan), *(self._try() if self.config.look else ())]
        plan.notes = grouped_notes(list(dict.fromkeys(notes)))
        width = self.config.motion_layout().dim * (2 if self.config.motion_type == "float16" else 4)
        plan.totals.bytes_needed = sum(plan.totals.frames.values()) * width + len(plan.items) * 4096
        return self

    def _try(self) -> list[str]:
        """Convert a sample of the clips in memory; note in the plan what becomes of them, and return what is
        doubted.
        """
        plan = self.plan
        config = self.config
        clips = sampled([clip for _, clip in plan.items], self.converter.stratum, config.look, _label)
        converter = copy.copy(self.converter)
        if hasattr(config, "audio_features"):  # which take seconds a minute, and refuse nothing
            converter.config = config.model_copy(update={"audio_features": False})
        how = self.settings
        work = partial(_tried, converter, config.motion_type)
        made = [*read_in_threads(work, clips, workers=how.workers, progress=how.progress)]
        tried = f"tried {len(clips):,} of {len(plan.items):,} clips, as a conversion reads them"
        failed = [one for one in made if isinstance(one, Dropped)]
        if failed and len(clips) < len(plan.items):
            all_failed = round(len(failed) * len(plan.items) / len(clips))
            tried += f": {len(failed):,} cannot be converted, of all perhaps {all_failed:,}"
        plan.reject(failed)
        metas = [meta for one in made if not isinstance(one, Dropped) for meta in one]
        plan.totals.measured = {meta.id: meta.frames for meta in metas}
        plan.totals.count()
        return [tried, *doubtful(doubt for meta in metas for doubt in doubts_of(meta))]


def _tried(converter: Converter[Any, C], motion_type: MotionType, clip: C) -> list[ClipMeta] | Dropped:
    """The facts of a clip's samples, or the reason why it has none."""
    item = ShardItem(clip.label(), "", clip)
    layout = converter.layout
    task = ShardTask[C](Path(), clip.split, 0, (), layout, motion_type, strict=False, fingerprint="")
    made = convert_item(task, converter.convert, item)
    if isinstance(made, Dropped):
        return made
    return [meta_from_json(members["meta.json"], clip_id) for clip_id, _, members in made]


def run_conversion(
    conversion: Conversion[C],
    out: Path,
    *,
    workers: int = 1,
    seed: int = 0,
    clips_per_shard: int = WriteOptions.clips_per_shard,
    progress: bool = True,
    part: Part | None = None,
    store: RemoteStore | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> Manifest:
    """Write the shards, or those of `part` alone, of which `join_parts` makes one data set.

    Before the first clip a few are looked at (`config.look`), in each part the same of the whole source.
    `say` gets what an earlier run has finished, and what the look found odd. Same input and options give the
    same bytes for any `workers` and parts; a killed run goes on at the first unfinished shard. `store` is the
    bucket that `out` stands for.
    """
    how = WriteOptions(workers, clips_per_shard, seed, progress=progress, part=part)
    plan = conversion.plan
    plan.require_settled()
    if plan.items and not conversion.converter.licence(plan):
        raise UserError(f"{plan.name}: say under which licence the clips are: --set licence=CC-BY-4.0")
    depends_on = conversion.converter.depends_on
    with dataset_writer(
        out, plan.items, conversion.facts(), how, describe=_label, depends_on=depends_on,
        removed=plan.removed, store=store,
    ) as writer:  # fmt: skip
        for line in filter(None, (writer.progress_line, conversion.moved)):
            say(line)
        if writer.pending():
            seen = plan.look or conversion.look()
            if seen is not None:
                seen.require_people(plan.name)
                for warning in seen.warnings:
                    say(f"warning: {warning}")
        try:
            return writer.write(conversion.converter.convert)
        finally:
            if part is None and (out / MANIFEST_FILE).is_file():
                made = load_manifest(out)
                plan.reject(made.dropped[len(plan.left_out()) :])
                write_left_out(out, [*made.dropped, *plan.not_ours])


def moved_clips(folder: Path, plan: ConversionPlan[C]) -> str:
    """Return how many clips of a finished set would change their split, by both splits; empty if none."""
    before: dict[str, Split] = {}
    try:
        shards = load_manifest(folder).shards
        indices = {
            split: load_index(folder, split, [s for s in shards if s.split == split]) for split in SPLITS
        }
    except UserError:  # none, or unfinished
        return ""
    for split, index in indices.items():
        before |= {index.id(clip): split for clip in range(len(index))}
    pairs = Counter(
        f"{before[clip.id]} -> {split}" for split, clip in plan.items if before.get(clip.id, split) != split
    )
    counts = ", ".join(f"{count:,} {pair}" for pair, count in sorted(pairs.items()))
    return f"{folder}: {pairs.total():,} clips move to another split: {counts}" if pairs else ""
