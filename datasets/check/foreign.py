"""Tar shards written by other tools: no manifest, no index, any member names. What would a reader get?

`tarfile` and WebDataset read many broken tars without a word: a cut file loses its last samples, a key whose
members do not stand together becomes two incomplete samples, a key that comes again is trained on twice.
Here every entry is looked at; nothing is extracted or unpickled, no name is used as a path, no link is
followed. Only one shard's directory and one member are in memory.

A sample is what WebDataset takes for one: neighbours with the same name up to the first dot of the last path
part. It needs `motion.npy` ([T, D] floats) and `json` or `meta.json`.
"""

from __future__ import annotations

import hashlib
import io
import json
import tarfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.lib import format as npy_format

from motionloom.datasets.check.ranges import ABSURD, beyond, human_limits
from motionloom.datasets.motion.layout import MotionLayout

BLOCK = tarfile.BLOCKSIZE
_MOTION = "motion.npy"
_META = ("json", "meta.json")
_PACKED = {
    b"\x1f\x8b": "gzip",
    b"\xfd7zXZ": "xz",
    b"BZh": "bzip2",
    b"PK\x03\x04": "zip",
    b"\x28\xb5\x2f\xfd": "zstd",
}


@dataclass
class TarReport:
    """`samples` are the whole ones; `problems` make the shard unfit, `notes` do not."""

    samples: int = 0
    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@dataclass
class _Group:
    key: str
    members: dict[str, tuple[int, int]] = field(default_factory=dict)
    whole: bool = True


def inspect_tar(path: Path, layout: MotionLayout | None = None) -> TarReport:
    """Look at every entry of a tar without trusting it. `layout` also asks for its width and ranges."""
    report = TarReport()
    size = path.stat().st_size
    if size == 0:
        report.problems.append("empty file, 0 bytes: an interrupted download or write")
        return report
    groups: list[_Group] = []
    try:
        with tarfile.open(path, mode="r:") as archive:
            end = _read_directory(archive, size, groups, report)
    except (tarfile.TarError, EOFError, OSError, ValueError) as error:
        report.problems.append(_unreadable(path, error))
        return report
    with path.open("rb") as file:
        if end is not None:
            _check_end(file, end, size, groups, report)
        _check_order(groups, report)
        motions: Counter[bytes] = Counter()
        for group in groups:
            problems = list(_sample_problems(file, group, layout, motions))
            report.problems += problems
            report.samples += not problems and group.whole
    if not groups and not report.problems:
        report.problems.append("holds no samples")
    if sum(motions.values()) > len(motions):
        twice = sum(motions.values()) - len(motions)
        report.notes.append(f"{twice} of {sum(motions.values())} motions repeat another sample's")
    return report


