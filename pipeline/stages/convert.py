"""Stages that convert a real source: one kind per converter, its options those of the converter."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from motionloom.datasets.base.files import sha256_of
from motionloom.datasets.convert.aistpp.convert import AistppConfig
from motionloom.datasets.convert.amass.convert import AmassConfig
from motionloom.datasets.convert.bvh.convert import BvhConfig
from motionloom.datasets.convert.common.caption_options import digest_of
from motionloom.datasets.convert.common.config import ConvertConfig
from motionloom.datasets.convert.common.conversion import run_conversion
from motionloom.datasets.convert.humanml3d.convert import HumanMl3dConfig
from motionloom.datasets.convert.motionx.convert import MotionXConfig
from motionloom.datasets.convert.table import converter_named
from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.stage import StageConfig, StageContext
from motionloom.pipeline.stages.data import DataStage, say_shards
from motionloom.pipeline.store.data import SHARDS


class HumanMl3dStageConfig(HumanMl3dConfig, StageConfig):
    """HumanML3D as its authors publish it."""


class MotionXStageConfig(MotionXConfig, StageConfig):
    """Motion-X as its authors publish it."""


class AistppStageConfig(AistppConfig, StageConfig):
    """AIST++ dances and their music."""


class AmassStageConfig(AmassConfig, StageConfig):
    """AMASS archives, captioned by an index or by captions of your own."""


class BvhStageConfig(BvhConfig, StageConfig):
    """A folder of captioned BVH files."""


CONVERTED: dict[str, tuple[str, type[StageConfig]]] = {
    "humanml3d": ("HumanML3D", HumanMl3dStageConfig),
    "motionx": ("Motion-X", MotionXStageConfig),
    "aistpp": ("AIST++", AistppStageConfig),
    "amass": ("AMASS", AmassStageConfig),
    "bvh": ("BVH", BvhStageConfig),
}
"""Stage kind, which is also the converter's name, -> (the source's name, config)."""


class ConvertStage(DataStage):
    """Shards converted from a source."""

    def external(self, config: ConvertConfig) -> dict[str, Any]:
        """The source's files."""
        return source_facts(config)


def run_convert(context: StageContext) -> None:
    """Convert the source into the stage's folder."""
    out = context.folder / SHARDS
    workers = context.hardware.convert_workers
    kind = next(name for name, (_, config) in CONVERTED.items() if isinstance(context.config, config))
    shown = not context.console.quiet
    conversion = converter_named(kind).prepare(context.config, out=out, workers=workers, progress=shown)
    manifest = run_conversion(
        conversion,
        out,
        workers=workers,
        progress=shown,
        say=lambda line: context.console.print(f"    {line}", markup=False, soft_wrap=True),
    )
    say_shards(context, manifest)
    if conversion.plan.captions:
        context.console.print(
            f"    {conversion.plan.captions}", markup=False, highlight=False, soft_wrap=True
        )


def source_facts(config: ConvertConfig) -> dict[str, Any]:
    """Names and sizes of the source's files; checksums of the files, and folders of text files, that options
    name."""
    source = Path(config.source).expanduser()
    if not source.exists():
        raise UserError(f"{source}: no such folder (the source; set it with --set data.source=FOLDER)")
    listed = sorted(source.rglob("*")) if source.is_dir() else [source]
    files = {p.relative_to(source).as_posix(): p.stat().st_size for p in listed if p.is_file()}
    steering = {}
    for name in type(config).model_fields:
        path = getattr(config, name)
        if name == "source" or not isinstance(path, Path):
            continue
        path = path.expanduser()
        if path.is_file():
            steering[name] = sha256_of(path)
        elif path.is_dir() and any(path.rglob("*.txt")):  # captions and split files
            steering[name] = digest_of(path)["sha256"]
    return {"files": files, "steering": steering}
