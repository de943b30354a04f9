"""The page about a data set: one HTML file with what one wants to know before training on it.

Counts, lengths, captions, features, rejected clips with reasons, licences, the source's
options, and some clips to watch. Made for strangers' data: every text is escaped, and nothing is loaded from
outside. Counts, lengths, captions and licences are of every clip; feature statistics look at no more than
`MEASURED` clips of a split, spread evenly over it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.progress import Progress

from motionloom.datasets.base.progress import duration
from motionloom.datasets.check.dataset import CheckReport, examine
from motionloom.datasets.loading.statistics import STD_FLOOR, Moments
from motionloom.datasets.motion.canonical import canonicalize, resample
from motionloom.datasets.motion.features.codec import face_of
from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.schema import SPLITS, Caption, Manifest, UserError
from motionloom.datasets.shards.left_out import grouped
from motionloom.datasets.shards.reader import ShardDataset, load_manifest, manifest_layout
from motionloom.pipeline.render.body.face import synthetic_face_controls
from motionloom.pipeline.render.labels import label
from motionloom.pipeline.render.page import Page, Value
from motionloom.pipeline.render.viewer import ViewerMotion
from motionloom.pipeline.store.yaml import flatten, setting_text

MEASURED = 20_000
BINS = 24
EXAMPLES = 8
"""Captions of each split that are shown."""
REASONS = 40
"""Kinds of reasons for rejected clips that get a table of their own."""
WATCH_FPS, WATCH_SECONDS = 20.0, 10.0
"""Clips are thinned and cut to this for the page."""

Rows = list[list[Value]]


@dataclass
class Records:
    """What the records of all clips say, counted."""

    captions: int = 0
    different: set[int] = field(default_factory=set)
    """Hashes of the captions' texts."""
    captioned: Counter[str] = field(default_factory=Counter)
    """Clips with a caption, by split."""
    examples: Rows = field(default_factory=list)
    licences: Counter[str] = field(default_factory=Counter)
    remarks: Counter[str] = field(default_factory=Counter)

    def add(self, dataset: ShardDataset, clip: int, *, example: bool) -> None:
        """One clip's record."""
        meta, captions = dataset.meta(clip), dataset.texts(clip)
        self.captions += len(captions)
        self.captioned[dataset.split] += bool(captions)
        for caption in captions:
            self.different.add(hash(caption.text))
        if example and captions:
            self.examples.append([dataset.split, meta.id, captions[0].text])
        self.licences[meta.licence] += 1
        self.remarks["Clips without finger motion"] += not meta.has_hands
        self.remarks["Clips without expression"] += not meta.has_face
        self.remarks["Clips that are mirror images of others"] += meta.mirror_of is not None


@dataclass(frozen=True)
class Measures:
    """Statistics of the features of one split's clips."""

    clips: int
    moments: Moments
    low: NDArray[np.float64]
    high: NDArray[np.float64]


def write_data_report(
    root: Path, out: Path, *, check: bool = False, clips: int = 12, progress: bool = False
) -> None:
    """Write the page about the data set in `root` to the file `out`. `check` also checks the whole set."""
    if not root.is_dir():
        raise UserError(f"{root}: no such folder")
    if clips < 0:
        raise UserError(f"clips to watch: {clips}; give 0 or more")
    found = examine(root, progress=progress) if check else None
    manifest = load_manifest(root)
    layout = manifest_layout(manifest)
    there = {shard.split for shard in manifest.shards}
    opened: dict[str, ShardDataset] = {s: ShardDataset.open(root, s) for s in SPLITS if s in there}
    records = Records()
    with Progress(disable=not progress) as bar:
        for split, dataset in opened.items():
            shown = set(_spread(len(dataset), EXAMPLES))
            for clip in bar.track(range(len(dataset)), description=f"reading {split}"):
                records.add(dataset, clip, example=clip in shown)
        measured = measure(next(iter(opened.values())), bar)
    page = Page(
        f"Data set {manifest.name}",
        f"{layout.name} ({layout.family}), {layout.dim} values a frame at {layout.fps:g} frames a second, "
        f"made by {manifest.converter} version {manifest.converter_version}",
    )
    _overview(page, manifest, opened, records, found)
    if clips:
        page.add_heading("Watch")
        raw = (
            " The bones are a neutral skeleton's: no body model is used here."
            if layout.family == "raw"
            else ""
        )
        page.add_viewer(to_watch(opened, clips), f"At most {WATCH_SECONDS:g} s of each clip.{raw}")
    _captions(page, records, sum(map(len, opened.values())))
    _features(page, next(iter(opened.values())), measured)
    _stated(page, manifest)
    _rejected(page, manifest, sum(map(len, opened.values())))
    _source(page, manifest, records)
    if found is not None:
        _checked(page, found)
    page.write(out)