def _read_directory(
    archive: tarfile.TarFile, size: int, groups: list[_Group], report: TarReport
) -> int | None:
    """Fill `groups`; returns the byte after the last entry, or None when the file is cut inside one."""
    end = 0
    for info in archive:
        end = info.offset_data + -(-info.size // BLOCK) * BLOCK if info.isreg() else info.offset_data
        refusal = _refusal(info)
        if refusal:
            report.problems.append(f"'{info.name}' {refusal}")
            continue
        folder, _, name = info.name.rpartition("/")
        stem, dot, member = name.partition(".")
        if not dot or not stem:
            report.notes.append(f"'{info.name}' belongs to no sample")
            continue
        key = f"{folder}/{stem}" if folder else stem
        if not groups or groups[-1].key != key:
            groups.append(_Group(key))
        if info.offset_data + info.size > size:
            found = max(0, size - info.offset_data)
            cut = f"truncated inside '{info.name}' ({found} of {info.size} bytes are there)"
            _cut(groups, cut, report)
            return None
        if member in groups[-1].members:
            report.problems.append(f"'{info.name}' appears twice in one sample: duplicate member")
            continue
        groups[-1].members[member] = (info.offset_data, info.size)
    return end


def _cut(groups: list[_Group], how: str, report: TarReport) -> None:
    last = f"the last whole key is '{groups[-2].key}'" if len(groups) > 1 else "no key is whole"
    report.problems.append(f"{how}; {last}")
    groups[-1].whole = False


def _refusal(info: tarfile.TarInfo) -> str:
    """Why an entry is not a plain file with a harmless name; empty when it is."""
    parts = info.name.split("/")
    if info.name.startswith("/") or ".." in parts or ":" in parts[0] or {"\\", "\0"} & set(info.name):
        return "is a path that leaves the shard (path traversal); shards hold plain relative names"
    if info.issym() or info.islnk():
        return f"is a link to '{info.linkname}', which is never followed; shards hold plain files"
    if not info.isreg():
        return "is a folder or device; shards hold plain files"
    return ""


def _check_end(file: BinaryIO, end: int, size: int, groups: list[_Group], report: TarReport) -> None:
    """A tar ends with two zero blocks. Data after them, or damage, would be skipped in silence."""
    file.seek(end)
    while block := file.read(1 << 20):
        if block.count(0) != len(block):
            report.problems.append(
                f"the data after byte {end} are no tar entries: damaged, or two archives in one file"
            )
            return
    if size - end >= 2 * BLOCK:
        return
    if groups and _missing(groups[-1]):
        has, lacks = ", ".join(groups[-1].members), " and ".join(_missing(groups[-1]))
        _cut(groups, f"truncated: ends after '{groups[-1].key}' has {has} but no {lacks}", report)
    else:
        report.notes.append("the two closing zero blocks are missing; every member is whole")


def _check_order(groups: list[_Group], report: TarReport) -> None:
    first: dict[str, _Group] = {}
    for group in groups:
        before = first.setdefault(group.key, group)
        if before is group:
            continue
        if before.members.keys() & group.members.keys():
            report.problems.append(f"duplicate key '{group.key}': it comes again after other samples")
        else:
            report.problems.append(
                f"the members of key '{group.key}' do not stand together: readers see two incomplete samples"
            )


def _missing(group: _Group) -> list[str]:
    missing = [] if _MOTION in group.members else [_MOTION]
    return missing if any(name in group.members for name in _META) else [*missing, _META[0]]


def _sample_problems(
    file: BinaryIO, group: _Group, layout: MotionLayout | None, motions: Counter[bytes]
) -> Iterator[str]:
    if not group.whole:
        return
    missing = _missing(group)
    if missing:
        yield f"key '{group.key}' has no {' and no '.join(missing)}: missing field"
    for name, (start, size) in group.members.items():
        file.seek(start)
        if name.endswith("json"):
            try:
                json.loads(file.read(size))
            except (ValueError, RecursionError) as error:
                yield f"'{group.key}.{name}' is not valid JSON ({error})"
        elif name.endswith("npy"):
            raw = file.read(size)
            yield from _array_problems(f"'{group.key}.{name}'", raw, name == _MOTION, layout)
            if name == _MOTION:
                motions[hashlib.blake2b(raw, digest_size=16).digest()] += 1


def _array_problems(where: str, raw: bytes, motion: bool, layout: MotionLayout | None) -> Iterator[str]:
    try:
        values = npy_format.read_array(io.BytesIO(raw), allow_pickle=False)
    except Exception as error:  # numpy's parser fails in many ways on broken bytes
        yield f"{where} is not a readable array ({' '.join(str(error).split())[:120]})"
        return
    if not motion:
        if values.dtype.kind in "fc" and not np.isfinite(values).all():
            yield f"{where} holds NaN or infinity"
        return
    if values.dtype.kind != "f" or values.ndim != 2 or not len(values):
        yield f"{where} is {values.dtype} {list(values.shape)}, wanted floats [T >= 1, D]"
    elif not np.isfinite(values).all():
        frame, column = np.argwhere(~np.isfinite(values))[0]
        yield f"{where}: {values[frame, column]} at frame {frame}, column {column}"
    elif layout is not None and values.shape[1] != layout.dim:
        yield f"{where} has {values.shape[1]} columns, layout {layout.name} has {layout.dim}"
    elif layout is not None and (absurd := beyond(values, layout, human_limits(layout), ABSURD)):
        yield f"{where}: {absurd}: a wrong unit, scale or layout"


def _unreadable(path: Path, error: Exception) -> str:
    with path.open("rb") as file:
        start = file.read(4)
    packed = next((name for magic, name in _PACKED.items() if start.startswith(magic)), None)
    if packed:
        return f"not a tar but {packed} data; unpack it to a plain .tar first"
    return f"not a tar file ({error})"
