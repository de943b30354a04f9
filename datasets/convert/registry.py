"""The converters by name: every folder here whose `convert.py` holds a `Converter`, every file in `sets/`."""

from __future__ import annotations

import importlib
import pkgutil
from pathlib import Path
from typing import Any

from motionloom.datasets import convert as _folder
from motionloom.datasets.convert import sets as _sets
from motionloom.datasets.convert.common.config import ConvertConfig
from motionloom.datasets.convert.common.conversion import SCAN_FILE, Conversion
from motionloom.datasets.convert.common.converter import AnyConverter, Converter, PlanSettings
from motionloom.datasets.schema import UserError

_HELPERS = ("captions", "common", "sets")


def names() -> list[str]:
    """Names of the converters, which are those of their folders or files."""
    folders = [entry.name for entry in pkgutil.iter_modules(_folder.__path__) if entry.ispkg]
    return sorted({*folders, *_set_files()} - set(_HELPERS))


def _set_files() -> list[str]:
    return [entry.name for entry in pkgutil.iter_modules(_sets.__path__) if not entry.ispkg]


def converter_named(name: str) -> type[AnyConverter]:
    """The converter of a folder or file, imported when it is asked for, so that `--help` stays quick."""
    if name not in names():
        raise UserError(f"unknown converter '{name}'; known: {', '.join(names())}")
    place = f"{_sets.__name__}.{name}" if name in _set_files() else f"{_folder.__name__}.{name}.convert"
    module = importlib.import_module(place)
    return next(
        kind
        for kind in vars(module).values()
        if isinstance(kind, type) and issubclass(kind, Converter) and kind.__module__ == module.__name__
    )


def converters() -> list[type[AnyConverter]]:
    """All converters, in the order of their names."""
    return [converter_named(name) for name in names()]


def prepare(
    config: ConvertConfig,
    *,
    out: Path | None = None,
    maps: Path | None = None,
    workers: int = 1,
    progress: bool = False,
) -> Conversion[Any]:
    """Look at the whole source and decide what becomes of every file; nothing is converted yet.

    `config` is a converter's and decides which one. With `out`, the folder of the shards, a source whose
    listing must read every file (archives) is read once and not again by the next run or by the other parts
    of a conversion. Joint maps that are guessed are written into `maps`, by default `out`.
    """
    fits = [kind for kind in converters() if isinstance(config, kind.config_class)]
    kind = max(
        fits, key=lambda kind: len(kind.config_class.__mro__)
    )  # a set's own before the one it is made of
    converter = kind(config)
    scan = None if out is None else out / SCAN_FILE
    return Conversion(converter, converter.plan(PlanSettings(workers, progress, scan, maps or out)))
