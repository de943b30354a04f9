"""Statistics and text conditions: what every training stage reads beside the motion."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from pydantic import Field, model_validator

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import sha256_of
from motionloom.datasets.loading.statistics import FeatureStats, compute
from motionloom.pipeline.contract.fingerprint import RUNTIME
from motionloom.pipeline.contract.stage import (
    CPU,
    CompletedStage,
    Inputs,
    StageConfig,
    StageContext,
    StageKind,
    register,
)
from motionloom.pipeline.store.files import copy_files
from motionloom.pipeline.store.known_captions import representatives, save_known
from motionloom.pipeline.store.text import BUILT_IN, TextPreview, TextSource, keep_place

if TYPE_CHECKING:
    from motionloom.datasets.text.cache import TextCache
    from motionloom.pipeline.store.data import Data

_STATS = "stats.safetensors"


class StatsConfig(StageConfig):
    """Mean and standard deviation per feature dimension, from the training split only."""

    group: bool = False
    """Average the deviation over each kind of feature, as HumanML3D does."""
    root_gain: float = Field(1.0, gt=0)
    """Factor on the root's columns, once normalised [ours]: they are few, and errors in them add up along
    the way."""
    mean: Path | None = Field(None, json_schema_extra=RUNTIME)
    """The `Mean.npy` of a release whose weights a stage loads (`published`), in place of the data's own."""
    std: Path | None = Field(None, json_schema_extra=RUNTIME)
    """The release's `Std.npy`. Checksums of both count, not their places."""

    @model_validator(mode="after")
    def _both(self) -> StatsConfig:
        if (self.mean is None) != (self.std is None):
            raise ValueError("mean and std are given together, or neither")
        if self.mean is not None and (self.group or self.root_gain != 1):
            raise ValueError(
                "group and root_gain are of the data's own statistics: leave them out beside mean and std"
            )
        return self

    @property
    def release(self) -> tuple[Path, Path] | None:
        """The files of a release."""
        if self.mean is None or self.std is None:
            return None
        return self.mean.expanduser(), self.std.expanduser()


class TextConfig(StageConfig):
    """Sentence and token embeddings of every caption, computed once."""

    encoder: str = "minilm"
    """`minilm` (comes with the installation), a folder with a sentence-transformers, BERT-like or CLIP model,
    or a name on the Hugging Face hub."""
    similarity: str = "minilm"
    """The encoder, named likewise, that says which captions mean the same: the paper's sBERT (D.1, D.2), for
    the filter of negatives and retrieval protocol B, whatever `encoder` is."""


class StatsStage(StageKind[StatsConfig]):
    """Mean and deviation of every feature."""

    name = "stats"
    summary = "mean and deviation"
    config = StatsConfig
    takes = ("data",)

    def external(self, config: StatsConfig) -> object:
        paths = config.release
        lost = [path for path in paths or () if not path.is_file()]
        if lost:
            raise UserError(f"{lost[0]}: no such file; name the release's mean and std")
        return None if paths is None else [sha256_of(path) for path in paths]

    def exported_config(self, config: StatsConfig) -> StatsConfig:
        """Return the config without the folders in which a release's statistics lay."""
        places = {n: Path(p.name) for n, p in (("mean", config.mean), ("std", config.std)) if p is not None}
        return config.model_copy(update=places)

    def run(self, context: StageContext) -> None:
        dataset = context.given["data"].split("train")
        paths: tuple[Path, Path] | None = context.config.release
        if paths is not None:
            FeatureStats.of_arrays(*paths, dataset.layout).save(context.folder / _STATS)
            context.console.print(
                f"    of {paths[0].name} and {paths[1].name}, {dataset.layout.dim} dimensions"
            )
            return
        stats = compute(dataset, group=context.config.group)
        stats.with_root(context.config.root_gain).save(context.folder / _STATS)
        context.console.print(
            f"    {len(dataset)} clips, {int(dataset.frames.sum())} frames, {dataset.layout.dim} dimensions"
        )

    def load(self, stage: CompletedStage, given: Inputs, device: torch.device) -> FeatureStats:
        return FeatureStats.load(stage.folder / _STATS)

    def export(self, stage: CompletedStage, target: Path) -> None:
        copy_files(stage.folder, target, (_STATS,))


class TextStage(StageKind[TextConfig]):
    """Embeddings of every caption, and which captions represent those of the training."""

    name = "text"
    summary = "caption embeddings"
    config = TextConfig
    takes = ("data",)
    version = 3  # captions that are known without their words
    shares = True
    light = True

    def share(self, context: StageContext) -> None:
        if context.world > 1:
            said, _ = _said(context.given["data"])
            _cache(context, set[str]().union(*said.values()), (context.rank, context.world))

    def run(self, context: StageContext) -> None:
        keep_place(context.config.encoder, context.folder)
        said, actions = _said(context.given["data"])
        captions = set[str]().union(*said.values())
        cache = _cache(context, captions)
        assert cache is not None
        context.console.print(
            f"    {len(captions)} different captions, {cache.dim}-d embeddings by {cache.encoder}"
        )
        if context.config.similarity == BUILT_IN:
            body, face_captions = (
                representatives(
                    sorted(said["train", face]),
                    cache.similarity(sorted(said["train", face])),
                    cache.similarity(sorted(said["val", face])),
                )
                for face in (False, True)
            )
            save_known(context.folder, body, face_captions, tuple(actions))

    def preview(self, config: TextConfig, given: Inputs) -> TextPreview:
        return TextPreview.of(config.encoder)

    def load(self, stage: CompletedStage, given: Inputs, device: torch.device) -> TextSource:
        return _source(stage, device)

    def exported_config(self, config: TextConfig) -> TextConfig:
        """Return the config without places on this machine: an export brings its encoder along."""
        return TextConfig()

    def export(self, stage: CompletedStage, target: Path) -> None:
        _source(stage, CPU).export(target)


def _said(data: Data) -> tuple[dict[tuple[str, bool], set[str]], set[str]]:
    """The captions of each split, of bodies and of faces (True); the actions of the training's clips."""
    from motionloom.datasets.actions.measure import actions_of
    from motionloom.pipeline.store.data import captions_of

    actions = set[str]()
    said = defaultdict[tuple[str, bool], set[str]](set)
    for split in data.splits:
        dataset = data.split(split)
        for index in range(len(dataset)):
            for face in (False, True):
                said[split, face] |= {caption.text for caption in captions_of(dataset, index, face=face)}
            if split == "train":
                actions.update(actions_of(dataset.meta(index).truth))
    return said, actions


def _cache(context: StageContext, captions: set[str], share: tuple[int, int] = (0, 1)) -> TextCache | None:
    """`build_text_cache` as the stage's settings say; processes of one machine divide its workers."""
    from motionloom.datasets.text.build import build_text_cache

    processes = 1 if share == (0, 1) else context.hardware.resolved_devices()
    return build_text_cache(
        context.folder / "cache",
        captions,
        context.config.encoder,
        workers=context.hardware.convert_workers // processes,
        progress=context.console.is_terminal,
        device=str(context.device),
        similarity=context.config.similarity,
        share=share,
    )


def _source(stage: CompletedStage, device: torch.device) -> TextSource:
    source = TextSource(stage.folder, stage.config.encoder, device, stage.exported)
    if stage.exported:
        _ = source.known  # read at once: what is broken in an export is found before anything is made
    return source


register(StatsStage())
register(TextStage())
