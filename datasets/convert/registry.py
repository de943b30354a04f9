"""The converters by name: those of the papers' data sets, and those that other packages have registered."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from motionloom.datasets.base.config import require_local
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.memory import remembering
from motionloom.datasets.base.records import REMOVED_FILE
from motionloom.datasets.base.register import declare, discover
from motionloom.datasets.convert.common.config import ConvertConfig
from motionloom.datasets.convert.common.conversion import Conversion, moved_clips
from motionloom.datasets.convert.common.converter import CONVERTERS, AnyConverter, PlanSettings
from motionloom.datasets.convert.common.files import walk
from motionloom.datasets.convert.common.removed import Removed

declare(
    "converter",
    {
        name: f"motionloom.datasets.convert.{name}.convert"
        for name in ("aistpp", "bvh", "humanml3d", "motionx")
    },
)


SOURCES_FILE = ".sources.json"
"""Beside the shards: what was read of the source's files."""


def names() -> list[str]:
    """Names of the converters, sorted, those of other packages included."""
    discover()
    return sorted(CONVERTERS)


def converter_named(name: str) -> type[AnyConverter]:
    """The converter of a name, which is imported when it is asked for, so that `--help` stays quick."""
    if name not in names():
        raise UserError(f"unknown converter '{name}'; known: {', '.join(names())}")
    return CONVERTERS[name]


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
    write: bool = False,
) -> Conversion[Any]:
    """Look at the whole source and decide what becomes of every file; nothing is converted yet.

    `kind` is the converter, by default the one whose config it is. Joint maps that are guessed are written
    into `out`, the folder of the shards. With `write`, for a plan that is carried out, what files say and
    their checksums are noted there: parts, and later conversions, read what has changed.
    """
    if write and out is not None and config.source.exists():
        require_local(out)
        with remembering(out / SOURCES_FILE):
            conversion = prepare(config, kind=kind, out=out, workers=workers, progress=progress)
            assert conversion.options
            return conversion
    kind = kind or next((one for one in converters() if one.config_class is type(config)), None)
    if kind is None:
        raise UserError(f"no converter takes a {type(config).__name__}; register its converter, or name it")
    converter = kind(config)
    plan = converter.plan(settings := PlanSettings(workers, progress, out))
    if config.source.is_dir():
        plan.account(walk(config.source, skip=out), converter.beside)
    if out is None:
        return Conversion(converter, plan, settings)
    plan.leave_removed(Removed.of(out).has, REMOVED_FILE)
    return Conversion(converter, plan, settings, moved_clips(out, plan))
