"""Columns that were added beside the shards, checked: bytes, keys, values."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import State, sha256_of, state_of
from motionloom.datasets.base.json_doors import open_plain
from motionloom.datasets.base.records import INDEX_FILE, Column, Manifest, ShardInfo
from motionloom.datasets.check.clip import check_value, read_member
from motionloom.datasets.check.findings import Findings
from motionloom.datasets.shards.checksums import LocalShard, require_intact
from motionloom.datasets.shards.index import ClipEntry, ShardIndex, index_path
from motionloom.datasets.shards.tar import scan_tar


def check_columns(
    root: Path, manifest: Manifest, findings: Findings, states: dict[str, State]
) -> frozenset[str]:
    """Check all columns, and note the states of their files; return the keys of clips that they caption."""
    captioned: set[str] = set()
    for column in manifest.columns:
        index = column.file(INDEX_FILE)
        states |= {name: state_of(root / name) for name in (index, *(tar.name for tar in column.shards))}
        if not states[index] or sha256_of(root / index) != column.index:
            findings.error("column", index, "gone or changed; remove the column, and add it again")
        if column.gone:
            findings.warn("column", column.name, f"{column.gone:,} of its values are of no clip")
    for number, shard in enumerate(manifest.shards if manifest.columns else ()):
        try:
            clips = ShardIndex.load_json(index_path(root / shard.name)).clips
        except UserError:  # which is said of the shard
            continue
        for column in manifest.columns:
            tar = column.shards[number]
            try:
                captioned |= _check_tar(root, column, tar, clips, manifest.fps, findings)
            except (UserError, ValueError, OSError) as error:
                findings.error("column", tar.name, str(error).removeprefix(f"{root / tar.name}: "))
    return frozenset(captioned)


def _check_tar(
    root: Path, column: Column, tar: ShardInfo, clips: Sequence[ClipEntry], fps: float, findings: Findings
) -> set[str]:
    """Raises for what cannot be used; returns the keys of clips that get captions by it."""
    path = root / tar.name
    require_intact(LocalShard(path, tar))
    found = scan_tar(path, most=tar.samples, column=column.member)
    if [one.key for one in found] != [clip.key for clip in clips]:
        raise UserError("its keys are not those of its shard; remove the column, and add it again")
    captioned = set()
    with open_plain(path) as file:
        for clip, place in zip(clips, found, strict=True):
            raw = read_member(file, place, column.member)
            for kind, message in check_value(f"{clip.key}.{column.member}", raw, clip.frames / fps):
                findings.warn(kind, tar.name, message)
            if column.feeds("texts.json") and raw != b"[]":
                captioned.add(clip.key)
    return captioned
