"""Stages that convert a real source: one kind per converter, its options those of the converter."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from motionloom.datasets.base.register import declare
from motionloom.datasets.convert.captions.options import digest_of
from motionloom.datasets.convert.common.config import ConvertConfig
from motionloom.datasets.convert.common.conversion import run_conversion
from motionloom.datasets.convert.common.converter import CONVERTERS, AnyConverter
from motionloom.datasets.convert.registry import names, prepare
from motionloom.datasets.shards.options import Part
from motionloom.pipeline.contract.stage import NotThereError, StageConfig, StageContext, register
from motionloom.pipeline.stages.data.data import DataStage, say_shards
from motionloom.pipeline.store.data import SHARDS


def _stage_config(kind: type[AnyConverter]) -> type[StageConfig]:
    """A class that stands in this module, so that worker processes of a conversion can unpickle it."""
    name = f"{kind.__name__}StageConfig"
    bases = (kind.config_class, StageConfig)
    stage_config = type(name, bases, {"__doc__": kind.summary, "__module__": __name__})
    globals()[name] = stage_config
    return stage_config


class ConvertStage(DataStage):
    """Shards converted from a source."""

    parts = True

    def __init__(self, converter: type[AnyConverter]) -> None:
        summary = f"shards from {converter.title}"
        super().__init__(converter.name, summary, _stage_config(converter), self.convert)
        self.converter = converter

    def modules(self, config: Any) -> Iterable[str]:
        return [*super().modules(config), *(base.__module__ for base in self.converter.__mro__)]

    def external(self, config: ConvertConfig) -> dict[str, Any]:
        return source_facts(config)

    def convert(self, context: StageContext) -> None:
        """Convert the source into the stage's folder."""
        out = context.folder / SHARDS
        workers = context.hardware.convert_workers
        part = context.hardware.part
        shown = not context.console.quiet
        conversion = prepare(
            context.config, kind=self.converter, out=out, workers=workers, progress=shown, write=True
        )
        manifest = run_conversion(
            conversion,
            out,
            workers=workers,
            progress=shown,
            part=None if part is None else Part.parse(part),
            say=lambda line: context.console.print(f"    {line}", markup=False, soft_wrap=True),
        )
        say_shards(context, manifest)
        if conversion.plan.words.summary:
            context.console.print(
                f"    {conversion.plan.words.summary}", markup=False, highlight=False, soft_wrap=True
            )


def source_facts(config: ConvertConfig) -> dict[str, Any]:
    """Names and sizes of the source's files; checksums of the files, and folders of text files, that options
    name."""
    source = config.source
    if not source.exists():
        raise NotThereError(f"{source}: no such folder of a source", "source")
    listed = sorted(source.rglob("*")) if source.is_dir() else [source]
    files = {p.relative_to(source).as_posix(): p.stat().st_size for p in listed if p.is_file()}
    steering: dict[str, str | list[str]] = {}
    for name in type(config).model_fields:
        value = getattr(config, name)
        places = [one for one in (value if isinstance(value, tuple) else [value]) if isinstance(one, Path)]
        digests = list(filter(None, map(digest_of, places))) if name != "source" else []
        if digests:
            steering[name] = digests[0] if len(digests) == 1 else digests
    return {"files": files, "steering": steering}


def open_kind(name: str) -> None:
    """Import a converter, which registers the kind of its stage, too."""
    CONVERTERS[name]


CONVERTERS.follow(lambda kind: register(ConvertStage(kind)))
declare("stage kind", dict.fromkeys(names(), f"{__name__}:{open_kind.__name__}"))
