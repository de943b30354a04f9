"""The page about a data set: one HTML file with everything one wants to know before training on it.

Counts, lengths, captions, features with outliers, rejected clips with reasons, licences, the source's
options, and twelve clips to watch. Made for strangers' data: every text is escaped, and nothing is loaded
from outside.
"""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from motionloom.datasets.check.dataset import CheckReport, examine
from motionloom.datasets.loading.statistics import STD_FLOOR
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError
from motionloom.datasets.shards.left_out import grouped
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.pipeline.render.charts import Line
from motionloom.pipeline.render.labels import joint_label, label
from motionloom.pipeline.render.page import Page, Value
from motionloom.pipeline.results.data_page.facts import (
    WATCH_SECONDS,
    DataFacts,
    SplitFacts,
    choose,
    gather,
    watch,
)

BINS = 24
TOP_WORDS = 14
REASONS = 40
"""Kinds of reasons for rejected clips that get a table of their own."""

Rows = list[list[Value]]

_JOINTS = {
    22: "Joint 0 is the pelvis, 1 to 21 are the body's.",
    52: "Joint 0 is the pelvis, 1 to 21 are the body's, 22 to 36 the left and 37 to 51 the right hand's.",
}
_FIRST_JOINT = {
    "positions": 1,
    "rotations_6d": 1,
    "velocities": 0,
    "pose": 0,
    "root_orient": 0,
    "pose_body": 1,
    "pose_hand": 22,
}
"""Fields with a few values for each joint, and the joint they begin with."""
_AXES = {3: ("x", "y", "z"), 6: ("a1", "a2", "a3", "b1", "b2", "b3")}


def write_data_report(
    root: Path, out: Path, *, check: bool = False, clips: int = 12, progress: bool = False
) -> None:
    """Write the page about the data set in `root` to the file `out`. `check` also checks the whole set."""
    if not root.is_dir():
        raise UserError(f"{root}: no such folder")
    if clips < 0:
        raise UserError(f"clips to watch: {clips}; give 0 or more")
    found = examine(root, progress=progress) if check else None
    facts, opened = gather(root, progress=progress)
    data_page(facts, opened, found, clips).write(out)


def data_page(
    facts: DataFacts, opened: dict[str, ShardDataset], found: CheckReport | None, clips: int
) -> Page:
    """The page of gathered facts."""
    manifest, layout = facts.manifest, facts.layout
    page = Page(
        f"Data set {manifest.name}",
        f"{layout.name} ({layout.family}), {layout.dim} values a frame at {layout.fps:g} frames a second, "
        f"made by {manifest.converter} version {manifest.converter_version}",
    )
    _overview(page, facts, found)
    if clips:
        page.add_heading("Watch")
        motions = [watch(opened[split], clip) for split, clip in choose(facts, opened, clips)]
        page.add_viewer(motions, _watch_note(layout, len(motions)))
    _lengths(page, facts)
    _captions(page, facts)
    _features(page, facts, opened)
    _rejected(page, facts)
    _source(page, facts)
    if found is not None:
        _checked(page, found)
    return page


def _overview(page: Page, facts: DataFacts, found: CheckReport | None) -> None:
    seconds = sum(float(split.seconds.sum()) for split in facts.splits)
    clips = sum(len(split.seconds) for split in facts.splits)
    tiles: dict[str, Value] = {
        "clips": clips,
        "length": _span(seconds),
        "captions": facts.captions.count,
        "rejected clips": sum(drop.kind == "rejected" for drop in facts.manifest.dropped),
        "on disk": _size(sum(split.bytes for split in facts.splits)),
        "licence": _licence(facts),
    }
    if found is not None:
        errors, warnings = sum(found.error_kinds.values()), sum(found.warning_kinds.values())
        tiles["check"] = f"{errors:,} errors" if errors else f"{warnings:,} warnings" if warnings else "sound"
    page.add_heading("Overview").add_facts(tiles)
    rows: Rows = [_split_row(split, clips) for split in facts.splits]
    columns = ["split", "clips", "% of clips", "minutes", "median s", "5 % below", "5 % above"]
    columns += ["with captions", "with face text", "with sound", "shards", "MiB"]
    page.add_table(columns, rows, "Splits", digits=1)


