"""Small file helpers: nothing is ever half-written under its final name."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from motionloom.datasets.schema import UserError


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; rename it into place only if the block ends well."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        yield temporary
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def require_folder(folder: Path) -> None:
    """Refuse a place for files that is a file, or lies below one; nothing is made yet."""
    there = next((place for place in (folder, *folder.parents) if place.exists()), folder)
    if there.exists() and not there.is_dir():
        raise UserError(f"{there}: is a file, and a folder is needed here; choose another name")


def require_file_place(path: Path) -> None:
    """Refuse a name for a file that is a folder, or lies below a file; nothing is made yet."""
    if path.is_dir():
        raise UserError(f"{path}: is a folder; name a file, like {path / 'NAME'}")
    require_folder(path.parent)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, data: Any) -> None:
    """Write JSON atomically, keys sorted, so that equal data gives equal bytes."""
    write_text(path, json.dumps(data, indent=1, sort_keys=True, ensure_ascii=False) + "\n")


def sha256_file(path: Path) -> str:
    """Checksum of one file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest(data: Any) -> str:
    """Checksum of plain JSON data."""
    text = json.dumps(data, sort_keys=True, ensure_ascii=False, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def remove_tree(folder: Path) -> None:
    """Delete a folder so that a kill midway never leaves it looking whole: rename first, then delete."""
    doomed = folder.with_name(f".{folder.name}.removed")
    shutil.rmtree(doomed, ignore_errors=True)  # left by a run that was killed here
    if folder.exists():
        folder.rename(doomed)
        shutil.rmtree(doomed)


def copy_files(source: Path, target: Path, names: Iterable[str]) -> None:
    """Copy named files of one folder into another, which is made."""
    target.mkdir(parents=True, exist_ok=True)
    for name in names:
        shutil.copyfile(source / name, target / name)
