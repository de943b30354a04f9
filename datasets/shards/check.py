"""`check`: read a whole dataset as a stranger would and list everything wrong with it.

Checked: manifest and index present and consistent, no stray or missing shard, size and sha256, tar structure,
every member's schema, motion width and finiteness, and ids that appear twice or in two splits (a mirrored
clip counts as its original, or the test split leaks into training).
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import BinaryIO

import numpy as np
from rich.progress import track

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import ClipMeta, Manifest, ShardInfo, Split, UserError
from motionloom.datasets.shards.files import sha256_of
from motionloom.datasets.shards.index import (
    INDEX_FILE,
    SPLITS,
    ShardIndex,
    SplitIndex,
    clip_entries,
    index_path,
    load_index,
)
from motionloom.datasets.shards.reader import load_manifest, manifest_layout
from motionloom.datasets.shards.sample import captions_from_json, require_finite
from motionloom.datasets.shards.tar import TarClip, read_npy_header, scan_tar


@dataclass(frozen=True)
class Problem:
    """One thing wrong: `where` names a file, and a key where there is one."""

    where: str
    message: str

    def __str__(self) -> str:
        return f"{self.where}: {self.message}"


def check(root: Path, *, progress: bool = False) -> list[Problem]:
    """Everything wrong with the dataset in `root`; an empty list when it is sound."""
    try:
        manifest = load_manifest(root)
        layout = manifest_layout(manifest)
    except UserError as error:
        return [Problem(str(root), str(error))]
    problems = list(_stray_files(root, manifest))
    homes: dict[str, tuple[str, str]] = {}
    originals: list[tuple[str, str, str]] = []
    for shard in track(manifest.shards, "checking shards", disable=not progress):
        try:
            for clip, meta in _checked_clips(root / shard.name, shard, layout, problems):
                where = f"{shard.name}: '{clip.key}'"
                if meta.id in homes:
                    other, split = homes[meta.id]
                    kind = "also" if split == shard.split else f"of split '{split}' also"
                    problems.append(Problem(where, f"id '{meta.id}' is {kind} {other}"))
                homes.setdefault(meta.id, (where, shard.split))
                if meta.mirror_of is not None:
                    originals.append((where, shard.split, meta.mirror_of))
        except UserError as error:
            problems.append(Problem(shard.name, str(error).removeprefix(f"{root / shard.name}: ")))
    for where, here, original in originals:
        if original in homes and homes[original][1] != here:
            there = homes[original][1]
            problems.append(
                Problem(where, f"mirrors '{original}', which is in split '{there}', not '{here}'")
            )
    for split in SPLITS:
        shards = [shard for shard in manifest.shards if shard.split == split]
        if shards:
            problems += _index_problems(root, split, shards)
    return problems


def _stray_files(root: Path, manifest: Manifest) -> Iterator[Problem]:
    listed = [shard.name for shard in manifest.shards]
    for name in sorted({name for name in listed if listed.count(name) > 1}):
        yield Problem(name, "listed twice in the manifest")
    for path in sorted(root.glob("*.tar")):
        if path.name not in listed:
            yield Problem(path.name, "not in the manifest; delete it or convert again")


def _checked_clips(
    path: Path, shard: ShardInfo, layout: MotionLayout, problems: list[Problem]
) -> Iterator[tuple[TarClip, ClipMeta]]:
    """The clips of one shard whose metadata can be read; what is wrong on the way goes to `problems`."""
    if not path.exists():
        problems.append(Problem(shard.name, "the shard is missing"))
        return
    size = path.stat().st_size
    if size != shard.bytes:
        problems.append(
            Problem(shard.name, f"{size} bytes, the manifest says {shard.bytes}: truncated or changed")
        )
    elif sha256_of(path) != shard.sha256:
        problems.append(Problem(shard.name, "the sha256 is not the manifest's: damaged"))
    clips = scan_tar(path)
    if len(clips) != shard.samples:
        problems.append(Problem(shard.name, f"{len(clips)} samples, the manifest says {shard.samples}"))
    frames = 0
    with path.open("rb") as file:
        for clip in clips:
            try:
                meta = _checked_clip(file, path, clip, shard, layout)
            except (UserError, ValueError) as error:
                message = str(error).removeprefix(f"{path}: ")
                problems.append(Problem(f"{shard.name}: '{clip.key}'", message))
                continue
            frames += meta.frames
            yield clip, meta
    if frames != shard.frames:
        problems.append(Problem(shard.name, f"{frames} sound frames, the manifest says {shard.frames}"))


def _checked_clip(
    file: BinaryIO, path: Path, clip: TarClip, shard: ShardInfo, layout: MotionLayout
) -> ClipMeta:
    """The metadata of one clip after reading all its members; raises at the first thing wrong."""

    def member(name: str) -> bytes:
        start, size = clip.members[name]
        file.seek(start)
        return file.read(size)

    where = f"{path}: '{clip.key}.meta.json'"
    meta = ClipMeta.parse(json.loads(member("meta.json")), where)
    stated = (meta.layout, meta.family, meta.fps, meta.skeleton, meta.split)
    wanted = (layout.name, layout.family, layout.fps, layout.skeleton_name, shard.split)
    if stated != wanted:
        raise ValueError(f"meta.json says layout, family, fps, skeleton, split = {stated}, not {wanted}")
    motion = _array(member("motion.npy"), f"{path}: '{clip.key}.motion.npy'")
    if motion.shape != (meta.frames, layout.dim):
        raise ValueError(f"motion.npy is {list(motion.shape)}, wanted {[meta.frames, layout.dim]}")
    require_finite("motion.npy", motion)
    for name in ("texts.json", "face_texts.json"):
        if name in clip.members:
            captions_from_json(member(name), f"{path}: '{clip.key}.{name}'")
    if "audio.npy" in clip.members:
        require_finite("audio.npy", _array(member("audio.npy"), f"{path}: '{clip.key}.audio.npy'"))
    return meta


def _array(raw: bytes, where: str) -> np.ndarray:
    header = read_npy_header(io.BytesIO(raw), where)
    if header.data + int(np.prod(header.shape)) * header.dtype.itemsize != len(raw):
        raise UserError(f"{where}: the array is cut short or too long")
    return np.frombuffer(raw, header.dtype, offset=header.data).reshape(header.shape)


def _index_problems(root: Path, split: Split, shards: list[ShardInfo]) -> list[Problem]:
    """Whether both indices say what the tars say."""
    problems = []
    built = []
    for shard in shards:
        path = root / shard.name
        try:
            stored = ShardIndex.load_json(index_path(path))
            entries = clip_entries(path, [clip.id for clip in stored.clips])
        except (UserError, OSError, ValueError) as error:
            problems.append(Problem(index_path(path).name, f"does not fit its tar: {error}"))
            continue
        if stored.shard != shard or stored.clips != entries:
            problems.append(Problem(index_path(path).name, "other contents than the tar or the manifest"))
        built.append(stored)
    if problems:
        return problems
    try:
        flat = load_index(root, split, shards)
    except UserError as error:
        return [Problem(INDEX_FILE, str(error))]
    rebuilt = SplitIndex.build(built)
    if any(
        not np.array_equal(getattr(flat, field.name), getattr(rebuilt, field.name)) for field in fields(flat)
    ):
        problems.append(
            Problem(INDEX_FILE, f"split '{split}' says something else than the shards' own indices")
        )
    return problems