def _licence(facts: DataFacts) -> str:
    """The licence if it is one and short; the whole list stands further down."""
    names = list(facts.licences)
    if len(names) > 1:
        return f"{len(names)} licences"
    return names[0] if len(names[0]) <= 16 else "see below"


def _split_row(split: SplitFacts, clips: int) -> list[Value]:
    low, middle, high = (float(value) for value in np.percentile(split.seconds, [5, 50, 95]))
    count = len(split.seconds)
    shares = 100 * count / clips, float(split.seconds.sum()) / 60
    having = split.captioned, split.with_face_text, split.with_sound
    return [split.name, count, *shares, middle, low, high, *having, split.shards, split.bytes / 2**20]


def _watch_note(layout: MotionLayout, count: int) -> str:
    raw = ""
    if layout.family == "raw":
        raw = (
            " The poses are the data's; the bones are a neutral skeleton's, since no body model is used here."
        )
    return (
        f"{count} clips that differ as much as possible, at most {WATCH_SECONDS:g} s of each. "
        f"Drag to orbit, wheel to zoom, space to play.{raw}"
    )


def _lengths(page: Page, facts: DataFacts) -> None:
    page.add_heading("Lengths")
    longest = max(float(split.seconds.max()) for split in facts.splits)
    usual = max(float(np.percentile(split.seconds, 99.5)) for split in facts.splits)
    high = _round_up(usual if longest > 1.5 * usual else longest)
    beyond = sum(int((split.seconds > high).sum()) for split in facts.splits)
    counts = {
        split.name: np.histogram(np.minimum(split.seconds, high), BINS, (0, high))[0]
        for split in facts.splits
    }
    page.add_histogram(counts, (0, high), "Length of clips", "seconds")
    shares = {
        split.name: np.histogram(np.minimum(split.seconds, high), BINS, (0, high), weights=split.seconds)[0]
        / 60
        for split in facts.splits
    }
    page.add_histogram(shares, (0, high), "Minutes of motion in clips of each length", "seconds", "minutes")
    if beyond:
        page.add_text(
            f"{beyond} clips are longer than {high:g} s, the longest {longest:.1f} s; they stand at the end."
        )


def _captions(page: Page, facts: DataFacts) -> None:
    captions = facts.captions
    page.add_heading("Captions")
    if not captions.count:
        page.add_text("No clip has a caption.")
        return
    clips = sum(captions.per_clip.values())
    page.add_facts(
        {
            "captions": captions.count,
            "a clip": captions.count / clips,
            "clips without": captions.per_clip[0],
            "different texts": captions.distinct,
            "different words": len(captions.vocabulary),
            "words a caption": sum(n * k for n, k in captions.words_each.items()) / captions.count,
        }
    )
    _counts(page, captions.words_each, "Words in a caption", "words", "captions")
    _counts(page, captions.per_clip, "Captions of a clip", "captions", "clips")
    page.add_ranking(captions.words.most_common(TOP_WORDS), "Most common words (without fillers)")
    what = "Most common verbs (the source's tags)" if captions.tagged else "First word after the subject"
    if captions.verbs:
        page.add_ranking(captions.verbs.most_common(TOP_WORDS), what)
    page.add_table(["split", "clip", "caption"], [list(row) for row in captions.examples], "Examples")
    if captions.repeated:
        page.add_table(
            ["caption", "uses"],
            [[text, uses] for text, uses in captions.repeated],
            "Captions used most often",
        )


