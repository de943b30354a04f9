"""Stages that bring shards: synthesise them, convert a BVH folder, or take those that exist."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from motionloom.datasets.convert.bvh import BvhConfig, convert_bvh
from motionloom.datasets.schema import Manifest, UserError
from motionloom.datasets.shards.check import check
from motionloom.datasets.synth.generate import SynthConfig, synthesize
from motionloom.pipeline.files import sha256_file, write_json
from motionloom.pipeline.sources import REFERENCE, SHARDS
from motionloom.pipeline.stage import StageConfig, StageContext


class SynthStageConfig(SynthConfig, StageConfig):
    """Synthetic whole-body shards."""


class BvhStageConfig(BvhConfig, StageConfig):
    """A folder of captioned BVH files."""


class ShardsStageConfig(StageConfig):
    """Shards that exist already."""

    path: str
    """Folder with `manifest.json`."""
    verify: bool = True
    """Check every checksum once, when the stage runs."""


def run_synth(context: StageContext) -> None:
    """Write synthetic shards."""
    config = context.config
    if config.seed == 0:
        config = config.model_copy(update={"seed": context.seed})
    manifest = synthesize(config, context.folder / SHARDS, workers=context.hardware.convert_workers)
    _say(context, manifest)


def run_bvh(context: StageContext) -> None:
    """Convert BVH files."""
    manifest = convert_bvh(context.config, context.folder / SHARDS, workers=context.hardware.convert_workers)
    _say(context, manifest)


def run_shards(context: StageContext) -> None:
    """Point at existing shards, after checking them."""
    root = Path(context.config.path).expanduser().resolve()
    manifest = Manifest.load_json(root / "manifest.json")
    if context.config.verify:
        problems = check(root)
        if problems:
            raise UserError(
                f"{root}: {len(problems)} problems, first: {problems[0]}; see: motionloom data check"
            )
    write_json(context.folder / REFERENCE, {"path": str(root)})
    _say(context, manifest)


def bvh_sources(config: BvhStageConfig) -> dict[str, Any]:
    """Names and sizes of the source files, checksums of the small ones that steer the conversion."""
    source = Path(config.source).expanduser()
    if not source.is_dir():
        raise UserError(f"{source}: no such folder (the BVH source; set it with --set data.source=FOLDER)")
    files = {
        p.relative_to(source).as_posix(): p.stat().st_size for p in sorted(source.rglob("*")) if p.is_file()
    }
    steering = {}
    for name in (config.joint_map, config.captions):
        if name is not None and Path(name).expanduser().is_file():
            steering[Path(name).name] = sha256_file(Path(name).expanduser())
    return {"files": files, "steering": steering}


def shards_source(config: ShardsStageConfig) -> dict[str, Any]:
    """Checksum of the manifest, which holds those of the shards."""
    path = Path(config.path).expanduser() / "manifest.json"
    if not path.is_file():
        raise UserError(f"{path}: no manifest; is this a finished shard folder?")
    return {"manifest": sha256_file(path)}


def _say(context: StageContext, manifest: Manifest) -> None:
    clips = sum(s.samples for s in manifest.shards)
    seconds = sum(s.frames for s in manifest.shards) / manifest.fps
    dropped = f", {len(manifest.dropped)} dropped" if manifest.dropped else ""
    context.console.print(
        f"    {clips} clips, {seconds / 60:.1f} minutes at {manifest.fps:g} fps, layout {manifest.layout} "
        f"({manifest.family}), {len(manifest.shards)} shards{dropped}"
    )
