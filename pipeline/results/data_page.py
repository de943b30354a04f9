"""The page about a data set: one HTML file with what one wants to know before training on it.

Counts, lengths, captions, rejected clips with reasons, licences, the source's options, and some clips to
watch. Data come from strangers: every text is escaped, and nothing is loaded from outside. Whether a set is
sound is for `motionloom data check` to say.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rich.progress import Progress

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.progress import duration
from motionloom.datasets.base.records import SPLITS, Caption, Manifest
from motionloom.datasets.motion.canonical import canonicalize, resample
from motionloom.datasets.motion.features.codec import face_of
from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.shards.left_out import grouped
from motionloom.datasets.shards.reader import ShardDataset, load_manifest, manifest_layout
from motionloom.pipeline.render.body.face import synthetic_face_controls
from motionloom.pipeline.render.page import Page, Value
from motionloom.pipeline.render.viewer import ViewerMotion
from motionloom.pipeline.store.yaml import flatten, setting_text

BINS = 24
EXAMPLES = 8
"""Captions of each split that are shown."""
REASONS = 40
"""Kinds of reasons for rejected clips that get a table of their own."""
WATCH, WATCH_FPS, WATCH_SECONDS = 12, 20.0, 10.0
"""Clips to watch; they are thinned and cut to this for the page."""

Rows = list[list[Value]]


@dataclass
class Records:
    """Counts over the records of all clips."""

    captions: int = 0
    different: set[int] = field(default_factory=set)
    """Hashes of the captions' texts."""
    captioned: Counter[str] = field(default_factory=Counter)
    """Clips with a caption, by split."""
    examples: Rows = field(default_factory=list)
    licences: Counter[str] = field(default_factory=Counter)
    remarks: Counter[str] = field(default_factory=Counter)

    def add(self, dataset: ShardDataset, clip: int, *, example: bool) -> None:
        """Count one clip's record; an `example` shows its first caption on the page."""
        meta = dataset.meta(clip)
        captions = dataset.texts(clip)
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


def write_data_report(root: Path, out: Path, *, progress: bool = False) -> None:
    """Write the page about the data set in `root` to the file `out`."""
    if not root.is_dir():
        raise UserError(f"{root}: no such folder")
    manifest = load_manifest(root)
    layout = manifest_layout(manifest)
    filled = {shard.split for shard in manifest.shards}
    splits: dict[str, ShardDataset] = {s: ShardDataset.open(root, s) for s in SPLITS if s in filled}
    records = Records()
    # One pass over the records: of large sets they are read from disk.
    with Progress(disable=not progress) as bar:
        for split, dataset in splits.items():
            shown = set(_spread(len(dataset), EXAMPLES))
            for clip in bar.track(range(len(dataset)), description=f"reading {split}"):
                records.add(dataset, clip, example=clip in shown)
    page = Page(
        f"Data set {manifest.name}",
        f"{layout.name} ({layout.family}), {layout.dim} values a frame at {layout.fps:g} frames a second, "
        f"made by {manifest.converter} version {manifest.converter_version}",
    )
    _overview(page, manifest, splits, records)
    raw = " The bones are a neutral skeleton's: no body model is used here." if layout.family == "raw" else ""
    page.add_heading("Watch")
    page.add_viewer(to_watch(splits, WATCH), f"At most {WATCH_SECONDS:g} s of each clip.{raw}")
    total = sum(map(len, splits.values()))
    _captions(page, records, total)
    _rejected(page, manifest, total)
    _source(page, manifest, records)
    page.write(out)


def _spread(count: int, most: int) -> list[int]:
    """At most `most` clip numbers, evenly spread."""
    return sorted({int(k) for k in np.linspace(0, count - 1, min(count, most))})


def to_watch(splits: Mapping[str, ShardDataset], count: int) -> list[ViewerMotion]:
    """At most `count` clips for the viewer, spread over all splits, different captions first."""
    # Eight times as many candidates as wanted, so that enough of them differ in their captions.
    every = [(dataset, clip) for dataset in splits.values() for clip in _spread(len(dataset), 8 * count)]
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
    place = f"{dataset.split} · {dataset.ids[clip]}"
    caption = _main_caption(dataset.texts(clip))
    return ViewerMotion(
        joints, fps, layout.skeleton.parents, place, caption or "no caption", face_controls=face
    )


def _main_caption(texts: list[Caption]) -> str:
    """The first caption of the whole clip, else the first; empty without."""
    whole = [caption for caption in texts if caption.end is None] or texts
    return whole[0].text if whole else ""


def _overview(page: Page, manifest: Manifest, splits: Mapping[str, ShardDataset], records: Records) -> None:
    seconds = {split: dataset.frames / dataset.layout.fps for split, dataset in splits.items()}
    clips = sum(map(len, splits.values()))
    licences = list(records.licences)
    tiles: dict[str, Value] = {
        "clips": clips,
        "length": duration(sum(float(each.sum()) for each in seconds.values())),
        "captions": records.captions,
        "rejected clips": sum(drop.kind == "rejected" for drop in manifest.dropped),
        "on disk": f"{sum(shard.bytes for shard in manifest.shards) / 2**20:,.1f} MiB",
        "licence": licences[0] if len(licences) == 1 and len(licences[0]) <= 16 else "see below",
    }
    page.add_heading("Overview").add_facts(tiles)
    rows: Rows = []
    for split, dataset in splits.items():
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
    # A few clips that are very long would press all others into the first bin.
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
        with page.folded(f"{len(rows):,} × {kind}"):
            page.add_table(["source", "reason"], rows)


def _source(page: Page, manifest: Manifest, records: Records) -> None:
    page.add_heading("Source and licences")
    page.add_table(
        ["licence", "clips"],
        [[name or "none stated", count] for name, count in records.licences.most_common()],
    )
    if manifest.credits:
        page.add_subheading("Credits").add_list(manifest.credits)
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
            with page.folded(title):
                page.add_table(["option", "value"], rows)