def _counts(page: Page, counts: Counter[int], title: str, x_label: str, y_label: str) -> None:
    """A histogram of whole numbers; the highest half per mille is put into the last bin."""
    total, seen, high = sum(counts.values()), 0, 1
    for value in sorted(counts):
        seen += counts[value]
        high = max(high, value)
        if seen >= 0.9995 * total:
            break
    width = -(-(high + 1) // 40)
    bins = np.zeros(-(-(high + 1) // width))
    for value, count in counts.items():
        bins[min(value, high) // width] += count
    page.add_histogram({y_label: bins}, (-0.5, len(bins) * width - 0.5), title, x_label, y_label)


def _features(page: Page, facts: DataFacts, opened: dict[str, ShardDataset]) -> None:
    layout, mean, std = facts.layout, facts.moments.mean, facts.moments.std
    frames = int(facts.moments.count.max())
    page.add_heading("Features")
    page.add_text(
        f"Of {frames:,} frames of {facts.measured:,} clips of the {facts.measured_split} split, "
        f"in the units of the layout: metres, radians, per frame where they are velocities. "
        f"{_JOINTS[layout.num_joints]}"
    )
    rows: Rows = []
    for name, size in layout.fields:
        part = layout.slice(name)
        still = int((std[part] < STD_FLOOR).sum())
        means = float(np.abs(mean[part]).mean()), float(std[part].mean()), float(std[part].max())
        ends = float(facts.low[part].min()), float(facts.high[part].max())
        rows.append([label(name), size, *means, *ends, still])
    columns = ["feature", "columns", "mean of |mean|", "mean deviation", "largest", "lowest value"]
    page.add_table([*columns, "highest value", "still columns"], rows, digits=4)
    for name, size in layout.fields:
        if size >= 12:
            part = layout.slice(name)
            _field_plots(page, name, mean[part], std[part])
    _outlier_table(page, facts, opened)


def _field_plots(page: Page, name: str, mean: np.ndarray, std: np.ndarray) -> None:
    """Mean and deviation of one field over its joints, a line for each axis; of plain columns, one line."""
    axes = _AXES[6] if name == "rotations_6d" else _AXES[3]
    if name not in _FIRST_JOINT:
        order = np.arange(len(mean))
        page.add_plot(
            [Line("mean", order, mean), Line("deviation", order, std)], label(name), x_label="column"
        )
        return
    for what, values in (("mean", mean), ("deviation", std)):
        joints = values.reshape(-1, len(axes))
        number = np.arange(len(joints)) + _FIRST_JOINT[name]
        lines = [Line(axis, number, joints[:, k]) for k, axis in enumerate(axes)]
        page.add_plot(lines, f"{label(name)}: {what}", x_label="joint")


def _outlier_table(page: Page, facts: DataFacts, opened: dict[str, ShardDataset]) -> None:
    dataset, layout = opened[facts.measured_split], facts.layout
    rows: Rows = []
    for outlier in facts.outliers:
        texts = dataset.texts(outlier.clip)
        row: list[Value] = [dataset.ids[outlier.clip], _value_name(outlier.column, layout), outlier.frame]
        rows.append([*row, outlier.value, outlier.deviations, texts[0].text if texts else None])
    columns = ["clip", "value", "frame", "is", "deviations", "caption"]
    page.add_table(columns, rows, "Most unusual values, one a clip", digits=3)


def _rejected(page: Page, facts: DataFacts) -> None:
    dropped = facts.manifest.dropped
    page.add_heading("Rejected clips")
    if not dropped:
        page.add_text("None: every clip of the source is here.")
        return
    ranked: list[tuple[str, Rows]] = [
        (group.kind, [[drop.source, drop.reason] for drop in group.members]) for group in grouped(dropped)
    ]
    rest = [row for _, rows in ranked[REASONS:] for row in rows]
    clips = sum(len(split.seconds) for split in facts.splits)
    rejected = sum(drop.kind == "rejected" for drop in dropped)
    other = Counter(drop.kind for drop in dropped if drop.kind != "rejected")
    more = "".join(f"; {count:,} {kind} files" for kind, count in sorted(other.items()))
    page.add_text(f"{rejected:,} clips of {rejected + clips:,} were left out{more}, for these reasons.")
    for kind, rows in [*ranked[:REASONS], *([("other reasons", rest)] if rest else [])]:
        page.add_folded(f"{len(rows):,} × {kind}", ["source", "reason"], rows)


def _source(page: Page, facts: DataFacts) -> None:
    manifest = facts.manifest
    page.add_heading("Source and licences")
    page.add_table(
        ["licence", "clips"], [[name or "none stated", count] for name, count in facts.licences.most_common()]
    )
    body = manifest.options.get("body_model")
    if isinstance(body, dict) and isinstance(body.get("sentence"), str):
        page.add_subheading("Body model").add_text(body["sentence"])
    remarks = list(manifest.notes)
    for count, what in (
        (facts.without_hands, "Clips without finger motion"),
        (facts.without_face, "Clips without expression"),
        (facts.mirrored, "Clips that are mirror images of others"),
    ):
        if count:
            remarks.append(f"{what}: {count:,}")
    if remarks:
        page.add_subheading("Notes").add_list(remarks)
    if manifest.audio:
        page.add_table(["setting", "value"], _flat(manifest.audio), "Settings of the audio features")
    page.add_folded(
        f"Options of the converter {manifest.converter}, version {manifest.converter_version}",
        ["option", "value"],
        _flat(manifest.options),
    )


def _checked(page: Page, found: CheckReport) -> None:
    page.add_heading("Check")
    page.add_text(f"{_verdict(found).capitalize()} in {found.clips:,} sound clips ({found.frames:,} frames).")
    for title, kinds, listed in (
        ("Errors", found.error_kinds, found.errors),
        ("Warnings", found.warning_kinds, found.warnings),
    ):
        if kinds:
            counts: Rows = [[kind, count] for kind, count in sorted(kinds.items())]
            page.add_table([title.lower(), "count"], counts)
            page.add_folded(f"{title}, listed", ["where", "what"], [[p.where, p.message] for p in listed])


def _verdict(found: CheckReport) -> str:
    errors, warnings = sum(found.error_kinds.values()), sum(found.warning_kinds.values())
    parts = [f"{errors:,} errors" if errors else "no errors"]
    return ", ".join([*parts, f"{warnings:,} warnings" if warnings else "no warnings"])


def _flat(data: dict[str, Any], prefix: str = "") -> Rows:
    """Nested settings as rows of dotted names and plain values."""
    rows: Rows = []
    for key, value in data.items():
        if isinstance(value, dict) and value:
            rows += _flat(value, f"{prefix}{key}.")
        else:
            rows.append([f"{prefix}{key}", value if isinstance(value, str) else json.dumps(value)])
    return rows


def _value_name(column: int, layout: MotionLayout) -> str:
    """A column in words: the field, and the joint and axis where it has them."""
    field = next(name for name, _ in layout.fields if column < layout.slice(name).stop)
    part = layout.slice(field)
    at, name = column - part.start, label(field)
    if field not in _FIRST_JOINT:
        return f"{name} {at}" if part.stop - part.start > 1 else name
    axes = _AXES[6] if field == "rotations_6d" else _AXES[3]
    number = at // len(axes) + _FIRST_JOINT[field]
    known = number < layout.num_joints
    joint = joint_label(layout.skeleton.joints[number]) if known else f"joint {number}"
    return f"{name}: {joint}, {axes[at % len(axes)]}"


def _round_up(value: float) -> float:
    step = 10 ** np.floor(np.log10(max(value, 1e-6))) / 2
    return float(np.ceil(value / step) * step)


def _span(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.1f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def _size(count: int) -> str:
    return f"{count / 2**20:.1f} MiB" if count < 2**30 else f"{count / 2**30:.1f} GiB"
