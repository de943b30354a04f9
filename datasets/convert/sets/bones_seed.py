"""BONES-SEED: BVH of the 77-joint SOMA skeleton at 120 fps, with metadata and temporal labels.

`soma_uniform/bvh/DATE/NAME.bvh` (one skeleton for all) or `soma_proportional/` (each actor's own), unpacked
from the release's archives; `metadata/seed_metadata_v00N.csv` and `..._temporal_labels.jsonl`. Lengths are in
centimetres, Y up. The zero pose has every bone along an axis of its own joint: only positions are read, so
it needs no correction to a T-pose. The same motion for the robot G1 (`g1/csv`) is left out: it is no
person's.
"""

from __future__ import annotations

import sys
from functools import cached_property
from pathlib import Path
from typing import Literal

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import number, whole
from motionloom.datasets.base.records import Caption
from motionloom.datasets.base.register import register
from motionloom.datasets.convert.bvh.convert import Bvh
from motionloom.datasets.convert.bvh.read import list_files
from motionloom.datasets.convert.common.tables import (
    BadRows,
    captions_of,
    read_csv,
    read_json_lines,
    reading_row,
)
from motionloom.datasets.convert.sets.bvh_sets import BvhSetConfig, Row

FPS = 120.0
_FACTS = (
    "package", "category", "is_neutral", "is_mirror", "move_name", "take_org_name", "take_date",
    "content_name", "content_uniform_style", "content_type_of_movement", "content_body_position",
    "content_horizontal_move", "content_vertical_move", "content_props", "content_complex_action",
    "content_repeated_action", "actor_uid", "actor_gender", "actor_age_yr", "actor_height_cm",
    "actor_weight_kg",
)  # fmt: skip
_CAPTIONS = {
    "natural": [f"content_natural_desc_{number}" for number in range(1, 5)],
    "short": ["content_short_description", "content_short_description_2"],
}


class BonesSeedConfig(BvhSetConfig):
    """Options of the BONES-SEED converter; `source` is the folder that holds metadata/."""

    name: str = "bones-seed"
    licence: str | None = "bones-seed-license"
    variant: Literal["uniform", "proportional"] = "uniform"
    """Motion on one skeleton for all, or on each actor's own."""

    def files(self) -> tuple[Path, list[str]]:
        folder = self.source / f"soma_{self.variant}"
        if not folder.is_dir():
            raise UserError(f"{self.source}: no {folder.name}/ in it; unpack {folder.name}.tar.gz there")
        return list_files(folder)

    @cached_property
    def tables(self) -> tuple[dict[str, Row], BadRows]:
        """The metadata by file name; clips of one actor stay in one split."""
        return _rows(self.source / "metadata")

    @property
    def rows(self) -> dict[str, Row]:
        return self.tables[0]

    @property
    def bad_rows(self) -> BadRows:
        return self.tables[1]


def _rows(folder: Path) -> tuple[dict[str, Row], BadRows]:
    tables = sorted(folder.glob("seed_metadata_v*.csv"))
    if not tables:
        parquet = sorted(folder.glob("*.parquet"))
        hint = f"; save {parquet[-1].name} as CSV" if parquet else "; give the folder of the release"
        raise UserError(f"{folder}: no seed_metadata_v00N.csv in it{hint}")
    labels = sorted(folder.glob("*temporal_labels.jsonl"))
    bad: BadRows = {}
    timeline = _timeline(labels[-1], bad) if labels else {}
    found: dict[str, Row] = {}
    needed = ("filename", "move_duration_frames", "is_mirror", "actor_uid")
    for place, row in read_csv(tables[-1], needed, bad):
        name = row["filename"]
        seconds = -1.0
        with reading_row(name, bad):
            seconds = whole(row["move_duration_frames"], f"{place}: '{name}': move_duration_frames") / FPS
        if seconds < 0:
            continue
        texts = [
            text
            for kind, columns in _CAPTIONS.items()
            for column in columns
            for text in captions_of(row.get(column), kind)
        ]
        for text in timeline.get(name, ()):
            if text.start < seconds:
                texts.append(text.model_copy(update={"end": min(text.end or seconds, seconds)}))
        facts = {key: sys.intern(row[key]) for key in _FACTS if row.get(key)}
        found[name] = Row(tuple(texts), facts.get("actor_uid") or name, facts)
    return found, bad


def _timeline(path: Path, bad: BadRows) -> dict[str, list[Caption]]:
    """The sentences of the temporal labels by file name, with start and end in seconds."""
    found: dict[str, list[Caption]] = {}
    for place, record in read_json_lines(path, path.name, bad):
        events = record.get("events")
        needs = "a record needs filename, and events with start_time, end_time and description"
        with reading_row(place, bad, needs):
            for event in events if isinstance(events, list) else ():
                start, end = (number(event[key], f"{place}: {key}") for key in ("start_time", "end_time"))
                texts = captions_of(event["description"], "timeline", start, end)
                found.setdefault(str(record["filename"]), []).extend(texts if start < end else ())
    return found


class BonesSeed(Bvh):
    """The BONES-SEED converter."""

    name = "bones_seed"
    title = "BONES-SEED"
    summary = "BONES-SEED: SOMA motion capture with descriptions and timelines to shards."
    example = "bones-seed shards"
    config_class = BonesSeedConfig
    beside = (".csv", "temporal_labels.jsonl")
    published = "card, 2026-03: 142,220 clips (half of them mirrored), 288 hours, 522 actors"


register(BonesSeed)
