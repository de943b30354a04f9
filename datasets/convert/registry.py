"""The converters by name: every folder here whose `convert.py` holds a `Converter`, every file in `sets/`,
and those that other packages have registered.
"""

from __future__ import annotations

import importlib
import pkgutil
from pathlib import Path
from typing import Any

from motionloom.datasets import convert as _folder
from motionloom.datasets.convert import sets as _sets
from motionloom.datasets.convert.common.config import ConvertConfig
from motionloom.datasets.convert.common.conversion import Conversion, moved_clips
from motionloom.datasets.convert.common.converter import CONVERTERS, AnyConverter, Converter, PlanSettings
from motionloom.datasets.convert.common.removed import Removed
from motionloom.datasets.schema import REMOVED_FILE, UserError

_HELPERS = ("captions", "common", "sets")


def names() -> list[str]:
    """Names of the converters; ours are those of their folders or files."""
    return sorted({*_own(), *CONVERTERS})


def _own() -> set[str]:
    folders = [entry.name for entry in pkgutil.iter_modules(_folder.__path__) if entry.ispkg]
    return {*folders, *_set_files()} - set(_HELPERS)


def _set_files() -> list[str]:
    return [entry.name for entry in pkgutil.iter_modules(_sets.__path__) if not entry.ispkg]


def converter_named(name: str) -> type[AnyConverter]:
    """The converter of a name; ours are imported when they are asked for, so that `--help` stays quick."""
    if name in CONVERTERS:
        return CONVERTERS[name]
    if name not in _own():
        raise UserError(f"unknown converter '{name}'; known: {', '.join(names())}")
    place = f"{_sets.__name__}.{name}" if name in _set_files() else f"{_folder.__name__}.{name}.convert"
    module = importlib.import_module(place)
    return next(
        kind
        for kind in vars(module).values()
        if isinstance(kind, type) and issubclass(kind, Converter) and kind.__module__ == module.__name__
    )


def _require_new(kind: type[AnyConverter]) -> None:
    if kind.name in _own() and not kind.__module__.startswith(_folder.__name__):
        raise UserError(f"converter '{kind.name}': another one has this name; choose a new one")


CONVERTERS.follow(_require_new)


def converters() -> list[type[AnyConverter]]:
    """All converters, in the order of their names."""
    return [converter_named(name) for name in names()]


def prepare(
    config: ConvertConfig,
    *,
    kind: type[AnyConverter] | None = None,
    out: Path | None = None,
    workers: int = 1,
    progress: bool = False,
) -> Conversion[Any]:
    """Look at the whole source and decide what becomes of every file; nothing is converted yet.

    `kind` is the converter, by default the one whose config it is. Joint maps that are guessed are written
    into `out`, the folder of the shards.
    """
    kind = kind or next((one for one in converters() if one.config_class is type(config)), None)
    if kind is None:
        raise UserError(f"no converter takes a {type(config).__name__}; register its converter, or name it")
    converter = kind(config)
    plan = converter.plan(settings := PlanSettings(workers, progress, out))
    if out is None:
        return Conversion(converter, plan, settings)
    plan.leave_removed(Removed.of(out).has, REMOVED_FILE)
    return Conversion(converter, plan, settings, moved_clips(out, plan))