def measure(dataset: ShardDataset, bar: Progress) -> Measures:
    """Moments and ends of every column."""
    layout, chosen = dataset.layout, _spread(len(dataset), MEASURED)
    moments, low, high = Moments.none(layout.dim), np.full(layout.dim, np.inf), np.full(layout.dim, -np.inf)
    for clip in bar.track(chosen, description="measuring"):
        motion, present = dataset.motion(clip), layout.present_columns[dataset.present[clip]]
        moments = moments.merge(Moments.of(motion, present))
        low[present] = np.minimum(low, motion.min(axis=0))[present]
        high[present] = np.maximum(high, motion.max(axis=0))[present]
    seen = moments.count > 0
    return Measures(len(chosen), moments, np.where(seen, low, 0.0), np.where(seen, high, 0.0))


def _spread(count: int, most: int) -> list[int]:
    """At most `most` clip numbers, evenly spread."""
    return sorted({int(k) for k in np.linspace(0, count - 1, min(count, most))})


def to_watch(opened: Mapping[str, ShardDataset], count: int) -> list[ViewerMotion]:
    """At most `count` clips for the viewer, spread over all splits, different captions first."""
    every = [(dataset, clip) for dataset in opened.values() for clip in _spread(len(dataset), 8 * count)]
    order = np.random.default_rng(0).permutation(len(every)).tolist()
    first: dict[str, ViewerMotion] = {}
    rest: list[ViewerMotion] = []
    for number in order:
        if len(first) == count:
            break
        dataset, clip = every[number]
        words = _main_caption(dataset.texts(clip))
        if words not in first:
            first[words] = watch(dataset, clip)
        elif len(rest) < count:
            rest.append(watch(dataset, clip))
    return [*first.values(), *rest][:count]


def watch(
    dataset: ShardDataset, clip: int, *, start: int = 0, seconds: float = WATCH_SECONDS
) -> ViewerMotion:
    """One clip for the viewer, from the frame `start` on."""
    layout = dataset.layout
    motion = dataset.motion(clip)[start : start + int(seconds * layout.fps)]
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
    place, caption = f"{dataset.split} · {dataset.ids[clip]}", _main_caption(dataset.texts(clip))
    return ViewerMotion(
        joints, fps, layout.skeleton.parents, place, caption or "no caption", face_controls=face
    )


def _main_caption(texts: list[Caption]) -> str:
    """The first caption of the whole clip, else the first; empty without."""
    whole = [caption for caption in texts if caption.end is None] or texts
    return whole[0].text if whole else ""


def _overview(
    page: Page,
    manifest: Manifest,
    opened: Mapping[str, ShardDataset],
    records: Records,
    found: CheckReport | None,
) -> None:
    seconds = {split: dataset.frames / dataset.layout.fps for split, dataset in opened.items()}
    clips = sum(map(len, opened.values()))
    licences = list(records.licences)
    tiles: dict[str, Value] = {
        "clips": clips,
        "length": duration(sum(float(each.sum()) for each in seconds.values())),
        "captions": records.captions,
        "rejected clips": sum(drop.kind == "rejected" for drop in manifest.dropped),
        "on disk": f"{sum(shard.bytes for shard in manifest.shards) / 2**20:,.1f} MiB",
        "licence": licences[0] if len(licences) == 1 and len(licences[0]) <= 16 else "see below",
    }
    if found is not None:
        tiles["check"] = _verdict(found)
    page.add_heading("Overview").add_facts(tiles)
    rows: Rows = []
    for split, dataset in opened.items():
        low, middle, high = (float(value) for value in np.percentile(seconds[split], [5, 50, 95]))
        shards = [shard for shard in manifest.shards if shard.split == split]
        faces = int(dataset.has("face_texts.json").sum())
        sounds = int((dataset.has("audio.npy") | dataset.has("audio.flac")).sum())
        having = records.captioned[split], faces, sounds
        spread = 100 * len(dataset) / clips, float(seconds[split].sum()) / 60, middle, low, high
        size = sum(shard.bytes for shard in shards) / 2**20
        rows.append([split, len(dataset), *spread, *having, len(shards), size])
    columns = ["split", "clips", "% of clips", "minutes", "median s", "5 % below", "5 % above"]
    columns += ["with captions", "with face text", "with sound", "shards", "MiB"]
    page.add_table(columns, rows, "Splits", digits=1)
    high = max(float(np.percentile(each, 99.5)) for each in seconds.values())
    counts = {
        split: np.histogram(np.minimum(each, high), BINS, (0, high))[0] for split, each in seconds.items()
    }
    page.add_histogram(counts, (0, high), "Length of clips, the longest at the end", "seconds", "clips")


