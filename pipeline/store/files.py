"""Files and folders of a run: where they may be made, in which form, and how a folder is taken away."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np

from motionloom.datasets.base import files
from motionloom.datasets.base.config import require_local
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import temporary_folder
from motionloom.datasets.base.json_doors import read_plain
from motionloom.datasets.base.lock import file_lock
from motionloom.datasets.motion.npz import map_npy


def require_folder(folder: Path) -> None:
    """Refuse an output folder that is a file, is below one, or is a URL; creates nothing."""
    require_local(folder)
    existing = next((place for place in (folder, *folder.parents) if place.exists()), folder)
    if existing.exists() and not existing.is_dir():
        raise UserError(f"{existing}: is a file, and a folder is needed here; choose another name")


def require_file_place(path: Path, ending: str) -> None:
    """Refuse an output file that is a folder or below a file, or whose name ends in another way, as that of a
    shard or a recording does, which it would take the place of; creates nothing."""
    if path.is_dir():
        raise UserError(f"{path}: is a folder; name a file, like {path / f'NAME{ending}'}")
    if path.suffix.lower() != ending and (path.is_file() or not path.exists()):  # a pipe takes anything
        raise UserError(f"{path}: name a file that ends in {ending}, as what is written does")
    require_folder(path.parent)


def write_json(path: Path, data: object) -> None:
    """Write a record of a run atomically, keys sorted; a figure that is not finite is written as `NaN`."""
    files.write_json(path, data, sort_keys=True, allow_nan=True)


def read_record(path: Path) -> dict[str, object]:
    """A JSON object that a run keeps; a `UserError` names the file."""
    try:
        data = json.loads(read_plain(path))
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); run its stage again") from None
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: not valid JSON ({error}); run its stage again") from None
    if not isinstance(data, dict):
        raise UserError(f"{path}: holds no JSON object; run its stage again")
    return data


def fingerprint_of(data: object) -> str:
    """Fingerprint of settings and inputs: sha256 of plain JSON data, hex.

    Kept apart from `sha256_of_json`: it goes by the characters, not their escapes, and finished runs hold it.
    """
    text = json.dumps(data, sort_keys=True, ensure_ascii=False, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def remove_tree(folder: Path) -> None:
    """Delete a folder so that a kill midway never leaves it looking whole: rename first, then delete."""
    doomed = folder.with_name(f".{folder.name}.removed")
    shutil.rmtree(doomed, ignore_errors=True)  # left by a run that was killed here
    if folder.exists():
        folder.rename(doomed)
        shutil.rmtree(doomed)


@contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """A folder to fill; it becomes `folder`, which is absent or empty before, when the block ends whole."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with _aside(folder, folder.parent) as temporary:
        yield temporary
        temporary.rename(folder)


def made_once(folder: Path, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Arrays that the first process makes and writes while the others of the run wait; all map them. Where
    nothing can be written, each has its own.
    """
    try:
        folder.parent.mkdir(exist_ok=True)
        with file_lock(folder.with_name(".lock")):
            if not folder.is_dir():
                with new_folder(folder) as new:
                    for name, values in make().items():
                        np.save(new / f"{name}.npy", values, allow_pickle=False)
    except OSError:
        return make()
    return {path.stem: map_npy(path) for path in folder.glob("*.npy")}


@contextmanager
def new_files(folder: Path) -> Iterator[Path]:
    """A folder to fill; its files go into `folder`, which may hold others, when the block ends whole."""
    folder.mkdir(parents=True, exist_ok=True)
    with _aside(folder, folder) as temporary:
        yield temporary
        for path in sorted(temporary.iterdir()):
            path.replace(folder / path.name)


@contextmanager
def _aside(folder: Path, place: Path) -> Iterator[Path]:
    """A temporary folder in `place`; errors about what is in it name `folder`."""
    with temporary_folder(place, folder.name) as temporary:
        try:
            yield temporary
        except OSError as error:
            for side in ("filename", "filename2"):
                name = getattr(error, side)
                if name is not None and str(name).startswith(str(temporary)):
                    setattr(error, side, str(name).replace(str(temporary), str(folder), 1))
            raise
        except UserError as error:
            if str(temporary) not in str(error):
                raise
            raise UserError(str(error).replace(str(temporary), str(folder))) from None


def open_own(path: Path, mode: str) -> IO[Any]:
    """Open a file of a run for writing; a link in its place is not followed."""
    path.parent.mkdir(parents=True, exist_ok=True)

    def opener(name: str, flags: int) -> int:
        return os.open(name, flags | os.O_NOFOLLOW, 0o666)

    if "b" in mode:
        return open(path, mode, buffering=0, opener=opener)
    return open(path, mode, encoding="utf-8", opener=opener)


def copy_files(source: Path, target: Path, names: Iterable[str]) -> None:
    """Copy named files of one folder into another, which is made."""
    target.mkdir(parents=True, exist_ok=True)
    for name in names:
        shutil.copyfile(source / name, target / name)
