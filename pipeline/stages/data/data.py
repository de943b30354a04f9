"""Stages that bring shards: synthesise them, or take those that exist (`convert.py`: real sources)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, Self

import torch
from pydantic import Field, model_validator

from motionloom.datasets.check.dataset import check
from motionloom.datasets.check.leaks import Splits, find_leaks
from motionloom.datasets.motion.layout import MotionLayout, require_layout
from motionloom.datasets.schema import Manifest, UserError
from motionloom.datasets.shards.cache import CacheConfig
from motionloom.datasets.shards.left_out import tally
from motionloom.datasets.shards.options import Reading
from motionloom.datasets.shards.reader import ShardDataset, load_manifest, manifest_layout, read_manifest
from motionloom.datasets.shards.store import is_url, open_store
from motionloom.datasets.synth.generate import SynthConfig, synthesize
from motionloom.pipeline.contract.stage import (
    RUNTIME,
    Finished,
    FunctionStage,
    Inputs,
    StageConfig,
    StageContext,
    register,
)
from motionloom.pipeline.store.data import (
    READER,
    REFERENCE,
    SHARDS,
    Data,
    DataPart,
    DataPreview,
    Reader,
    Reference,
)
from motionloom.pipeline.store.files import write_json


class DataStage(FunctionStage):
    """A kind that brings shards. Its config names the layout that they will have."""

    def gives(self, config: Any) -> frozenset[str]:
        return frozenset({"data"})

    def preview(self, config: Any, given: Inputs) -> DataPreview:
        """The layout, as the config says or as existing shards are."""
        if isinstance(config, ShardsStageConfig):
            return DataPreview(config.found_layout())
        name, fps = getattr(config, "layout", None), getattr(config, "fps", None)
        if name is None:
            raise UserError(
                "the layout of the data is not known; set data.layout to see what the trainings take"
            )
        return DataPreview(MotionLayout.named(name, fps=fps or 30.0))

    def load(self, stage: Finished, given: Inputs, device: torch.device) -> Data:
        return Data(stage.folder)


class ShardsStage(DataStage):
    """A checked pointer to shards that exist already."""

    def external(self, config: ShardsStageConfig) -> dict[str, Any]:
        return shards_source(config)

    def settle(self, config: ShardsStageConfig, folder: Path) -> None:
        """How to read changes no result, so it is written anew whenever the recipe runs."""
        settle_shards(config, folder)


class SynthStageConfig(SynthConfig, StageConfig):
    """Synthetic whole-body shards."""

    # The recipe's seed may stand for it, so a stage has one case more than the synthesizer.
    seed: int | None = Field(None, ge=0)  # type: ignore[assignment]
    """Of the clips; None = the recipe's seed."""


class ShardsStageConfig(Reading, StageConfig):
    """Shards that exist already, in a folder or on a server, or a mix of several such data sets."""

    path: str | None = None
    """Folder with `manifest.json`, or a URL (`s3://`, `https://`, `http://`)."""
    mix: list[DataPart] = Field(default_factory=list)
    """Several data sets and their weights, in place of `path`."""
    layout: str | None = None
    """Refuse shards of another layout. Dry runs go by it while the shards are not there yet."""
    verify: bool = True
    """Check folders from end to end, when the stage runs. Shards on a server are checked as they arrive."""
    # These change no result, so a finished run is not thrown away for them.
    mode: Literal["indexed", "streamed"] = Field("indexed", json_schema_extra=RUNTIME)
    """`indexed` reads clips where they lie; `streamed` has training read whole shards front to back."""
    cache: CacheConfig = Field(CacheConfig(), json_schema_extra=RUNTIME)
    allow_leaks: bool = Field(False, json_schema_extra=RUNTIME)
    """Mix data sets although a clip that one tests with is another's training clip."""

    @model_validator(mode="after")
    def _one_place(self) -> Self:
        if (self.path is None) == (not self.mix):
            raise ValueError("give either path (one data set) or mix (several, each with path and weight)")
        places = [part.path for part in self.mix]
        if len(set(places)) != len(places):
            raise ValueError("mix names a data set twice; add its weights up")
        return self

    def parts(self) -> list[DataPart]:
        """The data sets, folders by their absolute path."""
        parts = self.mix or [DataPart(path=str(self.path), weight=1.0)]
        return [part.model_copy(update={"path": _place(part.path)}) for part in parts]

    def found_layout(self) -> MotionLayout:
        """Layout of the shards as they are, or, while there are none, as they are meant to be."""
        if self.layout is not None:
            return MotionLayout.named(self.layout)
        return manifest_layout(read_manifest(open_store(self.parts()[0].path, self.cache))[0])