def _captions(page: Page, records: Records, clips: int) -> None:
    page.add_heading("Captions")
    if not records.captions:
        page.add_text("No clip has a caption.")
        return
    page.add_facts(
        {
            "captions": records.captions,
            "a clip": records.captions / clips,
            "clips without": clips - sum(records.captioned.values()),
            "different texts": len(records.different),
        }
    )
    page.add_table(["split", "clip", "caption"], records.examples, "Examples")


def _features(page: Page, dataset: ShardDataset, found: Measures) -> None:
    layout, mean, std = dataset.layout, found.moments.mean, found.moments.std
    page.add_heading("Features")
    page.add_text(
        f"Of {int(found.moments.count.max()):,} frames of {found.clips:,} clips of the {dataset.split} "
        f"split, in the units of the layout: metres, radians, per frame where they are velocities."
    )
    rows: Rows = []
    for name, size in layout.fields:
        part = layout.slice(name)
        still = int((std[part] < STD_FLOOR).sum())
        means = float(np.abs(mean[part]).mean()), float(std[part].mean()), float(std[part].max())
        ends = float(found.low[part].min()), float(found.high[part].max())
        rows.append([label(name), size, *means, *ends, still])
    columns = ["feature", "columns", "mean of |mean|", "mean deviation", "largest", "lowest value"]
    page.add_table([*columns, "highest value", "still columns"], rows, digits=4)


def _stated(page: Page, manifest: Manifest) -> None:
    """What the makers of the source state, beside what was found and converted."""
    if not manifest.audit:
        return
    page.add_heading("What the makers state")
    rows: Rows = [[row.what, row.stated, row.found, row.taken, row.why] for row in manifest.audit]
    header = ["", "stated", "found", "converted", "left out"]
    page.add_table(header, rows, f"Stated by: {manifest.audit[0].by}")


def _rejected(page: Page, manifest: Manifest, clips: int) -> None:
    dropped = manifest.dropped
    page.add_heading("Rejected clips")
    if not dropped:
        page.add_text("None: every clip of the source is here.")
        return
    ranked: list[tuple[str, Rows]] = [
        (group.kind, [[drop.source, drop.reason] for drop in group.members]) for group in grouped(dropped)
    ]
    rest = [row for _, rows in ranked[REASONS:] for row in rows]
    rejected = sum(drop.kind == "rejected" for drop in dropped)
    other = Counter(drop.kind for drop in dropped if drop.kind != "rejected")
    more = "".join(f"; {count:,} {kind} files" for kind, count in sorted(other.items()))
    page.add_text(f"{rejected:,} clips of {rejected + clips:,} were left out{more}, for these reasons.")
    for kind, rows in [*ranked[:REASONS], *([("other reasons", rest)] if rest else [])]:
        page.add_folded(f"{len(rows):,} × {kind}", ["source", "reason"], rows)


def _source(page: Page, manifest: Manifest, records: Records) -> None:
    page.add_heading("Source and licences")
    page.add_table(
        ["licence", "clips"],
        [[name or "none stated", count] for name, count in records.licences.most_common()],
    )
    counted = [f"{what}: {count:,}" for what, count in records.remarks.items() if count]
    remarks = [*manifest.notes, *counted]
    if remarks:
        page.add_subheading("Notes").add_list(remarks)
    for title, settings in (
        ("Settings of the audio features", manifest.audio),
        (
            f"Options of the converter {manifest.converter}, version {manifest.converter_version}",
            manifest.options,
        ),
    ):
        rows: Rows = [[key, setting_text(value)] for key, value in flatten(settings or {}).items()]
        if rows:
            page.add_folded(title, ["option", "value"], rows)


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
    return f"{errors or 'no'} errors, {warnings or 'no'} warnings"
