"""Stages that bring shards: synthesise them, or take those that exist (`convert.py`: real sources)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from pydantic import Field

from motionloom.datasets.audio.beat_net import WEIGHTS
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import sha256_of
from motionloom.datasets.base.records import Manifest
from motionloom.datasets.check.dataset import check_once
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.cache import CacheConfig
from motionloom.datasets.shards.left_out import tally
from motionloom.datasets.shards.options import Reading
from motionloom.datasets.shards.reader import manifest_layout, read_manifest
from motionloom.datasets.shards.store import LocalStore, is_url, open_store
from motionloom.datasets.synth.generate import SynthConfig, synthesize
from motionloom.pipeline.contract.fingerprint import RUNTIME
from motionloom.pipeline.contract.stage import (
    CompletedStage,
    FunctionStage,
    Inputs,
    NotThereError,
    StageConfig,
    StageContext,
    register,
)
from motionloom.pipeline.store.artifact import NOTE, Compared
from motionloom.pipeline.store.data import READER, REFERENCE, SHARDS, Data, DataPreview, Reader, Reference
from motionloom.pipeline.store.files import write_json
from motionloom.pipeline.store.run_folder import owner_of


class DataStage(FunctionStage):
    """A kind that brings shards. Its config names the layout that they will have."""

    def gives(self, config: Any) -> frozenset[str]:
        return frozenset({"data"})

    def preview(self, config: Any, given: Inputs) -> DataPreview:
        """The layout, as the config says or as existing shards are."""
        if isinstance(config, ShardsStageConfig):
            return DataPreview(config.found_layout())
        name = getattr(config, "layout", None)
        fps = getattr(config, "fps", None)
        if name is None:
            raise UserError(
                f"the layout of the data is not known; set the layout of a stage of kind {self.name} to see "
                "what the trainings take"
            )
        return DataPreview(MotionLayout.named(name, fps=fps or 30.0))

    def load(self, stage: CompletedStage, given: Inputs, device: torch.device) -> Data:
        return Data(stage.folder)


class ShardsStage(DataStage):
    """A checked pointer to shards that exist already."""

    def external(self, config: ShardsStageConfig) -> dict[str, Any]:
        """Checksum of the manifest, which holds those of the shards, and what the streamed order is of."""
        order = {"order": "streams"} if config.order == "streamed" else {}
        return {"manifest": config.manifest()[1], **order}

    def settle(self, config: ShardsStageConfig, folder: Path) -> None:
        """Write settings of reading anew whenever the recipe runs: they change no result."""
        write_json(folder / READER, Reader(cache=config.cache).dump())


class SynthStage(DataStage):
    """Synthetic shards."""

    def external(self, config: SynthConfig) -> dict[str, str]:
        """Checksum of the tracker of beats, where dances hold its columns."""
        rhythm = config.dances is not None and config.dances.columns == "rhythm"
        return {WEIGHTS.name: sha256_of(WEIGHTS)} if rhythm else {}


class SynthStageConfig(SynthConfig, StageConfig):
    """Synthetic whole-body shards."""

    # The recipe's seed may stand for it, so a stage has one case more than the synthesizer.
    seed: int | None = Field(None, ge=0)  # type: ignore[assignment]
    """Seed of the clips; None = the recipe's."""


class ShardsStageConfig(Reading, StageConfig):
    """Shards that exist already, in a folder or on a server."""

    path: str
    """Folder with `manifest.json`, or a URL (`s3://`, `hf://`, `https://`, `http://`)."""
    layout: str | None = None
    """Refuse shards of another layout. Dry runs go by it while the shards are not there yet."""
    verify: bool = True
    """Check folders from end to end, when the stage runs. Shards on a server are checked as they arrive."""
    # It changes no result, so a finished run is not thrown away for it.
    cache: CacheConfig = Field(CacheConfig(), json_schema_extra=RUNTIME)

    @property
    def place(self) -> str:
        """A URL as it is, a folder resolved."""
        store = open_store(self.path)
        return str(store.root.expanduser().resolve()) if isinstance(store, LocalStore) else store.place

    def found_layout(self) -> MotionLayout:
        """Layout of the shards as they are, or, while there are none, as they are meant to be."""
        if self.layout is not None:
            return MotionLayout.named(self.layout)
        return manifest_layout(self.manifest()[0])

    def manifest(self) -> tuple[Manifest, str]:
        """The manifest, of the layout that is wanted, and its checksum."""
        if not is_url(self.place) and not Path(self.place).is_dir():
            raise NotThereError(f"{self.place}: no such folder of shards", "path")
        manifest, digest = read_manifest(open_store(self.place, self.cache))
        if self.layout is not None and manifest.layout != self.layout:
            raise UserError(
                f"{self.place}: layout {manifest.layout}, but the recipe wants {self.layout}; convert to "
                f"that one, or leave `layout` out"
            )
        return manifest, digest


def run_synth(context: StageContext) -> None:
    """Write synthetic shards."""
    config: SynthStageConfig = context.config
    if config.seed is None:
        config = config.model_copy(update={"seed": context.seed})
    manifest = synthesize(config, context.folder / SHARDS, workers=context.hardware.convert_workers)
    say_shards(context, manifest)


def run_shards(context: StageContext) -> None:
    """Point at existing shards, after checking them."""
    config: ShardsStageConfig = context.config
    (manifest, _) = config.manifest()
    place = config.place
    if config.verify and not is_url(place):
        problems, states = check_once(Path(place), workers=context.hardware.convert_workers)
        if problems:
            raise UserError(
                f"{place}: {len(problems)} problems, first: {problems[0]}; see: motionloom data check"
            )
        # What has been hashed is not hashed again by the next stage.
        compared = {str(Path(place, one.name)): (one.sha256, states[one.name]) for one in manifest.shards}
        Compared.add(owner_of(context.folder) / NOTE, compared)
    say_shards(context, manifest)
    size = sum(shard.bytes for shard in manifest.shards if shard.split == "train")
    if is_url(place) and config.order == "global" and 0 < config.cache.limit < size:
        # Random access through a cache that is too small fetches shards over and over.
        context.console.print(
            f"    [yellow]{place}: {size / 1e9:.1f} GB of training shards, the cache holds "
            f"{config.cache.gigabytes:g}: raise cache.gigabytes, or set order: streamed[/]"
        )
    reference = Reference(path=place, order=config.order, shards_per_group=config.shards_per_group)
    write_json(context.folder / REFERENCE, reference.dump())
    write_json(context.folder / READER, Reader(cache=config.cache).dump())


def say_shards(context: StageContext, manifest: Manifest) -> None:
    """One line about a data set: clips, minutes, layout."""
    clips = sum(s.samples for s in manifest.shards)
    seconds = sum(s.frames for s in manifest.shards) / manifest.fps
    dropped = f", {tally(manifest.dropped)}" if manifest.dropped else ""
    dropped += f", {len(manifest.excluded)} of them left out by data clean" if manifest.excluded else ""
    context.console.print(
        f"    {clips} clips, {seconds / 60:.1f} minutes at {manifest.fps:g} fps, "
        f"layout {manifest.layout} ({manifest.family}), {len(manifest.shards)} shards{dropped}"
    )


register(SynthStage("synth", "synthetic shards", SynthStageConfig, run_synth))
register(ShardsStage("shards", "existing shards", ShardsStageConfig, run_shards))