def run_synth(context: StageContext) -> None:
    """Write synthetic shards."""
    config: SynthStageConfig = context.config
    if config.seed is None:
        config = config.model_copy(update={"seed": context.seed})
    manifest = synthesize(config, context.folder / SHARDS, workers=context.hardware.convert_workers)
    say_shards(context, manifest)


def refuse_leaks(sets: Mapping[str, Splits], *, allowed: bool) -> None:
    """`UserError` when a mix would be tested on clips that it is trained on."""
    leaks = [] if allowed else find_leaks(sets)
    if leaks:
        raise UserError(
            f"{len(leaks)} clips are in two splits of a mix, such as {leaks[0]}; convert both sources "
            f"with the same split files, or set allow_leaks: true"
        )


def run_shards(context: StageContext) -> None:
    """Point at existing shards, after checking them."""
    config: ShardsStageConfig = context.config
    layouts = []
    for part in config.parts():
        manifest, _ = read_manifest(open_store(part.path, config.cache))
        layouts.append((part.path, manifest_layout(manifest)))
        if config.layout is not None:
            _require_named(config.layout, manifest, part.path)
        if config.verify and not is_url(part.path):
            problems = check(Path(part.path))
            if problems:
                raise UserError(
                    f"{part.path}: {len(problems)} problems, first: {problems[0]}; see: motionloom data check"
                )
        say_shards(context, manifest, part.path if len(config.parts()) > 1 else "")
        _warn_of_small_cache(context, config, part.path, manifest)
    for place, layout in layouts[1:]:
        require_layout(layout, layouts[0][1], f"{place}, mixed with {layouts[0][0]}")
    folders = [Path(part.path) for part in config.parts() if not is_url(part.path)]
    refuse_leaks({str(folder): _splits(folder) for folder in folders}, allowed=config.allow_leaks)
    reference = Reference(parts=config.parts(), order=config.order, shards_per_group=config.shards_per_group)
    write_json(context.folder / REFERENCE, reference.dump())
    settle_shards(config, context.folder)


def _splits(folder: Path) -> Splits:
    filled = {shard.split for shard in load_manifest(folder).shards}
    return {split: ShardDataset.open(folder, split) for split in filled}


def _require_named(layout: str, manifest: Manifest, place: str) -> None:
    if manifest.layout != layout:
        raise UserError(
            f"{place}: layout {manifest.layout}, but the recipe wants {layout}; convert to that layout, or "
            f"leave `layout` out"
        )


def settle_shards(config: ShardsStageConfig, folder: Path) -> None:
    """Write down how the recipe wants the shards read now; done again whenever the recipe runs."""
    write_json(folder / READER, Reader(mode=config.mode, cache=config.cache).dump())


def shards_source(config: ShardsStageConfig) -> dict[str, Any]:
    """Checksums of the manifests, which hold those of the shards."""
    for part in config.parts():
        if not is_url(part.path) and not Path(part.path).is_dir():
            raise UserError(
                f"{part.path}: no such folder; set the path of the data stage to a folder of shards, for "
                f"example with --set data.path=FOLDER"
            )
        if config.layout is not None:
            _require_named(config.layout, read_manifest(open_store(part.path, config.cache))[0], part.path)
    manifests = [read_manifest(open_store(part.path, config.cache))[1] for part in config.parts()]
    return {"manifests": manifests}


def _place(path: str) -> str:
    """A URL as it is, a folder resolved."""
    if is_url(path) or path.startswith("file:"):
        return path
    return str(Path(path).expanduser().resolve())


def _warn_of_small_cache(
    context: StageContext, config: ShardsStageConfig, place: str, manifest: Manifest
) -> None:
    """Random access through a cache that cannot hold the training split fetches its shards over and over."""
    size = sum(shard.bytes for shard in manifest.shards if shard.split == "train")
    if is_url(place) and config.order == "global" and 0 < config.cache.limit < size:
        context.console.print(
            f"    [yellow]{place}: {size / 1e9:.1f} GB of training shards, the cache holds "
            f"{config.cache.gigabytes:g}: raise cache.gigabytes, or set order: streamed[/]"
        )


def say_shards(context: StageContext, manifest: Manifest, name: str = "") -> None:
    """One line about a data set: clips, minutes, layout."""
    clips = sum(s.samples for s in manifest.shards)
    seconds = sum(s.frames for s in manifest.shards) / manifest.fps
    dropped = f", {tally(manifest.dropped)}" if manifest.dropped else ""
    context.console.print(
        f"    {name and name + ': '}{clips} clips, {seconds / 60:.1f} minutes at {manifest.fps:g} fps, "
        f"layout {manifest.layout} ({manifest.family}), {len(manifest.shards)} shards{dropped}"
    )


register(DataStage("synth", "synthetic shards", SynthStageConfig, run_synth))
register(ShardsStage("shards", "existing shards", ShardsStageConfig, run_shards))
